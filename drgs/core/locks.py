"""One writer a folder: a lock that ends with its process, however that ends."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drgs.core.errors import UserError


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Keep ``folder``, which is made if it is missing, for the block.

    The lock (``flock``) is on the folder itself: there is no file that a killed process could leave
    behind. Where the system has no such locks, or the folder cannot be made or opened, nothing is
    kept, and what writes to the folder says why it cannot.

    Raises :class:`UserError` while another process, or another block of this one, keeps it.
    """
    descriptor = _opened(folder)
    try:
        if descriptor is not None:
            _lock(descriptor, folder)
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _opened(folder: Path) -> int | None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return os.open(folder, os.O_RDONLY)
    except OSError:
        return None


def _lock(descriptor: int, folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # not on Windows
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
