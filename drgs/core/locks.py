"""One writer a folder: a lock that ends with its process, however that ends."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from drgs.core.errors import UserError


@contextmanager
def sole_writer(folder: Path) -> Iterator[Callable[[], bool]]:
    """Keep ``folder`` for the block: at once if it is there, else when it is made.

    Yields a function that makes the folder and keeps it, before anything is written into it, and
    returns whether it is kept. The lock (``flock``) is on the folder itself: there is no file that
    a killed process could leave behind. Where the system has no such locks, or the folder cannot
    be made or opened, nothing is kept, and what writes to the folder says why it cannot.

    Raises :class:`UserError` while another process, or another block of this one, keeps it; so does
    the function.
    """
    descriptor: int | None = None

    def keep() -> bool:
        nonlocal descriptor
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if descriptor is None:
            descriptor = _locked(folder)
        return descriptor is not None

    try:
        descriptor = _locked(folder)
        yield keep
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _locked(folder: Path) -> int | None:
    """A descriptor of the folder that holds its lock; None where that cannot be had."""
    try:
        import fcntl

        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except (ImportError, OSError):  # Windows; missing
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
            return None  # a file system without locks
        raise UserError(
            f"{folder}: another command is writing to this folder; wait until it has ended, or "
            "choose another folder"
        ) from None
    return descriptor
