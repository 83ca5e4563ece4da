"""The nerfstudio / instant-ngp layout: one ``transforms.json`` with intrinsics, and photographs.

Intrinsics are ``fl_x, fl_y, cx, cy, w, h``; where focal lengths are missing, ``camera_angle_x``
(and ``_y``) give them. Frames may have a lens, a second pose, a mask and depths: see
``drgs.datasets.transforms``. Depths are z in the camera; with a fisheye, the distance from it, as
in nerfstudio, where a fisheye's rays have unit length.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from typing_extensions import override

from drgs.config.extensions import READERS
from drgs.config.schema import DataConfig
from drgs.datasets.files import FileKind, find_files, warn_of_unnamed_masks
from drgs.datasets.reader import DatasetReader, Photographs
from drgs.datasets.splits import Lists, listed_frames, unlisted_splits
from drgs.datasets.transforms import TransformsFile, frames_with_files, note_unread, read_transforms

POINT_CLOUD = FileKind(
    "point cloud", "the fit starts without", suffixes=frozenset(), is_needed=False
)


@READERS.register("nerfstudio")
class NerfstudioReader(DatasetReader):
    """Reads folders of nerfstudio and instant-ngp."""

    order = 1
    layout: ClassVar[str] = "nerfstudio"
    file: ClassVar[str] = "transforms.json"

    @override
    def recognizes(self, folder: Path) -> bool:
        return (folder / self.file).is_file()

    def read(self, path: Path, notes: list[str]) -> TransformsFile:
        """Return the content of the file of cameras; notes: gets those for the user."""
        return read_transforms(path)

    @override
    def photographs(self, config: DataConfig) -> Photographs:
        notes: list[str] = []
        cloud, note = None, ""
        meta = self.read(config.path / self.file, notes)
        frames = frames_with_files(config, meta, notes)
        if meta.point_cloud is not None and config.ignore_points:
            note = "; point cloud (ply_file_path) ignored"
        elif meta.point_cloud is not None:
            names, places = [meta.point_cloud], ["ply_file_path"]
            existing = find_files(config.path, meta.path, names, POINT_CLOUD, places, notes)
            cloud = existing.get(meta.point_cloud)
        if meta.unread:
            notes.append(note_unread(meta.path, meta.unread))
        if not config.ignore_masks and not any("mask" in frame.files for frame in frames):
            warn_of_unnamed_masks(config.path, notes)
        names = [frame.file_path for frame in meta.frames]
        if meta.lists:
            keys = {split: f"{split}_filenames" for split in meta.lists}
            listed = {
                split: listed_frames(meta.path, keys[split], listing, names, notes)
                for split, listing in meta.lists.items()
            }
            lists = Lists(listed, " and ".join(keys.values()))
        else:
            lists = unlisted_splits((config.path,), names, notes)
        return Photographs(self.layout, meta.path, frames, lists, cloud, note, notes)
