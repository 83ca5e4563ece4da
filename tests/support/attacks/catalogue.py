"""All attacks, by family and by name, among them those by the machine.

After a full disk, a kill or a Ctrl-C at any change of a file the command is run again, as its user
would, and must end with the same files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

from support.attacks.attack import KINDS, SMALL_FILES, Attack, Fault
from support.attacks.attack_folder import CAPTURE, AttackFolder, current_folder
from support.attacks.files import damage_attacks, other_file_attacks, special_attacks
from support.attacks.options import combination_attacks, drawn_attacks, folder_attacks, name_attacks
from support.attacks.trial import run
from support.attacks.values import object_attacks, option_attacks, property_attacks, schema_attacks

FITTED = (
    "point_cloud.ply point_cloud_drgs.ply renders/test/r_0.png side_by_side/test/r_0.png config.yml"
)

WORKS = {
    "fit": ("fit fit.yml --out out", FITTED),
    "resume": ("fit --resume stopped", FITTED),
    "split": ("render run --out out", "r_0.png metrics.json"),
    "orbit": (
        "render gaussians.ply --orbit 2 --size 8 6 --out out",
        "orbit.webp orbit_000.png orbit_001.png",
    ),
    "scene": ("render splats.xml --out out", "splats.png splats.exr"),
    "capture": (
        f"capture {' '.join(CAPTURE)} --out out",
        "points3d.ply transforms_train.json train/r_0.png test/r_0.png capture.json",
    ),
}
"""Commands that can be disturbed, by name: words, and files that must have the same bytes.

Images of a fit take seconds, and are replaced by stubs.
"""


def works(is_fit: bool) -> list[Attack]:
    """Each of the above, or all others, without a fault."""
    chosen = [(n, line.split(), r.split()) for n, (line, r) in WORKS.items()]
    return [
        Attack(name, command, tuple(words), out=words[-1], results=results)
        for name, (command, *words), results in chosen
        if (command == "fit") == is_fit
    ]


def size_attacks() -> Iterator[Attack]:
    """No file may become larger than so many bytes: writing fails in the midst of one."""
    for work in (*works(True), *works(False)):
        for size in (0, 10, 100, 400, 1000, 2000, 5000):
            yield replace(work, name=f"size/{work.name}/{size}", fault=Fault(SMALL_FILES, size))


def fault_attacks(family: str, attack_folder: AttackFolder) -> Iterator[Attack]:
    """Each kind of fault at each change of a file by each of the works."""
    for work in works(is_fit=family == "stop"):
        with current_folder(attack_folder.folder):
            outcome = run(work)
        attack_folder.restore_files()
        assert outcome.status == 0, outcome.err
        for at in range(len(outcome.changes.inside)):
            for kind in KINDS:
                name = f"{family}/{work.name}/{kind} at {at}"
                yield replace(work, name=name, fault=Fault(kind, at))


FAMILIES: dict[str, Callable[[AttackFolder], Iterable[Attack]]] = {
    "schema": lambda _: schema_attacks(),
    "option": lambda _: option_attacks(),
    "instead": lambda _: other_file_attacks(),
    "damaged": lambda _: damage_attacks(),
    "special": lambda _: special_attacks(),
    "together": lambda _: combination_attacks(),
    "folder": lambda _: folder_attacks(),
    "name": lambda _: name_attacks(),
    "fault": partial(fault_attacks, "fault"),
    "stop": partial(fault_attacks, "stop"),  # of fits
    "size": lambda _: size_attacks(),
    "drawn": lambda _: drawn_attacks(),
    "property": lambda _: property_attacks(),
    "object": lambda _: object_attacks(),
}

KNOWN_FAILURES: dict[str, str] = {
    "schema/densify.budget.prune_opacity=0.5": "known once the fit has begun: its folder stays",
    "schema/densify.budget.prune_opacity=0.99999995": "the same",
    "schema/densify.budget.prune_opacity=0.9999999999999999": "the same",
    "schema/init.opacity=1e-3": "the same: less than densify.budget.prune_opacity",
}
"""Reasons of known failures, by attack. A test fails when one of them passes."""


def attacks(family: str, attack_folder: AttackFolder) -> list[Attack]:
    """All of a family."""
    found = list(FAMILIES[family](attack_folder))
    names = [attack.name for attack in found]
    assert len(set(names)) == len(names), family
    return found
