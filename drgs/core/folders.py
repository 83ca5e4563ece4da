"""Output folders: one writer at a time, and no foreign file is replaced.

A record, a hidden file in the folder, names each file before it is written, and has its digest once
the command has ended. A file that the record does not name, or that has other bytes, is foreign. A
lock keeps a folder for one process and ends with it.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from drgs.core.errors import UserError, format_names
from drgs.core.files import open_regular, read_text, remove_temporaries_of, write_json

MAX_BYTES = 1 << 26  # of a record: 200 bytes for each of a third of a million files


class _Content(BaseModel):
    """Content of a record. Names are relative to the folder, with slashes."""

    model_config = ConfigDict(strict=True, extra="forbid")
    files: dict[str, str | None] = {}  # digests; None: being written
    paths: dict[str, str] = {}  # relative, by key of a configuration


class FolderRecord:
    """The record that ``command`` keeps of ``folder``."""

    def __init__(self, folder: Path, command: str) -> None:
        """command: one word. Raises :class:`UserError` if the record cannot be read."""
        self.folder, self.path = folder, folder / f".drgs-{command}.json"
        self.exists = os.path.lexists(self.path)
        self._content = _read(self.path) if self.exists else _Content()

    @property
    def paths(self) -> Mapping[str, str]:
        """Paths relative to the folder, by key of a configuration."""
        return self._content.paths

    def has_written(self, name: str) -> bool:
        """Return whether the file was there when the command ended."""
        return bool(self._content.files.get(name))

    def foreign_files(self, names: Iterable[str]) -> list[str]:
        """Return those ``names``, relative to the folder, whose files are foreign."""
        return [name for name in names if self._is_foreign(name)]

    def check(self, names: Iterable[str], earlier: Collection[str] = ()) -> None:
        """Raise :class:`UserError` if one of the files ``names`` is foreign.

        earlier: files of a version without records, accepted if there is no record.
        """
        known = () if self.exists else earlier
        foreign = [name for name in self.foreign_files(names) if name not in known]
        if foreign:
            raise UserError(
                f"{self.folder}: holds {format_names(foreign)}, which this command would replace "
                "and has not written, or which changed since; move that away, or choose another "
                "folder"
            )

    def claim(
        self,
        names: Iterable[str],
        paths: Mapping[str, str] | None = None,
        earlier: Collection[str] = (),
    ) -> None:
        """Record that the files ``names`` will be written, after :meth:`check`.

        Removes half-written ones. paths: added to :attr:`paths`; earlier: see :meth:`check`.
        """
        names = list(names)
        self.check(names, earlier)
        for folder in {self.folder / Path(name).parent for name in names} | {self.folder}:
            here = [Path(name).name for name in names if self.folder / Path(name).parent == folder]
            remove_temporaries_of(folder, [*here, self.path.name])
        claimed = {**({} if self.exists else dict.fromkeys(earlier)), **dict.fromkeys(names)}
        self._update(claimed, paths or {})

    def seal(self, names: Iterable[str] | None = None) -> None:
        """Record the digests of the files, once they are written.

        names: of files that :meth:`claim` has named; None: all that are in the record.
        """
        known = self._content.files if names is None else dict.fromkeys(names)
        files = {}
        for name, recorded in known.items():
            path = self.folder / name
            files[name] = recorded or (digest(path) if path.is_file() else "")
        if self.exists and files != self._content.files:
            self._update(files, {})

    def remove(self) -> None:
        """Remove the record."""
        self.path.unlink(missing_ok=True)
        self.exists, self._content = False, _Content()

    def _is_foreign(self, name: str) -> bool:
        path = self.folder / name
        for parent in (self.folder / part for part in Path(name).parents[:-1]):
            if os.path.lexists(parent) and not parent.is_dir():
                return True
        if not os.path.lexists(path):
            return False
        if name not in self._content.files or path.is_symlink() or not path.is_file():
            return True
        known = self._content.files[name]
        return known is not None and known != digest(path)

    def _update(self, files: Mapping[str, str | None], paths: Mapping[str, str]) -> None:
        """Add to the record as it is now, and remove the files that have an empty digest."""
        with _lock_record(self.path):
            now = _read(self.path) if os.path.lexists(self.path) else _Content()
            kept = {name: known for name, known in {**now.files, **files}.items() if known != ""}
            content = _Content(files=kept, paths={**now.paths, **paths})
            write_json(self.path, content.model_dump())
        self.exists, self._content = True, content


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    sha256 = hashlib.sha256()
    with open_regular(path) as file:
        while chunk := file.read(1 << 20):
            sha256.update(chunk)
    return sha256.hexdigest()


@contextmanager
def _lock_record(record: Path) -> Iterator[None]:
    """Keep other commands from writing a record within the block, if the system has locks.

    Each replaces the file: the lock of one that has been replaced is no longer the record's.
    """
    with ExitStack() as opened:
        with suppress(OSError, ImportError):  # where it cannot be written, the block says so
            import fcntl

            record.parent.mkdir(parents=True, exist_ok=True)
            is_locked = False
            while not is_locked:
                file = opened.enter_context(record.open("ab"))
                fcntl.flock(file, fcntl.LOCK_EX)
                is_locked = os.path.samestat(os.fstat(file.fileno()), record.stat())
        try:
            yield
        finally:
            with suppress(OSError):
                if not record.stat().st_size:  # made here, and not written
                    record.unlink()


def _read(path: Path) -> _Content:
    try:
        text = read_text(path, "record", MAX_BYTES)
        return _Content.model_validate(json.loads(text or "{}"))  # empty: being written
    except UserError:
        raise
    except (ValueError, RecursionError):
        raise UserError(
            f"{path}: must be the record of the files that were written here, as the command left "
            "it; remove it if those files are no longer needed, or choose another folder"
        ) from None


@contextmanager
def sole_writer(folder: Path) -> Iterator[Callable[[], bool]]:
    """Lock ``folder`` for the block, if it exists.

    Yields a function that makes and locks the folder, to be called before anything is written; it
    returns whether it is locked (``flock``): not without locks in the system, nor for folders that
    cannot be made or opened. Both raise :class:`UserError` while another process, or another block
    of this one, has the lock.
    """
    descriptor: int | None = None

    def lock() -> bool:
        nonlocal descriptor
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if descriptor is None:
            descriptor = _lock_folder(folder)
        return descriptor is not None

    try:
        descriptor = _lock_folder(folder)
        yield lock
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _lock_folder(folder: Path) -> int | None:
    """Return a descriptor of the folder that has its lock; None if there is none."""
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
