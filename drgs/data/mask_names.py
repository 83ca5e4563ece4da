"""Masks that lie in a folder of their own, called after the photographs.

A photograph ``a.jpg`` has the mask ``a.jpg.png`` (COLMAP), ``a.png``, ``a_mask.png`` (Metashape),
``a.jpg.mask.png`` or ``a.mask.png`` (RealityScan), in any case and with the suffix of any picture,
in the folder ``masks`` or ``mask``.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from drgs.core.errors import listed
from drgs.data.file_names import PICTURE_SUFFIXES, key_of, parts_of, stem_of

MASK_FOLDERS = ("masks", "mask")

ENDINGS = (".mask", "_mask", "-mask")
"""Between the name of a photograph and the suffix of its mask."""


def masks_of(folder: Path, names: Sequence[str], notes: list[str]) -> list[str | None]:
    """The mask of each photograph, relative to ``folder``; None: it has none.

    names: relative to the folder of the photographs. notes: one is added on photographs without a
    mask, and one on files that are no photograph's mask.
    """
    files = _pictures_in(folder)
    exact, ending, loose = ({} for _ in range(3))  # names of photographs to files
    for file in files:
        stem = _key("/".join(parts_of(file)[1:]))
        exact.setdefault(stem, []).append(file)
        plain = next((stem.removesuffix(end) for end in ENDINGS if stem.endswith(end)), None)
        if plain is not None:
            ending.setdefault(plain, []).append(file)
        loose.setdefault(stem_of(plain or stem), []).append(file)
    chosen: list[str | None] = []
    for name in names:
        places = ((by, k) for by in (exact, ending) for k in (key_of(name), _key(name)))
        chosen.append(_first(next((by[k] for by, k in places if k in by), [])))
    # The photograph was of another format when its mask was made.
    used = set(chosen)
    for index, name in enumerate(names):
        if chosen[index] is None:
            chosen[index] = _first([f for f in loose.get(_key(name), []) if f not in used])
    if files:
        _note(folder, names, chosen, files, notes)
    return chosen


def _key(name: str) -> str:
    """The same for a photograph and its mask, if that is called so with another suffix."""
    return stem_of(key_of(name))


def _first(files: Sequence[str]) -> str | None:
    """The PNG, or the first by name; None: there is none."""
    return min(files, key=lambda file: (not file.endswith(".png"), file), default=None)


def note_unnamed_masks(folder: Path, notes: list[str]) -> None:
    """Add a note where there are masks, but no ``mask_path``: none counts, as in nerfstudio."""
    if files := _pictures_in(folder):
        notes.append(
            f"{folder}: masks are not used, as no mask_path names them: {listed(files)}; all "
            "pixels of the photographs count"
        )


def _note(
    folder: Path,
    names: Sequence[str],
    chosen: Sequence[str | None],
    files: Iterable[str],
    notes: list[str],
) -> None:
    without = [name for name, mask in zip(names, chosen, strict=True) if mask is None]
    unused = [file for file in files if file not in set(chosen)]
    if without:
        notes.append(
            f"{folder}: all pixels count of {len(without):,} of {len(names):,} photographs, which "
            f"have no mask ({listed(without)})"
        )
    if unused:
        notes.append(
            f"{folder}: masks of no photograph that has a camera: {listed(unused)} (the mask of "
            "a.jpg is a.jpg.png or a.png)"
        )


def _pictures_in(folder: Path) -> list[str]:
    """Of the folders of masks, and below them; sorted, relative to ``folder``."""
    found = []
    for top in sorted(_folders(folder)):
        for root, _, names in os.walk(folder / top):
            found += [
                Path(root, name).relative_to(folder).as_posix()
                for name in names
                if os.path.splitext(name)[1].lower() in PICTURE_SUFFIXES
                and not name.startswith(".")
            ]
    return sorted(found)


def _folders(folder: Path) -> list[str]:
    return [name for name in os.listdir(folder) if key_of(name) in MASK_FOLDERS]
