"""Attacks by the machine: a full disk, a kill or a Ctrl-C at every change of a file.

After each the command is run again, as its user would, and must end with the same files.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from support.attacks.attack import Attack
from support.attacks.attack_folder import CAPTURE, AttackFolder, capture_size, current_folder
from support.attacks.observer import KINDS, SMALL_FILES, Fault
from support.attacks.trial import run


@dataclass(frozen=True)
class Work:
    """A command that can be disturbed."""

    command: str
    words: tuple[str, ...]
    again: tuple[str, ...]  # words that go on
    results: tuple[str, ...]  # files that must have the same bytes
    out: str = "out"


FITTED = ("point_cloud.ply", "renders/test/r_0.png", "side_by_side/test/r_0.png", "config.yml")

WORKS = {
    "fit": Work("fit", ("fit.yml", "--out", "out"), ("fit.yml", "--out", "out"), FITTED),
    "resume": Work("fit", ("--resume", "stopped"), ("--resume", "stopped"), FITTED, out="stopped"),
    "split": Work(
        "render",
        ("run", "--out", "out"),
        ("run", "--out", "out"),
        ("r_0.png", "metrics.json"),
    ),
    "orbit": Work(
        "render",
        ("gaussians.ply", "--orbit", "2", "--size", "8", "6", "--out", "out"),
        ("gaussians.ply", "--orbit", "2", "--size", "8", "6", "--out", "out"),
        ("orbit.webp", "orbit.gif", "orbit_0.png", "orbit_1.png"),
    ),
    "scene": Work(
        "render",
        ("splats.xml", "--out", "out"),
        ("splats.xml", "--out", "out"),
        ("splats.png", "splats.exr"),
    ),
    "capture": Work(
        "capture",
        ("ball.xml", *CAPTURE, *capture_size(4), "--out", "out"),
        ("ball.xml", *CAPTURE, *capture_size(4), "--out", "out"),
        ("points3d.ply", "transforms_train.json", "train/r_0.png", "test/r_0.png", "capture.json"),
    ),
}
"""Commands by name. Images of a fit take seconds, and are replaced by stubs."""


def count_changes(work: Work, attack_folder: AttackFolder) -> int:
    """How often the command changes a file, when nothing happens."""
    attack = Attack("rehearsal", work.command, work.words)
    with current_folder(attack_folder.folder):
        outcome = run(attack, work.words)
    attack_folder.restore_files()
    assert outcome.status == 0, outcome.err
    return len(outcome.changes.inside)


SIZES = (0, 10, 100, 400, 1000, 2000, 5000)
"""Bytes."""


def size_attacks() -> Iterator[Attack]:
    """No file may become larger than so many bytes: writing fails in the midst of one."""
    for name, work in WORKS.items():
        for size in SIZES:
            yield Attack(
                f"size/{name}/{size}",
                work.command,
                work.words,
                out=work.out,
                fault=Fault(SMALL_FILES, size),
                again=work.again,
                results=work.results,
                is_long=work.command == "fit",
            )


def fault_attacks(attack_folder: AttackFolder) -> Iterator[Attack]:
    """Each kind of fault at each change of a file by each of the works."""
    for name, work in WORKS.items():
        for at in range(count_changes(work, attack_folder)):
            for kind in KINDS:
                yield Attack(
                    f"fault/{name}/{kind} at {at}",
                    work.command,
                    work.words,
                    out=work.out,
                    fault=Fault(kind, at),
                    again=work.again,
                    results=work.results,
                    is_long=work.command == "fit",
                )
