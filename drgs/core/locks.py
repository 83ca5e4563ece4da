"""One writer a folder: a lock that ends with its process, however that ends."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from drgs.core.errors import UserError


@contextmanager
def sole_writer(folder: Path) -> Iterator[Callable[[], None]]:
    """Keep ``folder`` for the block: at once if it is there, else when it is made.

    Yields a function that makes the folder and keeps it, before anything is written into it. The
    lock (``flock``) is on the folder itself: there is no file that a killed process could leave
    behind. Where the system has no such locks, or the folder cannot be made or opened, nothing is
    kept, and what writes to the folder says why it cannot.

    Raises :class:`UserError` while another process, or another block of this one, keeps it; so does
    the function.
    """
    kept: list[int] = []

    def keep() -> None:
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if not kept:
            _open(folder, kept)

    try:
        _open(folder, kept)
        yield keep
    finally:
        for descriptor in kept:
            os.close(descriptor)


def _open(folder: Path, kept: list[int]) -> None:
    """Append the locked folder to ``kept``, unless it is missing."""
    with suppress(OSError):
        kept.append(os.open(folder, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0)))
        _lock(kept[-1], folder)


def _lock(descriptor: int, folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
            return  # a file system without locks
        raise UserError(
            f"{folder}: another fit is writing to this folder; wait until it has ended, or choose "
            "another with --out"
        ) from None
