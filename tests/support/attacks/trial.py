"""One attack, run in this process, and what it did that no command may do."""

from __future__ import annotations

import fcntl
import os
import re
import resource
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path

from drgs.__main__ import commands
from support.attacks.attack import Attack, Changes, Killed, observed
from support.attacks.attack_folder import AttackFolder, contents, current_folder, stub_results

PIPE_BYTES = 1 << 20  # limit of a command's output

CACHES = re.compile(
    r"/(\.drjit|\.cache|__pycache__|\.nv|\.config/matplotlib)(/|$)|^/dev/(null|tty)$|^/proc/self/"
)
"""Paths outside the attack folder that may be written: of libraries, and of these trials."""

TEMPORARY = re.compile(r"\.[^/]*\.\d+\.tmp(\.[^/]*)?$")

MAX_REFUSAL_CHARS = 2000  # in a refusal, beside what the user wrote
ADDRESS_SPACE = 4 << 30  # bytes by which it may grow: compilers reserve more than they use

MAY_CHANGE = {"fit": {"out", "stopped", "run"}, "render": {"out"}, "capture": {"out", "captured"}}
"""Folders in which a command may change existing files."""


class TimeLimitExceeded(BaseException):
    """The trial's time is up."""


@dataclass
class Outcome:
    """Exit status and standard error output of a process."""

    status: int | None = None  # None: another exception ended it
    err: str = ""
    megabytes: float = 0.0  # by which memory grew at its peak
    changes: Changes = field(default_factory=lambda: Changes(Path()))


def trial(attack: Attack, attack_folder: AttackFolder) -> list[str]:
    """Run an attack and put the attack folder back; what is wrong, in a line each."""
    try:
        with current_folder(attack_folder.folder):
            attack.change(attack_folder.folder)
            before = contents(attack_folder.folder)
            outcome = run(attack)
            wrong = [*faults_of(attack, outcome), *damage(attack, outcome, before, attack_folder)]
            if attack.results and outcome.status != 0:
                wrong += recovery(attack, attack_folder)
        return wrong
    finally:
        attack_folder.restore_files()


def run(attack: Attack) -> Outcome:
    """Call the command as its process would be; in the current folder."""
    main = import_module(commands()[attack.command].module).main
    outcome = Outcome()
    with (
        nullcontext() if attack.draws else stub_results(),
        _captured(attack.encoding, outcome),
        _measured(outcome, attack.seconds),
        observed(Path.cwd(), attack.fault) as outcome.changes,
    ):
        try:
            main(list(attack.words))
            outcome.status = 0
        except SystemExit as end:
            outcome.status = end.code if isinstance(end.code, int) else 0 if not end.code else 1
        except Killed:
            outcome.status = 137
        except TimeLimitExceeded:
            print(f"did not end within {attack.seconds:g} s", file=sys.stderr)
            traceback.print_exc()
        except BaseException:  # as Python itself ends a process
            traceback.print_exc()
    return outcome


def faults_of(attack: Attack, outcome: Outcome) -> list[str]:
    """Return faults of its end and its output."""
    wrong, kind = [], attack.fault.kind if attack.fault else None
    if outcome.status not in (0, {"kill": 137, "interrupt": 130}.get(kind, 2)):
        reached = "an exception" if outcome.status is None else f"status {outcome.status}"
        return [f"ended with {reached}: {_last_lines(outcome.err)}"]
    if attack.must_refuse and outcome.status == 0:
        wrong.append("was not refused")
    if outcome.status == 2:
        wrong += _wrong_refusal(attack, outcome.err)
    elif "Traceback" in outcome.err or "Warning" in outcome.err:
        wrong.append(f"standard error: {_last_lines(outcome.err)}")
    if outcome.megabytes > attack.megabytes:
        wrong.append(f"took {outcome.megabytes:.0f} MB more")
    tried = f"{os.path.normpath(attack.out)}/"  # a device, of which no folder can be made
    paths = (p for p in outcome.changes.outside if not f"{p}/".startswith(tried))
    if outside := [path for path in paths if not CACHES.search(path)]:
        wrong.append(f"wrote outside: {outside[:3]}")
    return wrong


def _wrong_refusal(attack: Attack, err: str) -> list[str]:
    wrong, lines = [], err.splitlines()
    if len(lines) != 1:
        wrong.append(f"a refusal of {len(lines)} lines: {_last_lines(err)}")
    elif "error: " not in lines[0]:
        wrong.append(f"a refusal that is none: {lines[0]}")
    if max(map(len, lines), default=0) > MAX_REFUSAL_CHARS + sum(map(len, attack.words)):
        wrong.append(f"a line of {max(map(len, lines))} characters")
    if attack.named and attack.named not in err:
        wrong.append(f"does not name {attack.named}: {_last_lines(err)}")
    return wrong


