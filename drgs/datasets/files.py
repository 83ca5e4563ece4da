"""Files of a dataset: images with slightly different names than recorded, and masks.

Programs change the case of names, convert photographs to another format, put the folder's name or a
whole path of another machine before them, and separate folders by backslashes.

A photograph ``a.jpg`` has the mask ``a.jpg.png`` (COLMAP), ``a.png``, ``a_mask.png`` (Metashape),
``a.jpg.mask.png`` or ``a.mask.png`` (RealityScan), in any case and with the suffix of any image, in
the folder ``masks`` or ``mask``, or, for the last three, beside the photographs.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from drgs.core.errors import UserError, format_names, one_line

IMAGE_SUFFIXES = frozenset(
    {
        *(".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"),
        *(".heic", ".heif", ".dng", ".arw", ".cr2", ".cr3", ".nef"),
    }
)

IMAGE_FOLDERS = ("images", "input", "photos", "rgb")  # of photographs, for converters

_IMAGE_FOLDER = re.compile(rf"(?:{'|'.join(IMAGE_FOLDERS)})(?:_[0-9]+)?")

SMALLER = 2, 4, 8  # photographs of a half, a quarter, an eighth of the size, as in images_4

MASK_FOLDERS = ("masks", "mask")

MASK_ENDINGS = (".mask", "_mask", "-mask")  # before the suffix of a photograph's mask

MIN_FOUND_SHARE, MIN_FOUND = 0.5, 2
"""Smallest share, and number, of the named files of a kind that must be there."""


def parts_of(name: str) -> list[str]:
    """Return the folders of a name and its last part; backslashes separate them as well."""
    return [part for part in name.replace("\\", "/").split("/") if part not in ("", ".")]


def key_of(name: str) -> str:
    """Return the same for names that differ in case, or in how accents are encoded."""
    return unicodedata.normalize("NFC", name).casefold()


def stem_of(name: str) -> str:
    """Return the name without the suffix of an image."""
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in IMAGE_SUFFIXES else name


def is_image(name: str) -> bool:
    """Judge by the name; hidden files, which systems leave beside photographs, are no images."""
    return not name.startswith(".") and os.path.splitext(name)[1].lower() in IMAGE_SUFFIXES


def images_in(folder: Path) -> list[str]:
    """Return the sorted names of the images directly in a folder."""
    return list(filter(is_image, sorted(os.listdir(folder))))


@dataclass(frozen=True)
class FileKind:
    """Files of one kind that a dataset names."""

    plural: str
    consequence: str = "left out"  # of a missing one
    remedy: str = "put them there"
    suffixes: frozenset[str] = IMAGE_SUFFIXES  # interchangeable
    is_needed: bool = True  # an error where most are missing


def find_files(
    folder: Path,
    source: Path,
    names: Sequence[str],
    kind: FileKind,
    places: Sequence[str],
    notes: list[str],
) -> dict[str, Path]:
    """Return existing files below ``folder``, by their names.

    Each is the file of that name (or with ``.png`` added), or the only one of nearly that name; no
    file has two names. notes: gets one on names that differ, and one on missing files, both
    beginning with ``source``; places: of the names in ``source``.

    Raises :class:`UserError` where fewer than half were found, or only one of several.
    """
    finder, existing, near = _FileFinder(folder), {}, {}
    for name in dict.fromkeys(names):
        if path := finder.exact(name):
            existing[name] = path
        elif len(paths := finder.find_similar(name, kind.suffixes)) == 1:
            near[name] = paths[0]
    counts = Counter([*existing.values(), *near.values()])
    near = {name: path for name, path in near.items() if counts[path] == 1}
    if near:
        (name, path), *_ = near.items()
        notes.append(
            f"{source}: taken under nearly the same name: {len(near):,} {kind.plural}, such as "
            f"{one_line(path, 200)} for {one_line(name, 100)}"
        )
    existing |= near
    missing = [index for index, name in enumerate(names) if name not in existing]
    if missing:
        count = f"{len(missing):,} of {len(names):,} {kind.plural}"
        enough = max(MIN_FOUND_SHARE * len(names), MIN_FOUND)
        if kind.is_needed and len(names) - len(missing) < enough:
            raise UserError(
                f"{places[missing[0]]}: there is no image {one_line(folder / names[missing[0]])} "
                f"(or with .png added); {kind.remedy}; not there: {count}"
            )
        shown = format_names([one_line(names[index], 100) for index in missing])
        notes.append(f"{source}: not there: {count} ({shown}); {kind.consequence}")
    return existing


class _FileFinder:
    """Files below a folder; a folder is listed once, when a name in it is not exact."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._listing = folder, cache(_listing)

    def exact(self, name: str) -> Path | None:
        for candidate in (self._folder / name, self._folder / f"{name}.png"):
            if os.path.isfile(candidate):  # False, not an error, for a name that no file can have
                return candidate
        return None

    def find_similar(self, name: str, suffixes: Collection[str]) -> list[Path]:
        """Return files whose names differ from ``name`` only in ways that programs change them."""
        parts = parts_of(name)
        first = max((index + 1 for index, part in enumerate(parts) if part == ".."), default=0)
        is_elsewhere = first > 0 or name[:1] in ("/", "\\") or name[1:2] == ":"
        places = [parts[first:]] if first == 0 else []
        places += [
            parts[start:]
            for start in range(first, len(parts))
            if is_elsewhere or (start > 0 and self._is_image_folder(parts[start - 1]))
        ]
        places += [] if first else [[IMAGE_FOLDERS[0], *parts]]
        if first == 0 and len(parts) > 1 and parts[0] in IMAGE_FOLDERS:
            places += [[f"{parts[0]}_{factor}", *parts[1:]] for factor in SMALLER]
        matches = (self._search_below(place, suffixes) for place in places if place)
        return next(filter(None, matches), [])

    def _is_image_folder(self, name: str) -> bool:
        return bool(_IMAGE_FOLDER.fullmatch(key_of(name))) or name == self._folder.name

    def _search_below(self, parts: Sequence[str], suffixes: Collection[str]) -> list[Path]:
        folders = [self._folder]
        for part in parts[:-1]:
            folders = [f / name for f in folders for name in self._match_name(f, part)]
        paths = [f / name for f in folders for name in self._match_name(f, parts[-1])]
        if not paths:
            stem = f"{stem_of(parts[-1])}.*"
            paths = [f / name for f in folders for name in self._match_name(f, stem)]
            paths = [path for path in paths if path.suffix.lower() in suffixes]
        return [path for path in paths if os.path.isfile(path)]

    def _match_name(self, folder: Path, name: str) -> list[str]:
        """Return the same name, or else those that differ in case."""
        names = self._listing(folder).get(key_of(name), [])
        return [name] if name in names else names


