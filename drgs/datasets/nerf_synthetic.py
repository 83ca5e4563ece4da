"""The NeRF-synthetic ("Blender") layout: ``transforms_{train,val,test}.json`` and RGBA images.

Mildenhall et al. 2020. Cameras have the principal point in the middle and a horizontal field of
view, ``camera_angle_x``; images have one size in a split and straight alpha. An image without alpha
is refused: its background would be fitted as part of the object. Opaque photographs need the
nerfstudio layout. Frames may have a lens, a second pose, a mask and depths, as there.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from typing_extensions import override

from drgs.config.extensions import READERS
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.datasets.reader import (
    DatasetReader,
    Intrinsics,
    Notices,
    Photographs,
    load_views,
    make_dataset,
)
from drgs.datasets.splits import left_out
from drgs.datasets.transforms import (
    TransformsFrame,
    focal_from_angle,
    frames_with_files,
    note_unread,
    read_transforms,
)
from drgs.datasets.types import Dataset, View, ViewFilter, all_views
from drgs.io.images import image_size

START_HALF_EXTENT = 1.3  # of the random start points of the 3DGS reference, readNerfSyntheticInfo

UNUSED_KEYS = ("camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h")
"""Intrinsics that the layout does not have."""


@READERS.register("nerf_synthetic")
class NerfSyntheticReader(DatasetReader):
    """Reads folders of NeRF-synthetic."""

    order = 0

    @override
    def recognizes(self, folder: Path) -> bool:
        return (folder / "transforms_train.json").exists()

    @override
    def load(self, config: DataConfig, keeps: ViewFilter = all_views) -> Dataset:
        """Return split ``train``, and ``config.test_split`` (default: ``test`` or ``val``)."""
        if config.background is None:
            config = config.model_copy(update={"background": "white"})
        test_split, notes, notices = _test_split(config), [], Notices(config.path)
        frames = {split: _frames(config, split, notes) for split in ("train", test_split)}
        left = left_out(config, [frame for split in frames.values() for frame in split])
        frames = {k: [f for f in v if f.file_path not in left] for k, v in frames.items()}
        train = _load_split(config, frames["train"], keeps, notices)
        test = train
        if test_split != "train":
            test = _load_split(config, frames[test_split], keeps, notices)
            test = tuple(replace(view, alpha=None) for view in test)  # only training uses it
        read = [frame for split in frames.values() for frame in split]
        photographs = Photographs("NeRF-synthetic", config.path, read, notes=notes)
        how = f"of split {test_split}"
        dataset = make_dataset(config, photographs, train, test, test_split, how, notices)
        # Photographs have no alpha, and are refused.
        return replace(dataset, start_half_extent=START_HALF_EXTENT, rendered=True)

    @override
    def image_files(self, config: DataConfig) -> list[Path]:
        """Return the images of the training views."""
        return [frame.files["image"] for frame in _frames(config, "train", [])]


def _test_split(config: DataConfig) -> str:
    if config.test_split is not None:
        return config.test_split
    for split in ("test", "val"):
        if (config.path / f"transforms_{split}.json").is_file():
            return split
    raise UserError(
        f"{config.path}: there are no test views: neither transforms_test.json nor "
        "transforms_val.json is there; data.test_split: train measures on the training views"
    )


def _frames(config: DataConfig, split: str, notes: list[str]) -> list[TransformsFrame]:
    meta = read_transforms(config.path / f"transforms_{split}.json")
    values = [frame.values for frame in meta.frames]
    unread = [key for key in UNUSED_KEYS if any(getattr(v, key) is not None for v in values)]
    unread += [] if meta.point_cloud is None else ["ply_file_path"]
    unread += [f"{split}_filenames" for split in meta.lists]
    if unread := [*meta.unread, *unread]:
        notes.append(note_unread(meta.path, unread))
    return frames_with_files(config, meta, notes)


def _load_split(
    config: DataConfig, frames: list[TransformsFrame], keeps: ViewFilter, notices: Notices
) -> tuple[View, ...]:
    if not frames:
        return ()
    first = frames[0].files["image"]
    width, height = image_size(first)

    def intrinsics(
        frame: TransformsFrame, shape: tuple[int, ...], size: tuple[int, int]
    ) -> Intrinsics:
        file, angle = frame.files["image"], frame.values.camera_angle_x
        if shape[2] != 4:
            raise UserError(
                f"{file}: must have an alpha channel (RGBA), as the NeRF-synthetic layout "
                "promises, got an opaque image; save it with alpha, or use the nerfstudio layout "
                "(transforms.json)"
            )
        if shape[:2] != (height, width):
            raise UserError(
                f"{file}: must be {width} x {height} px, as {first.name} is, got {shape[1]} x "
                f"{shape[0]}; scale the images of a split to one size"
            )
        if angle is None:
            raise UserError(f"{frame.location('camera_angle_x')} is missing")
        # The angle spans the full width, so the focal length in pixels follows the image's size.
        focal = focal_from_angle(angle, size[0])
        return focal, focal, size[0] / 2, size[1] / 2

    return load_views(config, frames, intrinsics, keeps, notices)
