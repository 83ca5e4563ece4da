"""All attacks, by family and by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from support.attacks.attack import Attack
from support.attacks.attack_folder import AttackFolder
from support.attacks.faults import fault_attacks, size_attacks
from support.attacks.files import damage_attacks, other_file_attacks, special_attacks
from support.attacks.options import combination_attacks, drawn_attacks, folder_attacks, name_attacks
from support.attacks.scenes import object_attacks, property_attacks
from support.attacks.values import option_attacks, schema_attacks

FAMILIES: dict[str, Callable[[AttackFolder], Iterable[Attack]]] = {
    "schema": lambda _: schema_attacks(),
    "option": lambda _: option_attacks(),
    "instead": lambda _: other_file_attacks(),
    "damaged": lambda _: damage_attacks(),
    "special": lambda _: special_attacks(),
    "together": lambda _: combination_attacks(),
    "folder": lambda _: folder_attacks(),
    "name": lambda _: name_attacks(),
    "fault": fault_attacks,
    "size": lambda _: size_attacks(),
    "drawn": lambda _: drawn_attacks(),
    "property": lambda _: property_attacks(),
    "object": lambda _: object_attacks(),
}
"""Attacks by the first part of their name."""

KNOWN_FAILURES: dict[str, str] = {
    "schema/densify.budget.prune_opacity=0.5": "known once the fit has begun: its folder stays",
}
"""Reasons of known failures, by attack. A test fails when one of them passes."""


def attacks(family: str, attack_folder: AttackFolder) -> list[Attack]:
    """All of a family."""
    found = list(FAMILIES[family](attack_folder))
    names = [attack.name for attack in found]
    assert len(set(names)) == len(names), family
    return found


def some(found: list[Attack], count: int) -> list[Attack]:
    """``count`` of them, by a seed, in their order."""
    chosen = np.random.default_rng(1).permutation(len(found))[:count]
    return [found[index] for index in sorted(chosen)]
