"""Reading regular files of a bounded size, and writing so that a reader never sees half of a file.

What the file system refuses becomes a :class:`drgs.core.errors.UserError`: a missing folder, a
lacking permission or a full disk is the user's to repair.
"""

from __future__ import annotations

import errno
import os
import re
import stat
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

import psutil

from drgs.core.errors import UserError, one_line
from drgs.core.memory import require_memory

if TYPE_CHECKING:
    import numpy as np

_REMEDIES = {
    errno.ENOSPC: "free some space, or choose another disk",
    errno.EDQUOT: "free some space, or choose another disk",
    errno.EACCES: "choose a folder that you may write to",
    errno.EPERM: "choose a folder that you may write to",
    errno.EROFS: "choose a folder that you may write to",
    errno.ENOTDIR: "choose another folder: a part of this path is a file",
    errno.EEXIST: "choose another folder: a part of this path is a file",
    errno.EISDIR: "remove or rename the folder of this name",
    errno.ENAMETOOLONG: "choose a shorter name",
}


STEM_BYTES = 200  # bytes of a file's name that is made of another: numbers and suffixes follow


def shorten_stem(stem: str) -> str:
    """The beginning of ``stem``, or all of it: as much as a file's name has room for."""
    encoded = os.fsencode(stem)
    if len(encoded) <= STEM_BYTES:
        return stem
    return encoded[:STEM_BYTES].decode("utf-8", "ignore")


_SPECIAL = {"p": "a named pipe", "c": "a device", "b": "a device", "s": "a socket"}
"""Names of irregular files, by the first letter of ``ls -l``."""


def open_regular(path: str | Path, what: str = "file", max_bytes: int | None = None) -> IO[bytes]:
    """Open a regular file for reading; ``what`` it should be stands in the errors.

    A pipe would wait for a writer for ever, and a device need not end: neither is read.

    Raises :class:`UserError` where it cannot be opened, is something else, or has more than
    ``max_bytes``.
    """
    try:
        file = open(path, "rb", opener=_open_without_waiting)  # noqa: SIM115  (the caller closes it)
    except (OSError, ValueError) as error:  # the latter: a name with a zero byte
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{one_line(path)}: cannot read the {what}: {reason}") from None
    status = os.fstat(file.fileno())
    reason = None
    if not stat.S_ISREG(status.st_mode):
        kind = _SPECIAL.get(stat.filemode(status.st_mode)[0], "something else")
        reason = f"must be a regular file, got {kind}"
    elif max_bytes is not None and status.st_size > max_bytes:
        reason = f"more than {max_bytes:,} bytes"
    if reason is not None:
        file.close()
        raise UserError(f"{path}: cannot read the {what}: {reason}")
    return file


def _open_without_waiting(path: str, flags: int) -> int:
    """Open a file; that of a pipe would otherwise wait for its other end."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def read_bytes(path: Path, what: str, max_bytes: int, memory_ratio: int = 1) -> bytes:
    """The content of a regular file; ``what`` it should be stands in the errors.

    memory_ratio: how many times the file's size the caller takes.

    Raises :class:`UserError` where it cannot be read, is longer than ``max_bytes``, or takes more
    memory than is available.
    """
    try:
        with open_regular(path, what, max_bytes) as file:
            # No more is asked for than there is: so much memory is allocated beforehand. Files of
            # the system claim to be empty.
            size = max(os.fstat(file.fileno()).st_size, 1 << 16)
            require_memory(path, memory_ratio * size, f"the {what}")
            content = file.read(min(size, max_bytes) + 1)
    except OSError as error:
        raise UserError(f"{path}: cannot read the {what}: {error.strerror or error}") from None
    if len(content) > max_bytes:
        raise UserError(f"{path}: cannot read the {what}: more than {max_bytes:,} bytes")
    return content


def read_text(path: Path, what: str, max_bytes: int, memory_ratio: int = 2) -> str:
    """The text of a UTF-8 file, without the mark of byte order that some editors write first.

    Raises :class:`UserError` as :func:`read_bytes` does, and where the file is not UTF-8.
    """
    try:
        return read_bytes(path, what, max_bytes, memory_ratio).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path}: cannot read the {what}: not UTF-8 text (byte {error.start})"
        ) from None


def read_arrays(path: Path, what: str) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file that ``np.savez`` wrote; what: as for the above.

    Raises :class:`UserError` for a file that cannot be read, is damaged, or too large for memory.
    """
    import numpy as np  # a list of commands needs none

    with open_regular(path, what) as file:
        try:
            size = os.fstat(file.fileno()).st_size
            with zipfile.ZipFile(file) as archive:
                if sum(part.file_size for part in archive.infolist()) > size:
                    raise ValueError("its arrays are larger than the file")
            file.seek(0)
            require_memory(path, size, f"the {what}")
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except UserError:
            raise
        except Exception as error:  # zipfile and NumPy raise many types for a broken file
            reason = one_line(error) or type(error).__name__
            raise UserError(f"{path}: cannot read the {what}: {reason}") from None


_TEMPORARY_NAME = re.compile(r"\.(.*)\.(\d{1,9})\.tmp(\.[^.]*)?")
"""Names that :func:`atomic_path` makes: .STEM.PROCESS.tmp.SUFFIX."""


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that replaces it when the block ends without an error.

    Missing parent folders are created. After an error the old file is still there, unchanged, and
    the temporary one is gone.

    Raises :class:`UserError` where the file system refuses, also within the block.
    """
    path = Path(path)
    # The suffix stays last: image writers choose the format by it.
    temporary = path.with_name(f".{shorten_stem(path.stem)}.{os.getpid()}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise UserError(f"{path}: cannot write the file: {refusal_reason(error)}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_stale_temporaries(folder: Path) -> None:
    """Remove what writers that were killed have left behind, in ``folder`` and below it."""
    for path in folder.rglob(".*.tmp*"):
        if is_temporary(path.name):
            with suppress(OSError):
                path.unlink()


def remove_temporaries_of(folder: Path, names: Iterable[str]) -> None:
    """Remove what writers of the files ``names`` that were killed have left behind in ``folder``.

    Those that still run keep theirs, and so do writers of other files.
    """
    wanted = {(shorten_stem(path.stem), path.suffix) for path in map(Path, names)}
    for path in folder.glob(".*.tmp*"):
        found = _TEMPORARY_NAME.fullmatch(path.name)
        if found and (found[1], found[3] or "") in wanted and not psutil.pid_exists(int(found[2])):
            with suppress(OSError):
                path.unlink()


def is_temporary(name: str) -> bool:
    """Return whether a file of this name is one that :func:`atomic_path` was writing."""
    return _TEMPORARY_NAME.fullmatch(name) is not None


def refusal_reason(error: OSError) -> str:
    """Return the file system's reason, and what to do about it where that is known."""
    reason = error.strerror or str(error) or type(error).__name__
    remedy = _REMEDIES.get(error.errno or 0)
    return f"{reason}; {remedy}" if remedy else reason
