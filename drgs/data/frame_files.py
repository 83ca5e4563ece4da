"""The photograph, the mask and the depth of each frame of a transforms file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from drgs.config.schema import DataConfig
from drgs.core.errors import UserError, one_line
from drgs.data.file_names import PICTURE_SUFFIXES, FileFinder, note_near, without_missing
from drgs.data.transforms import Frame, TransformsFile


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
    finder, frames = FileFinder(config.path), list(meta.frames)
    frames = _with_files(finder, meta.path, frames, IMAGE, notes)
    if not config.ignore_masks:
        frames = _with_files(finder, meta.path, frames, MASK, notes)
    if not config.ignore_depth:
        frames = _with_files(finder, meta.path, frames, DEPTH, notes)
    return frames


def _with_files(
    finder: FileFinder, source: Path, frames: Sequence[Frame], kind: _Kind, notes: list[str]
) -> list[Frame]:
    """All frames but those whose file of this kind is needed and missing."""

    def explain(frame: Frame) -> str:
        name = getattr(frame.values, kind.key)
        return (
            f"{frame.where(kind.key)}: there is no image {one_line(finder.folder / name)} (or with "
            f".png added){finder.suggestion(name, kind.suffixes)}; {kind.remedy}"
        )

    asking = [frame for frame in frames if getattr(frame.values, kind.key) is not None]
    if kind is IMAGE and len(asking) < len(frames):
        missing = next(frame for frame in frames if frame.values.file_path is None)
        raise UserError(f"{missing.where(kind.key)} is missing")
    names = [getattr(frame.values, kind.key) for frame in asking]
    found, near = finder.find_all(names, kind.suffixes)
    note_near(source, near, kind.plural, notes)
    what = kind.plural, kind.consequence
    there = without_missing(source, asking, names, found, explain, what, notes)
    kept = {frame.index for frame in there}
    with_file = {
        frame.index: replace(
            frame, files={**frame.files, kind.name: found[getattr(frame.values, kind.key)]}
        )
        for frame in there
    }
    asked = {frame.index for frame in asking}
    return [
        with_file.get(frame.index, frame)
        for frame in frames
        if frame.index in kept or frame.index not in asked or not kind.is_needed
    ]


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
