"""Reading regular files of a bounded size, and atomic writing.

Errors of the file system become a :class:`drgs.core.errors.UserError`.
"""

from __future__ import annotations

import errno
import json
import os
import re
import stat
import threading
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

import psutil

from drgs.core.errors import UserError, one_line
from drgs.core.memory import require_memory

if TYPE_CHECKING:
    import numpy as np

_DENIED, _BLOCKED = (errno.EACCES, errno.EPERM, errno.EROFS), (errno.ENOTDIR, errno.EEXIST)
_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "free some space, or choose another disk"),
    **dict.fromkeys(_DENIED, "choose a folder that you may write to"),
    **dict.fromkeys(_BLOCKED, "choose another folder: a part of this path is a file"),
    errno.EISDIR: "remove or rename the folder of this name",
    errno.ENAMETOOLONG: "choose a shorter name",
}

STEM_BYTES = 200  # of a derived file name, before numbers and suffixes


def shorten_stem(stem: str) -> str:
    """Return ``stem``, cut to ``STEM_BYTES`` bytes."""
    encoded = os.fsencode(stem)
    if len(encoded) <= STEM_BYTES:
        return stem
    return encoded[:STEM_BYTES].decode("utf-8", "ignore")


# By the first letter of ``ls -l``.
_IRREGULAR_FILES = {"p": "a named pipe", "c": "a device", "b": "a device", "s": "a socket"}


def open_regular(path: str | Path, what: str = "file", max_bytes: int | None = None) -> IO[bytes]:
    """Open a regular file for reading; what: its kind, for messages.

    Raises :class:`UserError` if it cannot be opened, is no regular file (a pipe may wait for a
    writer, a device need not end), or has more than ``max_bytes``.
    """

    def open_without_waiting(path: str, flags: int) -> int:
        return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))

    try:
        file = open(path, "rb", opener=open_without_waiting)  # noqa: SIM115  (the caller closes it)
    except (OSError, ValueError) as error:  # the latter: a name with a zero byte
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{one_line(path)}: cannot read the {what}: {reason}") from None
    status = os.fstat(file.fileno())
    reason = None
    if not stat.S_ISREG(status.st_mode):
        kind = _IRREGULAR_FILES.get(stat.filemode(status.st_mode)[0], "something else")
        reason = f"must be a regular file, got {kind}"
    elif max_bytes is not None and status.st_size > max_bytes:
        reason = f"more than {max_bytes:,} bytes"
    if reason is not None:
        file.close()
        raise UserError(f"{path}: cannot read the {what}: {reason}")
    return file


def read_bytes(path: Path, what: str, max_bytes: int, memory_ratio: int = 1) -> bytes:
    """Return the content of a regular file; what: its kind, for messages.

    memory_ratio: memory that the caller needs, in file sizes. Raises :class:`UserError` if it
    cannot be read, has more than ``max_bytes``, or takes more memory than is available.
    """
    try:
        with open_regular(path, what, max_bytes) as file:
            # read() allocates all that it may return. Files of the system have a size of 0.
            size = max(os.fstat(file.fileno()).st_size, 1 << 16)
            require_memory(path, memory_ratio * size, f"the {what}")
            content = file.read(min(size, max_bytes) + 1)
    except OSError as error:
        raise UserError(f"{path}: cannot read the {what}: {error.strerror or error}") from None
    if len(content) > max_bytes:
        raise UserError(f"{path}: cannot read the {what}: more than {max_bytes:,} bytes")
    return content


def read_text(path: Path, what: str, max_bytes: int, memory_ratio: int = 2) -> str:
    """Return the text of a UTF-8 file, without a byte order mark; see :func:`read_bytes`."""
    try:
        return read_bytes(path, what, max_bytes, memory_ratio).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path}: cannot read the {what}: not UTF-8 text (byte {error.start})"
        ) from None


@contextmanager
def refuse_damage(where: str) -> Iterator[None]:
    """Turn all errors of a block into the user's: libraries raise many types for a broken file.

    where: start of the message, such as ``a.png: cannot read the image``.
    """
    try:
        yield
    except (UserError, MemoryError):
        raise
    except Exception as error:
        reason = getattr(error, "strerror", None) or one_line(error, 200) or type(error).__name__
        raise UserError(f"{where}: {reason}") from None


def read_arrays(path: Path, what: str) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file of ``np.savez``; see :func:`read_bytes`."""
    import numpy as np  # a list of commands needs none

    with open_regular(path, what) as file, refuse_damage(f"{path}: cannot read the {what}"):
        size = os.fstat(file.fileno()).st_size
        with zipfile.ZipFile(file) as archive:
            if sum(part.file_size for part in archive.infolist()) > size:
                raise ValueError("its arrays are larger than the file")
        file.seek(0)
        require_memory(path, size, f"the {what}")
        try:
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except MemoryError as error:  # there is enough for the file: a header is wrong
            raise ValueError(error) from None


_TEMPORARY_NAME = re.compile(r"\.(.*)\.(\d{1,9})(?:-\d+)?\.tmp(\.[^.]*)?")
"""Names that :func:`atomic_path` makes: .STEM.PROCESS-THREAD.tmp.SUFFIX."""


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it when the block ends without an error.

    Missing parent folders are created. After an error the old file is unchanged.

    Raises :class:`UserError` for an OSError, also within the block.
    """
    path = Path(path)
    # The suffix stays last: image writers choose the format by it.
    writer = f"{os.getpid()}-{threading.get_ident()}"
    temporary = path.with_name(f".{shorten_stem(path.stem)}.{writer}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise UserError(f"{path}: cannot write the file: {refusal_reason(error)}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_together(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files that are one result, read by its ``.json``: a stop leaves the earlier, or none.

    files: contents by path in the folder. All are complete before the first one gets its name, the
    earlier ``.json`` are removed before that, and new ones come last.
    """
    indices = [name for name in files if name.endswith(".json")]
    with ExitStack() as renames:  # in reverse order
        for name in dict.fromkeys([*reversed(indices), *files]):
            renames.enter_context(atomic_path(folder / name)).write_bytes(files[name])
        for name in indices if len(files) > 1 else ():
            (folder / name).unlink(missing_ok=True)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file, in one piece; see :func:`atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_json(path: Path, content: object, indent: int = 1) -> None:
    """Write a file of JSON, in one piece."""
    write_bytes(path, (json.dumps(content, indent=indent) + "\n").encode())


def remove_stale_temporaries(folder: Path) -> None:
    """Remove temporary files of killed writers in ``folder`` and below it."""
    for path in folder.rglob(".*.tmp*"):
        if is_temporary(path.name):
            with suppress(OSError):
                path.unlink()


def remove_temporaries_of(folder: Path, names: Iterable[str]) -> None:
    """Remove temporary files in ``folder`` for the files ``names``, unless their writers run."""
    wanted = {(shorten_stem(path.stem), path.suffix) for path in map(Path, names)}
    for path in folder.glob(".*.tmp*"):
        match = _TEMPORARY_NAME.fullmatch(path.name)
        if match and (match[1], match[3] or "") in wanted and not psutil.pid_exists(int(match[2])):
            with suppress(OSError):
                path.unlink()


def is_temporary(name: str) -> bool:
    """Return whether a file of this name is a temporary one of :func:`atomic_path`."""
    return _TEMPORARY_NAME.fullmatch(name) is not None


def refusal_reason(error: OSError) -> str:
    """Return the file system's reason and, if known, a remedy."""
    reason = error.strerror or str(error) or type(error).__name__
    remedy = _REMEDIES.get(error.errno or 0)
    return f"{reason}; {remedy}" if remedy else reason
