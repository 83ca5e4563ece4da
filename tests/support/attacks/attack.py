"""The type of an attack, and an observer of files that may let a change of one fail.

Python announces whatever it is about to do to the file system to audit hooks, which may raise
instead. A hook stays until the process ends: there is one, which does nothing between trials.
"""

from __future__ import annotations

import errno
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

CHANGES = {
    **dict.fromkeys(("open", "os.remove", "os.mkdir", "os.rmdir", "os.truncate"), 0),
    **dict.fromkeys(("os.chmod", "os.chown"), 0),
    **dict.fromkeys(("os.rename", "os.link", "os.symlink"), 1),
}
"""Events that change files, and which of their arguments is the path."""

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC

KINDS = ("full", "denied", "kill", "interrupt")
"""Faults at a change: no space left; no permission to remove or replace; SIGKILL; Ctrl-C."""

SMALL_FILES = "small files"  # another fault: writing stops when a file has ``at`` bytes


class Killed(BaseException):
    """In place of SIGKILL: from here on nothing that the program does has an effect."""


@dataclass(frozen=True)
class Fault:
    """Strikes at change number ``at`` of the attack folder's files, counted from 0."""

    kind: str  # one of KINDS, or SMALL_FILES
    at: int

    def strike(self, number: int, event: str, path: str) -> None:
        """Called before each change; path: within the attack folder."""
        if number < self.at or self.kind == SMALL_FILES:
            return
        if self.kind == "kill":
            raise Killed
        if self.kind == "interrupt" and number == self.at:
            signal.raise_signal(signal.SIGINT)
        if self.kind == "full" and event in ("open", "os.mkdir", "os.rename"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if self.kind == "denied" and event in ("os.remove", "os.rename", "os.rmdir"):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


@dataclass
class Changes:
    """The changes of files by a trial, in order."""

    folder: Path  # of the attack folder
    fault: Fault | None = None
    inside: list[tuple[str, str]] = field(default_factory=list)  # (event, path in the folder)
    outside: list[str] = field(default_factory=list)  # paths

    def add(self, event: str, path: str) -> None:
        """Note one; may raise what the fault raises."""
        if not f"{path}{os.sep}".startswith(f"{self.folder}{os.sep}"):
            self.outside.append(path)
            return
        number, path = len(self.inside), os.path.relpath(path, self.folder)
        self.inside.append((event, path))
        if self.fault is not None:
            self.fault.strike(number, event, path)


_observing: list[Changes] = []  # at most one; a hook cannot be told anything else


def _hook(event: str, arguments: tuple) -> None:
    if not _observing or event not in CHANGES:
        return
    path = arguments[CHANGES[event]]
    if not isinstance(path, (str, bytes, os.PathLike)):
        return  # a file that is open already
    if event == "open":
        _, mode, flags = arguments
        if not (flags & WRITING if mode is None else set(mode) & set("wax+")):
            return
    _observing[0].add(event, os.path.abspath(os.fsdecode(path)))


@cache
def _install_hook() -> None:
    sys.addaudithook(_hook)


@contextmanager
def observed(folder: Path, fault: Fault | None = None) -> Iterator[Changes]:
    """Within the block, changes are noted, and the fault strikes."""
    _install_hook()
    changes = Changes(folder, fault)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    if fault is not None and fault.kind == SMALL_FILES:
        resource.setrlimit(resource.RLIMIT_FSIZE, (fault.at, limits[1]))
    _observing.append(changes)
    try:
        yield changes
    finally:
        _observing.clear()
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


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
