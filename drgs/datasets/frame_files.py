"""The photograph, the mask and the depth of each frame of a transforms file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from drgs.config.schema import DataConfig
from drgs.core.errors import UserError, one_line
from drgs.datasets.file_names import PICTURE_SUFFIXES, FileFinder, note_missing, note_near
from drgs.datasets.transforms import Frame, TransformsFile


@dataclass(frozen=True)
class _Kind:
    """Files that frames name."""

    name: str  # in ``files`` of a frame
    key: str
    plural: str
    suffixes: frozenset[str]  # that may stand for each other
    consequence: str  # of a missing one
    remedy: str
    is_needed: bool = True  # without it, the frame is left out


IMAGE = _Kind(
    *("image", "file_path", "photographs", PICTURE_SUFFIXES, "left out"),
    "put them there, or take their frames out of the file",
)
MASK = _Kind(
    *("mask", "mask_path", "masks", PICTURE_SUFFIXES, "their photographs are left out"),
    "put them there, or set data.ignore_masks",
)
DEPTH = _Kind(
    *("depth", "depth_file_path", "files of depth", frozenset(), "their photographs have no depth"),
    "put them there, or set data.ignore_depth",
    is_needed=False,
)


def frames_with_files(config: DataConfig, meta: TransformsFile, notes: list[str]) -> list[Frame]:
    """The frames whose files are there, with the paths of those that are not ignored.

    notes: of what was taken under another name, and what is left out, is added here.

    Raises :class:`UserError` where fewer than half of the files of a kind are there.
    """
    if nameless := [frame for frame in meta.frames if frame.values.file_path is None]:
        raise UserError(f"{nameless[0].where(IMAGE.key)} is missing")
    finder = FileFinder(config.path)
    frames = _with_files(finder, meta.path, meta.frames, IMAGE, notes)
    if not config.ignore_masks:
        frames = _with_files(finder, meta.path, frames, MASK, notes)
    if not config.ignore_depth:
        frames = _with_files(finder, meta.path, frames, DEPTH, notes)
    return frames


def _with_files(
    finder: FileFinder, source: Path, frames: Sequence[Frame], kind: _Kind, notes: list[str]
) -> list[Frame]:
    """All frames but those whose file of this kind is needed and missing."""
    given = [getattr(frame.values, kind.key) for frame in frames]
    naming = [frame for frame, name in zip(frames, given, strict=True) if name is not None]
    names = [name for name in given if name is not None]

    def explain(index: int) -> str:
        return (
            f"{naming[index].where(kind.key)}: there is no image "
            f"{one_line(finder.folder / names[index])} (or with .png added)"
            f"{finder.suggestion(names[index], kind.suffixes)}; {kind.remedy}"
        )

    found, near = finder.find_all(names, kind.suffixes)
    note_near(source, near, kind.plural, notes)
    note_missing(source, names, found, explain, (kind.plural, kind.consequence), notes)
    kept = []
    for frame, name in zip(frames, given, strict=True):
        if name in found:
            kept.append(replace(frame, files={**frame.files, kind.name: found[name]}))
        elif name is None or not kind.is_needed:
            kept.append(frame)
    return kept


def point_cloud_of(
    config: DataConfig, meta: TransformsFile, notes: list[str]
) -> tuple[Path | None, str]:
    """The point cloud that the file names, if it is used, and what becomes of it otherwise.

    The latter is for a description.
    """
    if meta.point_cloud is None:
        return None, ""
    if config.ignore_points:
        return None, "; point cloud (ply_file_path) ignored"
    found, near = FileFinder(config.path).find_all([meta.point_cloud])
    note_near(meta.path, near, "point cloud", notes)
    name = one_line(meta.point_cloud, 100)
    return found.get(meta.point_cloud), "" if found else f"; its point cloud {name} is not there"