def damage(
    attack: Attack, outcome: Outcome, before: dict[str, str], attack_folder: AttackFolder
) -> list[str]:
    """Return faults of the files that it left."""
    after, wrong = contents(attack_folder.folder), []
    own = os.path.normpath(attack.out) if "\0" not in attack.out else ""

    def is_own(path: str) -> bool:
        return own == "." or path == own or path.startswith(f"{own}/")

    # A refusal in the midst of a fit leaves what --resume needs, and says so.
    kept = outcome.status != 2 or "--resume" in outcome.err or attack.fault is not None
    may_change = kept and own in MAY_CHANGE[attack.command]
    for path, what in before.items():
        is_users = path in attack.theirs or not is_own(path)
        if after.get(path) != what and (is_users or not may_change):
            wrong.append(f"{'changed' if path in after else 'removed'} {path}")
    for path in after.keys() - before.keys():
        if TEMPORARY.search(path):
            if attack.fault is None or attack.fault.kind not in ("kill", "denied"):
                wrong.append(f"left {path}")
        elif not (kept and (is_own(path) or own.startswith(f"{path}/"))):
            wrong.append(f"made {path}")
    return sorted(wrong)


def recovery(attack: Attack, attack_folder: AttackFolder) -> list[str]:
    """Return faults after the command was run again, as its user would."""
    outcome = run(replace(attack, fault=None))
    if outcome.status != 0:
        return [f"again: ended with {outcome.status}: {_last_lines(outcome.err)}"]
    found = contents(attack_folder.folder / attack.out)
    expected = files_without_faults(attack, attack_folder)
    changed = [n for n in attack.results if n in found and found[n] != expected.get(n)]
    return [
        *(f"again: left {path}" for path in found if TEMPORARY.search(path)),
        *(f"again: {name} is missing" for name in expected.keys() - found.keys()),
        *(f"again: {name} is too much" for name in found.keys() - expected.keys()),
        *(f"again: {name} has other bytes" for name in changed),
    ]


def files_without_faults(attack: Attack, attack_folder: AttackFolder) -> dict[str, str]:
    """Return the command's files when nothing happens; puts the attack folder back."""
    key = attack.command, attack.words
    if key not in attack_folder.undisturbed:
        attack_folder.restore_files()
        attack.change(attack_folder.folder)
        outcome = run(replace(attack, fault=None))
        assert outcome.status == 0, outcome.err
        attack_folder.undisturbed[key] = contents(attack_folder.folder / attack.out)
    return attack_folder.undisturbed[key]


def _last_lines(text: str) -> str:
    lines = [line.strip() for line in text.strip().splitlines() if line.strip(" ^~")]
    if any("Traceback" in line for line in lines):
        places = [line for line in lines if line.startswith("File ") and "/drgs/" in line]
        place = re.compile(r'File ".*/(drgs/[^"]*)", line (\d+), in (\w+)')
        lines = [*(place.sub(r"\1:\2 \3", line) for line in places[-1:]), lines[-1]]
    return " | ".join(line[:400] for line in lines[-3:])


@contextmanager
def _captured(encoding: str, outcome: Outcome) -> Iterator[None]:
    """Standard error, also what libraries write to it, through a pipe that holds it all."""
    kept, null, (pipe, end) = [os.dup(1), os.dup(2)], os.open(os.devnull, os.O_WRONLY), os.pipe()
    fcntl.fcntl(end, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    sys.stdout.flush()
    sys.stderr.flush()
    for number, target in ((1, null), (2, end)):
        os.dup2(target, number)
        os.close(target)
    try:
        with (
            open(1, "w", encoding=encoding, closefd=False) as out,
            open(2, "w", 1, encoding, "backslashreplace", closefd=False) as err,
            redirect_stdout(out),
            redirect_stderr(err),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("always")
            for kind in (DeprecationWarning, PendingDeprecationWarning, ResourceWarning):
                warnings.simplefilter("ignore", kind)
            warnings.showwarning = lambda text, kind, *_, **__: print(
                f"{kind.__name__}: {text}", file=sys.stderr
            )
            yield
    finally:
        for number, copy in enumerate(kept, 1):
            os.dup2(copy, number)  # closes the pipe's end
            os.close(copy)
        with open(pipe, "rb") as file:
            outcome.err = file.read().decode("utf-8", "replace")


@contextmanager
def _measured(outcome: Outcome, seconds: float) -> Iterator[None]:
    """Ends the block by :class:`TimeLimitExceeded`; bounds and measures memory."""

    def ring(number: int, frame: object) -> None:
        raise TimeLimitExceeded

    previous, interrupt = signal.signal(signal.SIGALRM, ring), signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resident, hard = _memory("VmRSS"), limits[1]
    most = _memory("VmSize") * 1024 + ADDRESS_SPACE
    resource.setrlimit(resource.RLIMIT_AS, (most if hard < 0 else min(most, hard), hard))
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)
        signal.signal(signal.SIGINT, interrupt)
        resource.setrlimit(resource.RLIMIT_AS, limits)
        outcome.megabytes = (_memory("VmHWM") - resident) / 1024


def _memory(key: str) -> int:
    """KiB, of this process."""
    status = Path("/proc/self/status").read_text()
    return int(re.search(rf"^{key}:\s+(\d+)", status, re.M).group(1))
