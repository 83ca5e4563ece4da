"""The type of an attack."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from support.attacks.observer import Fault


def _nothing(folder: Path) -> None:
    pass


@dataclass(frozen=True)
class Attack:
    """A command line in the attack folder's folder, after its files were changed.

    A refusal is expected to be one line with status 2 that changes no file; a success, status 0,
    changes nothing outside the folder ``out``.
    """

    name: str  # of its own, for ever: family/what/which
    command: str  # fit, render or capture
    words: tuple[str, ...]  # of the command line
    change: Callable[[Path], None] = _nothing  # of the files, before; takes the folder
    out: str = "out"  # folder, within the attack folder's, that belongs to the command
    theirs: tuple[str, ...] = ()  # paths, in ``out`` as well, that are the user's
    named: str = ""  # part of every refusal's message
    encoding: str = "utf-8"  # of the standard output
    fault: Fault | None = None
    again: tuple[str, ...] = ()  # words that mend what the fault broke; (): none can
    results: tuple[str, ...] = ()  # files in ``out`` that are then as if nothing had happened
    seconds: float = 20.0  # it may take, twice what the slowest takes on a busy machine
    megabytes: float = 400.0  # by which memory may grow at its peak
    risky: bool = False  # it may end the process, or hang in native code
    is_long: bool = False  # a fit is expected, or another work of more than milliseconds
    draws: bool = False  # a fit draws its curves, orbit and page, which takes seconds
    must_refuse: bool = False  # status 0 is wrong
