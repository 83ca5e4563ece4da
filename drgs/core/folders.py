"""Folders that commands write into: one writer at a time, and no file of others is replaced.

The record is a hidden file in the folder itself, so that it moves with it. It names a file before
the file is written, and says by a digest what the file was when the command had ended. A file that
is in the way and that the record does not name, or that has other bytes, belongs to others. A lock
keeps a folder for one process and ends with it, however that ends.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from drgs.core.errors import UserError, format_names
from drgs.core.files import atomic_path, open_regular, read_text, remove_temporaries_of

MAX_BYTES = 1 << 26
"""Largest record: 67 MB, two hundred bytes for each of a third of a million files."""

_CHUNK = 1 << 20


class _Content(BaseModel):
    """Content of the file. Names are relative to the folder, with slashes."""

    model_config = ConfigDict(strict=True, extra="forbid")
    files: dict[str, str | None] = {}  # digests; None: being written
    paths: dict[str, str] = {}  # relative, by key of a configuration


class FolderRecord:
    """The record that ``command`` keeps of ``folder``."""

    def __init__(self, folder: Path, command: str) -> None:
        """command: one word; each command knows its own files only.

        Raises :class:`UserError` where the record cannot be read.
        """
        self.folder, self.path = folder, folder / f".drgs-{command}.json"
        self.exists = os.path.lexists(self.path)
        self._content = _read(self.path) if self.exists else _Content()

    @property
    def paths(self) -> Mapping[str, str]:
        """Paths that were kept besides, relative to the folder, by key of a configuration."""
        return self._content.paths

    def strangers(self, names: Iterable[str]) -> list[str]:
        """Return the ``names`` (relative to the folder) of files that belong to others."""
        return [name for name in names if self._is_strange(name)]

    def check(self, names: Iterable[str], earlier: Collection[str] = ()) -> None:
        """Raise :class:`UserError` where one of the files ``names`` is somebody else's.

        earlier: those of a version that kept no record; looked at where there is none.
        """
        known = () if self.exists else earlier
        strangers = [name for name in self.strangers(names) if name not in known]
        if strangers:
            raise UserError(
                f"{self.folder}: holds {format_names(strangers)}, which this command would replace "
                "and has not written, or which changed since; move that away, or choose another "
                "folder"
            )

    def claim(
        self,
        names: Iterable[str],
        paths: Mapping[str, str] | None = None,
        earlier: Collection[str] = (),
    ) -> None:
        """Note that the files ``names`` are written from now on; remove half-written ones.

        paths: kept besides, see :attr:`paths`; earlier: as for :meth:`check`, which comes first.
        """
        names = list(names)
        self.check(names, earlier)
        remove_temporaries_of(self.folder, [*names, self.path.name])
        known = self._content.files if self.exists else dict.fromkeys(earlier)
        claimed = {**known, **dict.fromkeys(names)}
        self._write(_Content(files=claimed, paths={**self.paths, **(paths or {})}))

    def seal(self) -> None:
        """Note what the files are, now that all of them are written."""
        if not self.exists:
            return
        there = [name for name in self._content.files if (self.folder / name).is_file()]
        files: dict[str, str | None] = {
            name: self._content.files[name] or digest(self.folder / name) for name in there
        }
        if files != self._content.files:
            self._write(_Content(files=files, paths=dict(self.paths)))

    def remove(self) -> None:
        """Forget all of it."""
        self.path.unlink(missing_ok=True)
        self.exists, self._content = False, _Content()

    def _is_strange(self, name: str) -> bool:
        path = self.folder / name
        if not os.path.lexists(path):
            return False
        if name not in self._content.files or path.is_symlink() or not path.is_file():
            return True
        known = self._content.files[name]
        return known is not None and known != digest(path)

    def _write(self, content: _Content) -> None:
        with atomic_path(self.path) as temporary:
            temporary.write_text(
                json.dumps(content.model_dump(), indent=1) + "\n", encoding="utf-8"
            )
        self.exists, self._content = True, content


def digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, as text; :class:`UserError` where it cannot be read."""
    found = hashlib.sha256()
    with open_regular(path) as file:
        while chunk := file.read(_CHUNK):
            found.update(chunk)
    return found.hexdigest()


def _read(path: Path) -> _Content:
    try:
        return _Content.model_validate(json.loads(read_text(path, "record", MAX_BYTES)))
    except UserError:
        raise
    except (ValueError, RecursionError):
        raise UserError(
            f"{path}: must be the record of the files that were written here, as the command left "
            "it; remove it if those files are no longer needed, or choose another folder"
        ) from None


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
            descriptor = _lock_folder(folder)
        return descriptor is not None

    try:
        descriptor = _lock_folder(folder)
        yield keep
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _lock_folder(folder: Path) -> int | None:
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
