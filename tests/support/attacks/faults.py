"""Attacks by the machine: a full disk, a kill or a Ctrl-C at every change of a file.

After each the command is run again, as its user would, and must end with the same files.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from support.attacks.attack import Attack
from support.attacks.attack_folder import CAPTURE, AttackFolder, current_folder
from support.attacks.observer import KINDS, SMALL_FILES, Fault
from support.attacks.trial import run

FITTED = ("point_cloud.ply", "renders/test/r_0.png", "side_by_side/test/r_0.png", "config.yml")

WORKS = {
    "fit": ("fit", ("fit.yml", "--out", "out"), FITTED),
    "resume": ("fit", ("--resume", "stopped"), FITTED),
    "split": ("render", ("run", "--out", "out"), ("r_0.png", "metrics.json")),
    "orbit": (
        "render",
        ("gaussians.ply", "--orbit", "2", "--size", "8", "6", "--out", "out"),
        ("orbit.webp", "orbit.gif", "orbit_000.png", "orbit_001.png"),
    ),
    "scene": ("render", ("splats.xml", "--out", "out"), ("splats.png", "splats.exr")),
    "capture": (
        "capture",
        (*CAPTURE, "--out", "out"),
        ("points3d.ply", "transforms_train.json", "train/r_0.png", "test/r_0.png", "capture.json"),
    ),
}
"""Commands that can be disturbed, by name: words, and files that must have the same bytes.

Images of a fit take seconds, and are replaced by stubs.
"""


def works() -> Iterator[Attack]:
    """Each of the above, without a fault."""
    for name, (command, words, results) in WORKS.items():
        yield Attack(name, command, words, out=words[-1], results=results)


def count_changes(work: Attack, attack_folder: AttackFolder) -> int:
    """How often the command changes a file, when nothing happens."""
    with current_folder(attack_folder.folder):
        outcome = run(work)
    attack_folder.restore_files()
    assert outcome.status == 0, outcome.err
    return len(outcome.changes.inside)


def size_attacks() -> Iterator[Attack]:
    """No file may become larger than so many bytes: writing fails in the midst of one."""
    for work in works():
        for size in (0, 10, 100, 400, 1000, 2000, 5000):
            yield replace(work, name=f"size/{work.name}/{size}", fault=Fault(SMALL_FILES, size))


def fault_attacks(attack_folder: AttackFolder) -> Iterator[Attack]:
    """Each kind of fault at each change of a file by each of the works."""
    for work in works():
        for at in range(count_changes(work, attack_folder)):
            for kind in KINDS:
                yield replace(work, name=f"fault/{work.name}/{kind} at {at}", fault=Fault(kind, at))
