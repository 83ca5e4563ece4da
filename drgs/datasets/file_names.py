"""Files that a dataset names, also where their names are almost right.

Programs change the case of names, convert photographs to another format, put the folder's name or a
whole path of another machine before them, and separate folders by backslashes.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from drgs.core.errors import UserError, did_you_mean, listed, one_line

PICTURE_SUFFIXES = frozenset(
    {
        *(".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"),
        *(".heic", ".heif", ".dng", ".arw", ".cr2", ".cr3", ".nef"),
    }
)

PICTURE_FOLDERS = ("images", "input", "photos", "rgb")
"""Where converters expect photographs, or put them."""

LEAST_SHARE, LEAST_LEFT = 0.5, 2
"""Smallest share of the named files of a kind that must be there."""

_PICTURE_FOLDER = re.compile(rf"(?:{'|'.join(PICTURE_FOLDERS)})(?:_[0-9]+)?")


def parts_of(name: str) -> list[str]:
    """The folders of a name and its last part; backslashes separate them as well."""
    return [part for part in name.replace("\\", "/").split("/") if part not in ("", ".")]


def key_of(name: str) -> str:
    """The same for names that differ in case, or in how accents are encoded."""
    return unicodedata.normalize("NFC", name).casefold()


def stem_of(name: str) -> str:
    """The name without the suffix of a picture."""
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in PICTURE_SUFFIXES else name


class FileFinder:
    """The files below a folder; each folder is listed once, when a name is not right."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._listings: dict[Path, dict[str, list[str]]] = {}

    def exact(self, name: str) -> Path | None:
        """The file of that name, or of that name with ``.png`` added."""
        for candidate in (self.folder / name, self.folder / f"{name}.png"):
            if os.path.isfile(candidate):  # False, not an error, for a name that no file can have
                return candidate
        return None

    def near(self, name: str, suffixes: Collection[str] = ()) -> list[Path]:
        """Files whose names differ from ``name`` in what programs change.

        suffixes: that the last part may have instead of its own.
        """
        parts = parts_of(name)
        is_elsewhere = name[:1] in ("/", "\\") or name[1:2] == ":" or ".." in parts
        for start in range(len(parts)):
            before = parts[start - 1] if start else ""
            is_folder = _PICTURE_FOLDER.fullmatch(key_of(before)) or before == self.folder.name
            if (start == 0 or is_elsewhere or is_folder) and ".." not in parts[start:]:
                found = self._below(parts[start:], suffixes)
                if found:
                    return found
        return self._below([PICTURE_FOLDERS[0], *parts], suffixes) if ".." not in parts else []

    def find_all(
        self, names: Collection[str], suffixes: Collection[str] = ()
    ) -> tuple[dict[str, Path], dict[str, Path]]:
        """The files by name, and those of them whose names are only nearly right.

        No file of a name that is right, and none of two names, is taken for another one's.
        """
        found = {name: path for name in dict.fromkeys(names) if (path := self.exact(name))}
        missing = [name for name in dict.fromkeys(names) if name not in found]
        near = {name: self.near(name, suffixes) for name in missing}
        candidates = {name: paths[0] for name, paths in near.items() if len(paths) == 1}
        counts = Counter([*found.values(), *candidates.values()])
        candidates = {name: path for name, path in candidates.items() if counts[path] == 1}
        return found | candidates, candidates

    def suggestion(self, name: str, suffixes: Collection[str] = ()) -> str:
        """``"; did you mean X?"``, with a file elsewhere, or of the same digits; else ""."""
        if near := self.near(name, suffixes):
            return f"; did you mean {' or '.join(str(path) for path in near[:3])}?"
        parts = parts_of(name) or [""]
        folder = self.folder.joinpath(*parts[:-1])
        for other in sorted(self.folder.iterdir()):
            if other.is_dir() and self._called(other, parts[-1]):
                return f"; did you mean {other / parts[-1]}?"
        names = [n for names in self._names(folder).values() for n in names]
        same = [n for n in names if re.findall("[0-9]+", n) == re.findall("[0-9]+", parts[-1])]
        return did_you_mean(parts[-1], same)

    def _below(self, parts: Sequence[str], suffixes: Collection[str]) -> list[Path]:
        folders = [self.folder]
        for part in parts[:-1]:
            folders = [f / name for f in folders for name in self._called(f, part)]
        last = parts[-1]
        found = [f / name for f in folders for name in self._called(f, last)]
        if not found and suffixes:
            found = [
                f / name
                for f in folders
                for name in self._called(f, stem_of(last), is_stem=True)
                if os.path.splitext(name)[1].lower() in suffixes
            ]
        return [path for path in found if os.path.isfile(path)]

    def _called(self, folder: Path, name: str, is_stem: bool = False) -> list[str]:
        """Names in ``folder``: the same, or else those that differ in case."""
        names = self._names(folder).get(f"{key_of(name)}.*" if is_stem else key_of(name), [])
        return [name] if name in names else names

    def _names(self, folder: Path) -> dict[str, list[str]]:
        """List a folder by :func:`key_of`; pictures also without their suffixes, with ``.*``."""
        if folder not in self._listings:
            listing: dict[str, list[str]] = {}
            try:
                names = sorted(os.listdir(folder))
            except (OSError, ValueError):  # no folder, or a name that none can have
                names = []
            for name in names:
                listing.setdefault(key_of(name), []).append(name)
                if (stem := stem_of(name)) != name:
                    listing.setdefault(f"{key_of(stem)}.*", []).append(name)
            self._listings[folder] = listing
        return self._listings[folder]


def note_near(source: Path, near: Mapping[str, Path], what: str, notes: list[str]) -> None:
    """Add one note for all files that are there under nearly the names that they should have."""
    if near:
        (name, path), *_ = near.items()
        notes.append(
            f"{source}: taken under nearly the same name: {len(near):,} {what}, such as "
            f"{one_line(path, 200)} for {one_line(name, 100)}"
        )


def note_missing(
    source: Path,
    names: Sequence[str],
    found: Collection[str],
    explain: Callable[[int], str],
    what: tuple[str, str],
    notes: list[str],
) -> None:
    """Add one note that counts and names the files that were not found, if any.

    source: what names them, for the note; explain: the message for the one at an index of
    ``names``; what: the files are called, and what becomes of those that are not there.

    Raises :class:`UserError` where fewer than half were found, or only one of several.
    """
    gone = [index for index, name in enumerate(names) if name not in found]
    if not gone:
        return
    kind, consequence = what
    count = f"{len(gone):,} of {len(names):,} {kind}"
    if len(names) - len(gone) < max(LEAST_SHARE * len(names), LEAST_LEFT):
        raise UserError(f"{explain(gone[0])}; not there: {count}")
    missing = listed([one_line(names[index], 100) for index in gone])
    notes.append(f"{source}: not there: {count} ({missing}); {consequence}")
