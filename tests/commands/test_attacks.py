"""Attacks on the commands: see ``support.attacks``, which documents the rules.

Each rule is also broken here by a command of a few lines, and that is noticed.

A failure names the attacks, and ``ATTACKS=NAME`` repeats one of them, or those of a pattern.
"""

import os
import sys
import time
import warnings
from fnmatch import fnmatch
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.attacks.attack import Attack, Fault
from support.attacks.attack_folder import AttackFolder
from support.attacks.catalogue import KNOWN_FAILURES, attacks
from support.attacks.server import Server
from support.attacks.trial import trial

from drgs.core.files import atomic_path

COUNTS = {
    "schema": 810,
    "option": 1020,
    "instead": 360,
    "damaged": 390,
    "special": 99,
    "together": 440,
    "folder": 220,
    "name": 108,
    "fault": 364,
    "stop": 101,
    "size": 24,
    "drawn": 4,
    "property": 300,
    "object": 100,
}
"""How many of a family are tried; of the faults, but for those in fits, all."""


@pytest.fixture(scope="module")
def full_folder(tmp_path_factory):
    mi.set_variant("llvm_ad_rgb")
    return AttackFolder(tmp_path_factory.mktemp("attacks"))


@pytest.mark.slow
@pytest.mark.parametrize("family", COUNTS)
def test_attacks_end_in_results_or_a_one_line_error(full_folder, tmp_path, family):
    with Server(tmp_path) as server:
        found, pattern = attacks(family, full_folder), os.environ.get("ATTACKS")
        chosen = [a for a in found if a.name == pattern or fnmatch(a.name, pattern or "")]
        if not pattern:
            order = np.random.default_rng(1).permutation(len(found))
            chosen = [found[index] for index in sorted(order[: COUNTS[family]])]
        found = {attack.name: server.trial(attack.name, attack.seconds) for attack in chosen}
    wrong = {name: lines for name, lines in found.items() if lines and name not in KNOWN_FAILURES}
    report = [f"{name}: {line}" for name, lines in wrong.items() for line in lines]
    assert not wrong, "\n".join([f"{len(wrong)} of {len(found)}", *report])
    mended = [name for name in KNOWN_FAILURES if found.get(name) == []]
    assert not mended, f"no failures any more: {mended}"


@pytest.fixture(scope="module")
def attack_folder(tmp_path_factory):
    """Without what the commands themselves would write, which takes seconds."""
    return AttackFolder(tmp_path_factory.mktemp("attacks"), with_results=False)


def refuse(*lines):
    print(*lines, sep="\n", file=sys.stderr)
    sys.exit(2)


def write(path):
    with atomic_path(path) as temporary:
        temporary.write_text("x")


BREACHES = {
    "exception": (lambda: 1 / 0, "ZeroDivisionError: division by zero"),
    "status": (lambda: sys.exit(1), "ended with status 1"),
    "silence": (lambda: sys.exit(2), "a refusal of 0 lines"),
    "two lines": (lambda: refuse("error: a", "error: b"), "a refusal of 2 lines"),
    "no error": (lambda: refuse("no"), "a refusal that is none: no"),
    "long line": (lambda: refuse("error: " + "x" * 3000), "a line of 3007 characters"),
    "unnamed": (lambda: refuse("error: no"), "does not name a.yml: error: no"),
    "no refusal": (lambda: None, "was not refused"),
    "warning": (lambda: warnings.warn("of what?", stacklevel=1), "error: UserWarning: of what?"),
    "memory": (lambda: np.ones(1 << 26).sum(), "MB more"),
    "time": (lambda: time.sleep(5), "TimeLimitExceeded"),
    "file of the user's": (lambda: write("mine/notes.txt"), "changed mine/notes.txt"),
    "removed": (lambda: os.unlink("sky.png"), "removed sky.png"),
    "beside the output": (lambda: write("new/a"), "made new/a"),
    "refused too late": (lambda: (write("out/a"), refuse("error: no")), "made out/a"),
    "elsewhere": (lambda: (write("../a"), os.unlink("../a")), "wrote outside"),
    "temporary": (
        lambda: (os.mkdir("out"), Path("out/.a.7.tmp.txt").touch()),
        "left out/.a.7.tmp.txt",
    ),
    "encoding": (lambda: print("\u00e4"), "UnicodeEncodeError"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BREACHES)
def test_forbidden_behaviour_is_detected(attack_folder, monkeypatch, name):
    command, message = BREACHES[name]
    monkeypatch.setattr("drgs.render.__main__.main", lambda words: command())
    more = {"seconds": 0.5} if name == "time" else {}
    attack = Attack("x", "render", (), encoding="ascii", named="a.yml", must_refuse=True, **more)
    wrong = trial(attack, attack_folder)
    assert any(message in line for line in wrong), wrong


def forgetful_work(words):
    write("out/b")
    if not os.path.exists("out/b.done"):
        write("out/b.done")
        write("out/a")


def test_work_lost_after_a_kill_is_detected(attack_folder, monkeypatch):
    monkeypatch.setattr("drgs.render.__main__.main", forgetful_work)
    kills = [Attack("x", "render", (), fault=Fault("kill", at), results="ab") for at in range(14)]
    assert "again: a is missing" in [line for kill in kills for line in trial(kill, attack_folder)]
