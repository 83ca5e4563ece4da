"""The nerfstudio / instant-ngp layout: one ``transforms.json`` with intrinsics, and photographs.

Intrinsics (``fl_x, fl_y, cx, cy, w, h``) stand at the top or, overriding that, in a frame; where
focal lengths are missing, ``camera_angle_x`` (and ``_y``) give them. ``train_filenames``,
``val_filenames`` and ``test_filenames`` list the photographs of the splits.

Frames may have a lens, a second pose, a mask and depths: see ``drgs.datasets.frame_extras``.
Depths are z in the camera; with a fisheye, the distance from it, as in nerfstudio, where a
fisheye's rays have unit length.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from drgs.config.extensions import READERS
from drgs.config.schema import DataConfig
from drgs.datasets.frame_files import frames_with_files, point_cloud_of
from drgs.datasets.mask_names import note_unnamed_masks
from drgs.datasets.photographs import Photographs, dataset_of
from drgs.datasets.reader import DatasetReader
from drgs.datasets.splits import Lists, listed_frames, lists_by_folders, lists_in_files
from drgs.datasets.transforms import TransformsFile, note_unread, read_transforms
from drgs.datasets.types import Dataset, Keeps, all_of_them


def load(config: DataConfig, keeps: Keeps = all_of_them) -> Dataset:
    """Read all views: see :func:`drgs.datasets.photographs.dataset_of`."""
    notes: list[str] = []
    meta = read_transforms(config.path / "transforms.json")
    frames = frames_with_files(config, meta, notes)
    cloud, note = point_cloud_of(config, meta, notes)
    if meta.unread:
        notes.append(note_unread(meta.path, meta.unread))
    if not config.ignore_masks and not any("mask" in frame.files for frame in frames):
        note_unnamed_masks(config.path, notes)
    photographs = Photographs(
        layout="nerfstudio",
        source=meta.path,
        frames=frames,
        lists=_lists(meta, notes),
        point_cloud=cloud,
        note=note,
        notes=notes,
    )
    return dataset_of(config, photographs, keeps)


def _lists(meta: TransformsFile, notes: list[str]) -> Lists | None:
    """The splits that the file names, or that folders are called after."""
    names = [frame.own.file_path for frame in meta.frames]
    if not meta.lists:
        return lists_in_files((meta.path.parent,), names, notes) or lists_by_folders(names)
    found = {
        split: listed_frames(meta.path, f"{split}_filenames", listing, names, notes)
        for split, listing in meta.lists.items()
    }
    return Lists(found, " and ".join(f"{split}_filenames" for split in found))


def picture_files(config: DataConfig) -> list[Path]:
    """The photographs of all frames."""
    meta = read_transforms(config.path / "transforms.json")
    return [frame.files["image"] for frame in frames_with_files(config, meta, [])]


@READERS.register("nerfstudio")
class NerfstudioReader(DatasetReader):
    """Reads folders of nerfstudio and instant-ngp."""

    def recognizes(self, folder: Path, names: Collection[str]) -> bool:
        """See :class:`DatasetReader`."""
        del folder
        return "transforms.json" in names

    def load(self, config: DataConfig, keeps: Keeps = all_of_them) -> Dataset:
        """See :class:`DatasetReader`."""
        return load(config, keeps)

    def image_files(self, config: DataConfig) -> list[Path]:
        """See :class:`DatasetReader`."""
        return picture_files(config)
