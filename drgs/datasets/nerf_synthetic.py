"""The NeRF-synthetic ("Blender") layout: ``transforms_{train,val,test}.json`` and RGBA images.

Mildenhall et al. 2020. Pinhole cameras with the principal point in the middle and one horizontal
field of view, ``camera_angle_x``, for all frames that have none of their own; images of one size in
a split, with straight alpha. A picture without alpha is refused: what it shows behind the object
would be fitted as part of it. Opaque photographs belong into the nerfstudio layout.

Frames may have a lens, a second pose, a mask and depths, as there: see
``drgs.datasets.frame_extras``.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

import numpy as np

from drgs.config.extensions import READERS
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.datasets.frame_extras import ignored, notes, optics_of
from drgs.datasets.frame_files import frames_with_files
from drgs.datasets.images import check_room, threads_for
from drgs.datasets.notices import Notices
from drgs.datasets.reader import DatasetReader
from drgs.datasets.reading import READ, SIZES_ALONE
from drgs.datasets.transforms import (
    Frame,
    TransformsFile,
    focal_from_angle,
    in_parallel,
    note_unread,
    read_transforms,
    unique_names,
)
from drgs.datasets.types import Dataset, Keeps, View, all_of_them
from drgs.io.pictures import image_size

START_HALF_EXTENT = 1.3
"""The 3DGS reference starts from random points in [-1.3, 1.3]^3 for these scenes
(``readNerfSyntheticInfo``)."""


OF_OTHERS = ("camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h")
"""Intrinsics that the layout does not have."""


def load(config: DataConfig, keeps: Keeps = all_of_them) -> Dataset:
    """Read split ``train`` and the split to measure on.

    That is ``config.test_split``, by default ``test`` if its transforms file is there, else
    ``val``.
    """
    if config.background is None:
        config = config.model_copy(update={"background": "white"})
    test_split, said, notices = _test_split(config), [], Notices(config.path)
    frames = {split: _frames(config, split, said) for split in ("train", test_split)}
    train, test = (
        _load_split(config, split, frames[split], keeps, notices) for split in ("train", test_split)
    )
    notices.say(said, train, () if test_split == "train" else test)
    all_frames = [frame for of_split in frames.values() for frame in of_split]
    width, height = train[0].width, train[0].height
    return Dataset(
        train=train,
        test=test,
        test_split=test_split,
        background=config.background_rgb,
        start_half_extent=START_HALF_EXTENT,
        description=(
            f"{config.path.name} (NeRF-synthetic layout): {len(train)} train views, measured on "
            f"{len(test)} views of split {test_split}, {width}x{height}, "
            f"background {config.background}" + notes(config, all_frames)
        ),
        ignored=ignored(config, all_frames),
        rendered=True,  # photographs have no alpha, and are refused
    )


def picture_files(config: DataConfig) -> list[Path]:
    """The photographs of the training views."""
    return [frame.files["image"] for frame in _frames(config, "train", [])]


def _frames(config: DataConfig, split: str, notes: list[str]) -> list[Frame]:
    """Return the frames of a split whose photographs are there."""
    meta = read_transforms(_transforms_path(config.path, split))
    if unread := [*meta.unread, *_passed_over(meta)]:
        notes.append(note_unread(meta.path, unread))
    return frames_with_files(config, meta, notes)


def _passed_over(meta: TransformsFile) -> list[str]:
    """Keys that other layouts read."""
    keys = [
        key for key in OF_OTHERS if any(getattr(f.values, key) is not None for f in meta.frames)
    ]
    keys += [] if meta.point_cloud is None else ["ply_file_path"]
    return keys + [f"{split}_filenames" for split in meta.lists]


def _test_split(config: DataConfig) -> str:
    if config.test_split is not None:
        return config.test_split
    for split in ("test", "val"):
        if os.path.isfile(_transforms_path(config.path, split)):
            return split
    raise UserError(
        f"{config.path}: there are no test views: neither transforms_test.json nor "
        "transforms_val.json is there; data.test_split: train measures on the training views"
    )


def _transforms_path(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def _load_split(
    config: DataConfig, split: str, frames: list[Frame], keeps: Keeps, notices: Notices
) -> tuple[View, ...]:
    files = [frame.files["image"] for frame in frames]
    size = image_size(files[0])

    def load_view(index: int, name: str) -> View:
        frame, file = frames[index], files[index]
        reading = READ if keeps(name) else SIZES_ALONE
        rgba = reading.pixels(file)
        _check_promises(rgba, size, file, files[0])
        if reading is READ:
            notices.look_at(file, rgba)
        pictures = reading.pictures(config, frame, file, rgba)
        height, width = pictures["image"].shape[:2]
        # The angle spans the full width, so the focal length in pixels follows the image's size.
        focal = focal_from_angle(_angle(frame), width)
        if split != "train":
            pictures["alpha"] = None  # only training looks at it
        return View(
            name=name,
            camera_to_world=frame.own.transform_matrix,
            fx=focal,
            fy=focal,
            cx=width / 2,
            cy=height / 2,
            width=width,
            height=height,
            files=frame.files,
            **optics_of(config, frame),
            **pictures,
        )

    names = unique_names([frame.own.file_path for frame in frames])
    kept = [file for file, name in zip(files, names, strict=True) if keeps(name)]
    check_room(kept, config.image_size)
    return in_parallel(load_view, range(len(frames)), names, threads=threads_for(files))


def _angle(frame: Frame) -> float:
    """Radians, horizontal."""
    if frame.values.camera_angle_x is None:
        raise UserError(f"{frame.where('camera_angle_x')} is missing")
    return frame.values.camera_angle_x


def _check_promises(image: np.ndarray, size: tuple[int, int], file: Path, first: Path) -> None:
    """Refuse an image (H, W, C) without alpha, or of another (width, height) than the first's."""
    if image.shape[2] != 4:
        raise UserError(
            f"{file}: must have an alpha channel (RGBA), as the NeRF-synthetic layout promises, "
            "got an opaque image; save it with alpha, or use the nerfstudio layout "
            "(transforms.json)"
        )
    height, width = image.shape[:2]
    if (width, height) != size:
        raise UserError(
            f"{file}: must be {size[0]} x {size[1]} px, as {first.name} is, got "
            f"{width} x {height}; scale the images of a split to one size"
        )


@READERS.register("nerf_synthetic")
class NerfSyntheticReader(DatasetReader):
    """Reads folders of NeRF-synthetic."""

    def recognizes(self, folder: Path, names: Collection[str]) -> bool:
        """See :class:`DatasetReader`."""
        del folder
        return "transforms_train.json" in names

    def load(self, config: DataConfig, keeps: Keeps = all_of_them) -> Dataset:
        """See :class:`DatasetReader`."""
        return load(config, keeps)

    def image_files(self, config: DataConfig) -> list[Path]:
        """See :class:`DatasetReader`."""
        return picture_files(config)
