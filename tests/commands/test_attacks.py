"""Attacks on the commands: see ``support.attacks``, which documents the rules.

A failure names the attacks; to repeat one of them:

    PYTHONPATH=tests python -m support.attacks NAME
"""

import mitsuba as mi
import pytest
from support.attacks.attack_folder import AttackFolder
from support.attacks.catalogue import KNOWN_FAILURES, attacks, some
from support.attacks.server import Server

COUNTS = {
    "schema": 810,
    "option": 1020,
    "instead": 360,
    "damaged": 390,
    "special": 99,
    "together": 440,
    "folder": 220,
    "name": 108,
    "fault": 158,
    "size": 24,
    "drawn": 4,
    "property": 300,
    "object": 100,
}
"""How many of a family are tried."""


@pytest.fixture(scope="module")
def attack_folder(tmp_path_factory):
    mi.set_variant("llvm_ad_rgb")
    return AttackFolder(tmp_path_factory.mktemp("attacks"))


@pytest.mark.slow
@pytest.mark.parametrize("family", COUNTS)
def test_attacks_end_in_results_or_a_one_line_error(attack_folder, tmp_path, family):
    with Server(tmp_path) as server:
        chosen = some(attacks(family, attack_folder), COUNTS[family])
        found = {attack.name: server.trial(attack.name, attack.seconds) for attack in chosen}
    wrong = {name: lines for name, lines in found.items() if lines and name not in KNOWN_FAILURES}
    report = [f"{name}: {line}" for name, lines in wrong.items() for line in lines]
    assert not wrong, "\n".join([f"{len(wrong)} of {len(found)}", *report])
    mended = [name for name in KNOWN_FAILURES if found.get(name) == []]
    assert not mended, f"no failures any more: {mended}"
