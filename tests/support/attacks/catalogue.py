"""All attacks, by family and by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from support.attacks.attack import Attack
from support.attacks.attack_folder import AttackFolder
from support.attacks.faults import fault_attacks, size_attacks
from support.attacks.files import damage_attacks, other_file_attacks, special_attacks
from support.attacks.options import (
    combination_attacks,
    drawn_attacks,
    folder_attacks,
    name_attacks,
)
from support.attacks.scenes import object_attacks, property_attacks
from support.attacks.values import option_attacks, schema_attacks

DAMAGED = 40
"""Number of damaged versions of each file, by kind."""

FAMILIES: dict[str, Callable[[AttackFolder], Iterable[Attack]]] = {
    "schema": lambda attack_folder: schema_attacks(),
    "option": lambda attack_folder: option_attacks(),
    "instead": lambda attack_folder: other_file_attacks(),
    "damaged": lambda attack_folder: damage_attacks(DAMAGED),
    "special": lambda attack_folder: special_attacks(),
    "together": lambda attack_folder: combination_attacks(),
    "folder": lambda attack_folder: folder_attacks(),
    "name": lambda attack_folder: name_attacks(),
    "fault": fault_attacks,
    "size": lambda attack_folder: size_attacks(),
    "drawn": lambda attack_folder: drawn_attacks(),
    "property": lambda attack_folder: property_attacks(),
    "object": lambda attack_folder: object_attacks(),
}
"""Attacks by the first part of their name."""


KNOWN_FAILURES: dict[str, str] = {
    "schema/densify.budget.prune_opacity=half": "known once the fit has begun: its folder stays",
}
"""Reasons of known failures, by attack. A test fails when one of them passes."""


def attacks(family: str, attack_folder: AttackFolder) -> list[Attack]:
    """All of a family."""
    found = list(FAMILIES[family](attack_folder))
    names = [attack.name for attack in found]
    assert len(set(names)) == len(names), family
    return found


def some(found: list[Attack], count: int, seed: int = 0) -> list[Attack]:
    """``count`` of them, by a seed, in their order."""
    chosen = np.random.default_rng(seed).permutation(len(found))[:count]
    return [found[index] for index in sorted(chosen)]


def find(name: str, attack_folder: AttackFolder) -> Attack:
    """The attack of that name."""
    return next(a for a in attacks(name.partition("/")[0], attack_folder) if a.name == name)