def _listing(folder: Path) -> dict[str, list[str]]:
    """Return names in a folder by :func:`key_of`; images also as ``stem.*``."""
    listing: dict[str, list[str]] = {}
    try:
        names = sorted(os.listdir(folder))
    except (OSError, ValueError):  # no folder, or a name that none can have
        return listing
    for name in names:
        listing.setdefault(key_of(name), []).append(name)
        if (stem := stem_of(name)) != name:
            listing.setdefault(f"{key_of(stem)}.*", []).append(name)
    return listing


# Masks


def masks_of(
    folder: Path, names: Sequence[str], notes: list[str], images: Path | None = None
) -> list[Path | None]:
    """Return the mask of each photograph; None: it has none.

    folder: contains the folder of masks; names: relative to ``images``, the folder of the
    photographs, which is searched as well if it is given. notes: gets one on photographs without a
    mask, and one on files that are no photograph's mask.
    """
    files = _mask_files(folder)
    exact, marked, loose = ({} for _ in range(3))  # files by names of photographs
    for file in files:
        stem = _mask_key(file.relative_to(folder).as_posix().partition("/")[2])
        exact.setdefault(stem, file)
        marked.setdefault(_photograph_key(stem), file)
        loose.setdefault(stem_of(_photograph_key(stem) or stem), file)
    if images is not None:
        for file in _masks_beside(images, names):
            marked.setdefault(_photograph_key(_mask_key(file.relative_to(images).as_posix())), file)
    chosen = []
    for name in names:
        keys = key_of(name), _mask_key(name)
        chosen.append(next((by[k] for by in (exact, marked) for k in keys if k in by), None))
    used = set(chosen)
    for index, name in enumerate(names):  # photographs, for masks of older formats
        if chosen[index] is None and (file := loose.get(_mask_key(name))) not in used:
            chosen[index] = file
    without = [name for name, mask in zip(names, chosen, strict=True) if mask is None]
    if without and (any(chosen) or files):
        notes.append(
            f"{folder}: all pixels count of {len(without):,} of {len(names):,} photographs, which "
            f"have no mask ({format_names(without)})"
        )
    if unused := sorted(set(files).difference(chosen)):
        notes.append(
            f"{folder}: masks of no photograph that has a camera: {_format_files(folder, unused)} "
            "(the mask of a.jpg is a.jpg.png or a.png)"
        )
    return chosen


def without_masks(files: Sequence[Path]) -> list[Path]:
    """Return the files whose names are not those of other files' masks."""
    keys = {key(file.as_posix()) for file in files for key in (key_of, _mask_key)}
    return [file for file in files if _photograph_key(_mask_key(file.as_posix())) not in keys]


def warn_of_unnamed_masks(folder: Path, notes: list[str]) -> None:
    """Add a note on masks without ``mask_path``, which are ignored as in nerfstudio."""
    if files := _mask_files(folder):
        notes.append(
            f"{folder}: masks are not used, as no mask_path names them: "
            f"{_format_files(folder, files)}; all pixels of the photographs count"
        )


def _masks_beside(images: Path, names: Sequence[str]) -> list[Path]:
    """Return files beside photographs with the name of a mask, which are no photographs."""
    photographs = {images / name for name in names}
    folders = {path.parent for path in photographs}
    others = [path for folder in folders for path in folder.iterdir() if path not in photographs]
    return _png_first(p for p in others if is_image(p.name) and _photograph_key(_mask_key(p.name)))


def _mask_key(name: str) -> str:
    return stem_of(key_of(name))


def _photograph_key(stem: str) -> str | None:
    """Return the name of the photograph; None: there is no ending of a mask."""
    return next((stem.removesuffix(end) for end in MASK_ENDINGS if stem.endswith(end)), None)


def _format_files(folder: Path, files: Sequence[Path]) -> str:
    return format_names([one_line(file.relative_to(folder), 100) for file in files])


def _mask_files(folder: Path) -> list[Path]:
    tops = [name for name in os.listdir(folder) if key_of(name) in MASK_FOLDERS]
    walks = (walk for top in tops for walk in os.walk(folder / top))
    images = (Path(root, name) for root, _, names in walks for name in names if is_image(name))
    return _png_first(images)


def _png_first(files: Iterable[Path]) -> list[Path]:
    return sorted(files, key=lambda file: (file.suffix != ".png", file))
