"""The attacks' own rules: each is broken here by a command of a few lines, and that is noticed."""

import os
import sys
import time
import warnings

import numpy as np
import pytest
from support.attacks.attack import Attack
from support.attacks.attack_folder import AttackFolder, contents
from support.attacks.observer import Fault
from support.attacks.trial import trial

from drgs.core.files import atomic_path


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


def write_and_refuse(path):
    write(path)
    refuse("error: no")


def divide():
    return 1 / 0


def warn():
    warnings.warn("of what?", stacklevel=1)


def take_memory():
    np.ones(1 << 26).sum()


def wait():
    time.sleep(5)


def write_elsewhere():
    path = "../elsewhere"
    write(path)
    os.unlink(path)


def leave_a_temporary_file():
    os.mkdir("out")
    open("out/.a.7.tmp.txt", "w").close()


def print_unencodable_text():
    print("\u00e4")


BREACHES = {
    "exception": (divide, "ZeroDivisionError: division by zero"),
    "status": (lambda: sys.exit(1), "ended with status 1"),
    "silence": (lambda: sys.exit(2), "a refusal of 0 lines"),
    "two lines": (lambda: refuse("error: a", "error: b"), "a refusal of 2 lines"),
    "no error": (lambda: refuse("no"), "a refusal that is none: no"),
    "long line": (lambda: refuse("error: " + "x" * 3000), "a line of 3007 characters"),
    "warning": (warn, "standard error: UserWarning: of what?"),
    "memory": (take_memory, "MB more"),
    "time": (wait, "TimeLimitExceeded"),
    "file of the user's": (lambda: write("mine/notes.txt"), "changed mine/notes.txt"),
    "removed": (lambda: os.unlink("sky.png"), "removed sky.png"),
    "beside the output": (lambda: write("new/a"), "made new/a"),
    "refused too late": (lambda: write_and_refuse("out/a"), "made out/a"),
    "elsewhere": (write_elsewhere, "wrote outside"),
    "temporary": (leave_a_temporary_file, "left out/.a.7.tmp.txt"),
    "encoding": (print_unencodable_text, "UnicodeEncodeError"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("command", "message"), BREACHES.values(), ids=BREACHES)
def test_forbidden_behaviour_is_detected(attack_folder, monkeypatch, command, message):
    monkeypatch.setattr("drgs.render.main", lambda words: command())
    seconds = 0.5 if command is wait else 20
    wrong = trial(Attack("x", "render", (), encoding="ascii", seconds=seconds), attack_folder)
    assert any(message in line for line in wrong), wrong
    assert trial(Attack("x", "capture", ("--help",)), attack_folder) == []


@pytest.mark.parametrize(
    ("message", "wrong"),
    [("error: a.yml: no", []), ("error: no", ["does not name a.yml: error: no"])],
)
def test_a_refusal_names_the_file(attack_folder, monkeypatch, message, wrong):
    monkeypatch.setattr("drgs.render.main", lambda words: refuse(message))
    assert trial(Attack("x", "render", (), named="a.yml"), attack_folder) == wrong


def test_missing_refusal_is_detected(attack_folder, monkeypatch):
    monkeypatch.setattr("drgs.render.main", lambda words: None)
    assert trial(Attack("x", "render", (), must_refuse=True), attack_folder) == ["was not refused"]


def work(words):
    """Two files, the second of which needs what the first holds."""
    if not os.path.exists("out/a"):
        write("out/a")
    write("out/b")


def forgetful_work(words):
    write("out/b")
    if not os.path.exists("out/b.done"):
        write("out/b.done")
        write("out/a")


@pytest.mark.parametrize(("command", "is_right"), [(work, True), (forgetful_work, False)])
def test_work_lost_after_a_kill_is_detected(attack_folder, monkeypatch, command, is_right):
    monkeypatch.setattr("drgs.render.main", command)
    found = []
    for at in range(14):
        words = (command.__name__,)
        fault = Fault("kill", at)
        attack = Attack("x", "render", words, fault=fault, again=words, results=("a", "b"))
        found += trial(attack, attack_folder)
    stale = [line for line in found if ".tmp" not in line]
    assert (stale == []) is is_right, found


def test_attack_folder_is_restored(attack_folder):
    before = contents(attack_folder.folder)
    (attack_folder.folder / "sky.png").unlink()
    (attack_folder.folder / "mine" / "notes.txt").write_text("changed")
    (attack_folder.folder / "photos").rename(attack_folder.folder / "images")
    (attack_folder.folder / "new").mkdir()
    os.mkfifo(attack_folder.folder / "new" / "pipe")
    assert contents(attack_folder.folder) != before
    attack_folder.restore_files()
    assert contents(attack_folder.folder) == before
