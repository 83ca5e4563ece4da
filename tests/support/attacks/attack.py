"""The type of an attack."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from support.attacks.observer import Fault


@dataclass(frozen=True)
class Attack:
    """A command line in the attack folder's folder, after its files were changed.

    A refusal is expected to be one line with status 2 that changes no file; a success, status 0,
    changes nothing outside the folder ``out``.
    """

    name: str  # family/what/which
    command: str  # fit, render or capture
    words: tuple[str, ...]  # of the command line
    change: Callable[[Path], None] = lambda folder: None  # of the files, before
    out: str = "out"  # folder, within the attack folder's, that belongs to the command
    theirs: tuple[str, ...] = ()  # paths, in ``out`` as well, that are the user's
    named: str = ""  # part of every refusal's message
    encoding: str = "utf-8"  # of the standard output
    fault: Fault | None = None
    results: tuple[str, ...] = ()  # files in ``out`` that the same command mends after the fault
    seconds: float = 20.0  # it may take, twice what the slowest takes on a busy machine
    megabytes: float = 400.0  # by which memory may grow at its peak
    draws: bool = False  # a fit draws its curves, orbit and page, which takes seconds
    must_refuse: bool = False  # status 0 is wrong


def label(text: str) -> str:
    """Name a value: by itself, or by its beginning and its length."""
    printable = ascii(text)[1:-1]
    return printable if len(printable) <= 40 else f"{printable[:10]}... ({len(text)})"
