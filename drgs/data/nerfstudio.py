"""The nerfstudio / instant-ngp layout: one ``transforms.json`` with intrinsics, and photographs.

Intrinsics (``fl_x, fl_y, cx, cy, w, h``) stand at the top or, overriding that, in a frame; where
focal lengths are missing, ``camera_angle_x`` (and ``_y``) give them.

Frames may have a lens, a second pose, a mask and depths: see ``drgs.data.extras``. Depths are z in
the camera; with a fisheye, the distance from it, as in nerfstudio, where a fisheye's rays have unit
length.
"""

from __future__ import annotations

from pathlib import Path

from drgs.config.schema import DataConfig
from drgs.data.photographs import Photographs, check_splits, dataset_of
from drgs.data.transforms import image_path, point_cloud_note, point_cloud_path, read_frames
from drgs.data.types import Dataset, Keeps, all_of_them


def load(config: DataConfig, keeps: Keeps = all_of_them) -> Dataset:
    """Read all views: see :func:`drgs.data.photographs.dataset_of`."""
    path = config.path / "transforms.json"
    frames = read_frames(path)
    check_splits(config, path, len(frames))
    photographs = Photographs(
        layout="nerfstudio",
        source=path,
        frames=frames,
        files=[image_path(config.path, frame) for frame in frames],
        point_cloud=point_cloud_path(config, frames),
        note=point_cloud_note(config, frames),
    )
    return dataset_of(config, photographs, keeps)


def picture_files(config: DataConfig) -> list[Path]:
    """Of all frames."""
    frames = read_frames(config.path / "transforms.json")
    return [image_path(config.path, frame) for frame in frames]
