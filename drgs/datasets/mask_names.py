"""Masks that lie in a folder of their own, called after the photographs.

A photograph ``a.jpg`` has the mask ``a.jpg.png`` (COLMAP), ``a.png``, ``a_mask.png`` (Metashape),
``a.jpg.mask.png`` or ``a.mask.png`` (RealityScan), in any case and with the suffix of any picture,
in the folder ``masks`` or ``mask``. The last three may lie beside the photographs as well.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from drgs.core.errors import listed, one_line
from drgs.datasets.file_names import PICTURE_SUFFIXES, key_of, stem_of

MASK_FOLDERS = ("masks", "mask")

ENDINGS = (".mask", "_mask", "-mask")
"""Between the name of a photograph and the suffix of its mask."""


def masks_of(
    folder: Path, names: Sequence[str], notes: list[str], pictures: Path | None = None
) -> list[Path | None]:
    """The mask of each photograph; None: it has none.

    folder: which has the folder of masks; names: relative to ``pictures``, the folder of the
    photographs, which is searched as well if it is given. notes: one is added on photographs
    without a mask, and one on files that are no photograph's mask.
    """
    files = _pictures_in(folder)
    exact, ending, loose = ({} for _ in range(3))  # names of photographs to files
    for file in files:
        stem = _key(file.relative_to(folder).as_posix().partition("/")[2])
        exact.setdefault(stem, []).append(file)
        plain = _without_ending(stem)
        if plain is not None:
            ending.setdefault(plain, []).append(file)
        loose.setdefault(stem_of(plain or stem), []).append(file)
    for file in () if pictures is None else _marked_beside(pictures, names):
        stem = _without_ending(_key(file.relative_to(pictures).as_posix()))
        ending.setdefault(stem, []).append(file)
    chosen: list[Path | None] = []
    for name in names:
        places = ((by, k) for by in (exact, ending) for k in (key_of(name), _key(name)))
        chosen.append(_first(next((by[k] for by, k in places if k in by), [])))
    # The photograph was of another format when its mask was made.
    used = set(chosen)
    for index, name in enumerate(names):
        if chosen[index] is None:
            chosen[index] = _first([f for f in loose.get(_key(name), []) if f not in used])
    if any(chosen) or files:
        _note(folder, names, chosen, files, notes)
    return chosen


def without_masks(files: Sequence[Path]) -> list[Path]:
    """The files that are not called as the mask of another one of them."""
    keys = {key(file.as_posix()) for file in files for key in (key_of, _key)}
    return [file for file in files if _without_ending(_key(file.as_posix())) not in keys]


def _marked_beside(pictures: Path, names: Sequence[str]) -> list[Path]:
    """Files beside photographs that are called as masks, and are no photographs themselves."""
    folders = {(pictures / name).parent for name in names}
    found = sorted(path for folder in folders for path in folder.iterdir())
    photographs = {pictures / name for name in names}
    return [
        path
        for path in found
        if path not in photographs
        and _is_picture(path.name)
        and _without_ending(_key(path.name)) is not None
    ]


def _without_ending(stem: str) -> str | None:
    """The name of the photograph; None: there is no ending of a mask."""
    return next((stem.removesuffix(end) for end in ENDINGS if stem.endswith(end)), None)


def _key(name: str) -> str:
    """The same for a photograph and its mask, if that is called so with another suffix."""
    return stem_of(key_of(name))


def _first(files: Sequence[Path]) -> Path | None:
    """The PNG, or the first by name; None: there is none."""
    return min(files, key=lambda file: (file.suffix != ".png", file), default=None)


def note_unnamed_masks(folder: Path, notes: list[str]) -> None:
    """Add a note where there are masks, but no ``mask_path``: none counts, as in nerfstudio."""
    if files := _pictures_in(folder):
        notes.append(
            f"{folder}: masks are not used, as no mask_path names them: {_listed(folder, files)}; "
            "all pixels of the photographs count"
        )


def _note(
    folder: Path,
    names: Sequence[str],
    chosen: Sequence[Path | None],
    files: Sequence[Path],
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
            f"{folder}: masks of no photograph that has a camera: {_listed(folder, unused)} (the "
            "mask of a.jpg is a.jpg.png or a.png)"
        )


def _listed(folder: Path, files: Sequence[Path]) -> str:
    return listed([one_line(file.relative_to(folder), 100) for file in files])


def _pictures_in(folder: Path) -> list[Path]:
    """Sorted; in the folders of masks, and below them."""
    tops = [name for name in os.listdir(folder) if key_of(name) in MASK_FOLDERS]
    found = (
        Path(root, name)
        for top in tops
        for root, _, names in os.walk(folder / top)
        for name in names
        if _is_picture(name)
    )
    return sorted(found)


def _is_picture(name: str) -> bool:
    return os.path.splitext(name)[1].lower() in PICTURE_SUFFIXES and not name.startswith(".")
