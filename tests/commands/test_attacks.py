"""Attacks on the commands: see ``support.attacks``, which documents the rules.

By default some hundreds that are over in milliseconds, in this process; the slow test has
thousands, in a process of their own. A failure names the attacks; to repeat one of them:

    PYTHONPATH=tests python -m support.attacks NAME
"""

import mitsuba as mi
import pytest
from support.attacks.attack_folder import AttackFolder
from support.attacks.catalogue import FAMILIES, KNOWN_FAILURES, attacks, some
from support.attacks.server import Server
from support.attacks.trial import trial

QUICK = {
    "schema": 120,
    "option": 120,
    "instead": 60,
    "damaged": 40,
    "special": 6,
    "together": 40,
    "folder": 20,
    "name": 8,
    "fault": 8,
    "size": 4,
}
"""How many of a family are tried by default."""

SLOW = {
    "schema": 450,
    "option": 900,
    "instead": 300,
    "damaged": 350,
    "special": 93,
    "together": 400,
    "folder": 200,
    "name": 100,
    "fault": 150,
    "size": 20,
    "drawn": 4,
    "property": 300,
    "object": 100,
}
"""And how many are when there is time."""


@pytest.fixture(scope="module")
def attack_folder(tmp_path_factory):
    mi.set_variant("llvm_ad_rgb")
    return AttackFolder(tmp_path_factory.mktemp("attacks"))


def check(found):
    """found: by name of an attack, what is wrong."""
    wrong = {name: lines for name, lines in found.items() if lines}
    new = {name: lines for name, lines in wrong.items() if name not in KNOWN_FAILURES}
    report = [f"{name}: {line}" for name, lines in new.items() for line in lines]
    assert not new, "\n".join([f"{len(new)} of {len(found)}", *report])
    mended = [name for name in found if name in KNOWN_FAILURES and name not in wrong]
    assert not mended, f"no failures any more: {mended}"


@pytest.mark.slow
@pytest.mark.parametrize("family", QUICK)
def test_attacks_end_in_results_or_a_one_line_error(attack_folder, family):
    found = [a for a in attacks(family, attack_folder) if not a.risky and not a.is_long]
    chosen = some(found, QUICK[family])
    check({attack.name: trial(attack, attack_folder) for attack in chosen})


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_many_attacks_end_in_results_or_a_one_line_error(attack_folder, tmp_path, family):
    with Server(tmp_path) as server:
        chosen = some(attacks(family, attack_folder), SLOW[family], seed=1)
        check({attack.name: server.trial(attack.name, attack.seconds) for attack in chosen})
