"""Readers of dataset folders: an extension point; and the views that every reader makes of frames.

A reader is a subclass of :class:`DatasetReader`, registered by ``READERS.register(NAME)``. A
configuration chooses it by ``data.type: NAME``, or by none: ``auto`` takes the first reader that
recognizes the folder.

Views are sorted by file name, and every ``data.test_every``-th is for testing, as in Mip-NeRF 360
and 3DGS, unless the dataset lists the views of its splits: see ``drgs.datasets.splits``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict, TypeVar

import numpy as np
from pydantic import BaseModel

from drgs.config.extensions import READERS
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.datasets.images import (
    Pixels,
    check_room,
    compact_mask,
    compact_photograph,
    downscale_depth,
    downscale_mask,
    downscaled_size,
    is_array,
    placeholder_pixels,
    read_depth,
    read_mask,
    threads_for,
    unread_image,
)
from drgs.datasets.notices import Notices
from drgs.datasets.splits import Lists, split_of
from drgs.datasets.transforms import (
    CLOSE_POSE_KEY,
    TransformsFrame,
    focal_from_angle,
    focal_length,
    lens_of,
    motion_of,
    principal_point,
    unique_names,
)
from drgs.datasets.types import Dataset, Keeps, View, all_views
from drgs.io.images import read_header, read_pixels, upright

__all__ = ["READERS", "DatasetReader", "Photographs", "TransformsFrame", "dataset_of"]

MAX_WIDTH = 1600
"""px: wider photographs are scaled down to this, as in the 3DGS reference, unless a size is set."""

DEPTH_IMAGE_UNIT = 1e-3
"""Scene units in a step of a depth image without ``depth_unit_scale_factor``, as in nerfstudio; an
``.npy`` file then contains scene units."""

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Photographs:
    """Content of a folder, as its layout specifies it."""

    layout: str  # its name
    source: Path  # the file or folder that specifies it, for messages
    frames: Sequence[TransformsFrame]  # whose photographs are there
    lists: Lists | None = None  # of splits
    point_cloud: Path | None = None  # to start from
    note: str = ""  # for the dataset's description
    notes: list[str] = field(default_factory=list)  # for the user, a line each


class DatasetReader:
    """Base class of readers of a layout of folders."""

    def __init__(self, section: BaseModel | None = None) -> None:
        """section: the one that the reader has registered."""

    @classmethod
    def from_config(cls, section: BaseModel | None) -> DatasetReader:
        """Return the reader; section: the one that it has registered, or None."""
        return cls() if section is None else cls(section)

    def recognizes(self, folder: Path, names: Collection[str]) -> bool:
        """Return whether a folder has this layout; names: of the files and folders in it."""
        del folder, names
        return False

    def photographs(self, config: DataConfig) -> Photographs:
        """Return where the photographs of a folder are, with their cameras.

        A :class:`TransformsFrame` for each: ``from_camera`` makes those of pinhole cameras.
        """
        raise NotImplementedError

    def load(self, config: DataConfig, keeps: Keeps = all_views) -> Dataset:
        """Return the dataset, with the images of the views whose names ``keeps`` accepts.

        Splits, sizes, masks and backgrounds follow the section ``data``.
        """
        return dataset_of(config, self.photographs(config), keeps)

    def image_files(self, config: DataConfig) -> Sequence[Path]:
        """Return the files of the photographs, from whose sizes a configuration is chosen."""
        return [frame.files["image"] for frame in self.photographs(config).frames]


def dataset_of(config: DataConfig, photographs: Photographs, keeps: Keeps = all_views) -> Dataset:
    """Return all views of the splits, by :func:`drgs.datasets.splits.split_of`, with notes.

    Raises :class:`UserError` as that does, and for a photograph or a frame that cannot be read.
    """
    frames = sorted(photographs.frames, key=lambda frame: frame.file_path)
    names = [frame.file_path for frame in frames]
    split = split_of(config, photographs.source, photographs.lists, names, photographs.notes)
    changes: dict[str, object] = {}
    if config.background is None:
        is_any_transparent = any(read_header(f.files["image"]).has_alpha for f in frames)
        changes["background"] = "white" if is_any_transparent else "black"
    if config.image_size is None:
        changes["image_size"] = MAX_WIDTH
    config, notices = config.model_copy(update=changes), Notices(config.path)
    used = sorted({*split.train, *split.test})
    views = load_views(config, [frames[i] for i in used], _intrinsics, keeps, notices)
    views = dict(zip(used, views, strict=True))
    train, test = (tuple(views[i] for i in indices) for indices in (split.train, split.test))
    measured = () if split.name == "train" else test
    notices.emit(photographs.notes, train, measured, photographs.point_cloud)
    ignored, extras = describe_extras(config, frames)
    return Dataset(
        train=train,
        test=test,
        test_split=split.name,
        background=config.background_rgb,
        start_half_extent=None,
        description=(
            f"{config.path.name} ({photographs.layout} layout): {len(train)} train views, measured "
            f"on {len(test)} views ({split.how}), {train[0].width}x{train[0].height}, background "
            f"{config.background}{extras}{photographs.note}"
        ),
        ignored=ignored,
        point_cloud=photographs.point_cloud,
    )


class ViewIntrinsics(TypedDict):
    """Intrinsics of a :class:`View`, px."""

    fx: float
    fy: float
    cx: float
    cy: float


class ViewImages(TypedDict):
    """Images of a :class:`View`."""

    image: Pixels
    alpha: Pixels | None
    mask: Pixels | None
    depth: Pixels | None


Intrinsics = Callable[[TransformsFrame, tuple[int, ...], tuple[int, int]], ViewIntrinsics]
"""Takes a frame, the shape of its photograph (H, W, C) and the size W, H at which that is rendered;
returns the intrinsics at that size."""


def load_views(
    config: DataConfig,
    frames: Sequence[TransformsFrame],
    intrinsics: Intrinsics,
    keeps: Keeps,
    notices: Notices,
) -> tuple[View, ...]:
    """Return the views of frames; images that ``keeps`` does not accept by name are not read.

    Raises :class:`UserError` where the others do not fit into memory or cannot be read.
    """
    names = unique_names([frame.file_path for frame in frames])
    files = [frame.files["image"] for frame in frames]
    kept = [file for file, name in zip(files, names, strict=True) if keeps(name)]
    check_room(kept, config.image_size)

    def load(frame: TransformsFrame, name: str) -> View:
        file, is_read = frame.files["image"], keeps(name)
        pixels = as_calibrated((read_pixels if is_read else placeholder_pixels)(file), frame)
        if is_read:
            notices.inspect(file, pixels)
        height, width = pixels.shape[:2]
        size = downscaled_size(width, height, config.image_size)
        camera = intrinsics(frame, pixels.shape, size)
        return View(
            name=name,
            camera_to_world=frame.values.transform_matrix,
            width=size[0],
            height=size[1],
            files=frame.files,
            lens=None if config.ignore_distortion else lens_of(frame),
            motion=None if config.ignore_motion else motion_of(frame, config.shutter_samples),
            **camera,
            **(_read_images if is_read else _unread_images)(config, frame, pixels, size),
        )

    return in_parallel(load, frames, names, threads=threads_for(files))


def in_parallel(
    function: Callable[..., T], *arguments: Sequence[object], threads: int | None = None
) -> tuple[T, ...]:
    """Map a function on threads, in order: decoding images releases Python's lock."""
    with ThreadPoolExecutor(threads) as pool:
        return tuple(pool.map(function, *arguments))


def as_calibrated(pixels: np.ndarray, frame: TransformsFrame) -> np.ndarray:
    """Return the pixels (H, W, C) of a photograph, turned by EXIF if that gives the frame's size.

    Viewers, OpenCV and Agisoft turn such a photograph; COLMAP, PyTorch's readers and the 3DGS
    reference do not. Raises :class:`UserError` where the camera's size does not decide it.
    """
    file, values = frame.files["image"], frame.values
    orientation = read_header(file).orientation
    turned = upright(pixels, orientation)
    fits, fits_turned = (
        values.w in (None, image.shape[1]) and values.h in (None, image.shape[0])
        for image in (pixels, turned)
    )
    if orientation == 1 or (fits and (frame.is_as_stored or not fits_turned)):
        return pixels
    if fits_turned and not fits:
        return turned
    height, width = pixels.shape[:2]
    raise UserError(
        f"{file}: has the EXIF orientation {orientation}, and w and h do not tell whether the "
        f"camera's numbers ({frame.location('w')}) are for the image as it is stored, {width} x "
        f"{height} px, or as that turns it; save the image as the camera's numbers have it, "
        "without the orientation"
    )


def _intrinsics(
    frame: TransformsFrame, shape: tuple[int, ...], size: tuple[int, int]
) -> ViewIntrinsics:
    values, (height, width) = frame.values, shape[:2]
    for key, given, actual in (("w", values.w, width), ("h", values.h, height)):
        if given is not None and given != actual:
            raise UserError(
                f"{frame.location(key)} must be the image's size, {actual} px "
                f"({frame.files['image']}), got {given:g}; scale the intrinsics or the images"
            )
    fx = _focal(frame, "x", width)
    has_fy = values.fl_y is not None or values.camera_angle_y is not None
    fy = _focal(frame, "y", height) if has_fy else fx
    cx, cy = (_principal(frame, key, side) for key, side in (("cx", width), ("cy", height)))
    x, y = size[0] / width, size[1] / height
    return {"fx": fx * x, "fy": fy * y, "cx": cx * x, "cy": cy * y}


def _focal(frame: TransformsFrame, axis: str, side: int) -> float:
    focal, angle = (getattr(frame.values, f"{key}_{axis}") for key in ("fl", "camera_angle"))
    if focal is not None:
        return focal_length(focal, frame.location(f"fl_{axis}"), side)
    if angle is not None:
        return focal_from_angle(angle, side)
    raise UserError(
        f"{frame.location(f'fl_{axis}')} is missing, and there is no camera_angle_{axis} either"
    )


def _principal(frame: TransformsFrame, key: str, side: int) -> float:
    value = getattr(frame.values, key)
    return side / 2 if value is None else principal_point(value, frame.location(key), side)


# Images, masks and depths of a frame


def _read_images(
    config: DataConfig, frame: TransformsFrame, pixels: np.ndarray, size: tuple[int, int]
) -> ViewImages:
    """Return the images of a :class:`View`, at ``size``."""
    del size
    image, alpha = compact_photograph(pixels, config.background_rgb, config.image_size)
    files, stored, depth = frame.files, (pixels.shape[1], pixels.shape[0]), None
    mask = _mask(config, files["mask"], stored) if "mask" in files else None
    if "depth" in files:
        depth = read_depth(files["depth"], _depth_unit(frame), stored)
        depth = downscale_depth(depth, config.image_size)
    return {"image": image, "alpha": alpha, "mask": mask, "depth": depth}


def _unread_images(
    config: DataConfig, frame: TransformsFrame, pixels: np.ndarray, size: tuple[int, int]
) -> ViewImages:
    """Return images that raise if their numbers are read."""
    del config
    files, (width, height), file = frame.files, size, frame.files["image"]
    plane = unread_image((height, width), file)
    return {
        "image": unread_image((height, width, 3), file),
        "alpha": plane if pixels.shape[2] == 4 else None,
        "mask": plane if "mask" in files else None,
        "depth": plane if "depth" in files else None,
    }


def _mask(config: DataConfig, file: Path, size: tuple[int, int]) -> Pixels:
    mask = downscale_mask(read_mask(file, size), config.image_size)
    if not mask.any():  # its PSNR is the mean of nothing
        raise UserError(
            f"{file}: must leave pixels that count (brighter than half), got a mask without any at "
            "the width of the views; remove the view from its file, set a larger data.image_size "
            "or data.ignore_masks"
        )
    return compact_mask(mask)


def _depth_unit(frame: TransformsFrame) -> float:
    """Return the scene units of a number in the file of depths."""
    if (unit := frame.values.depth_unit_scale_factor) is not None:
        return unit
    return 1.0 if is_array(frame.files["depth"]) else DEPTH_IMAGE_UNIT


def describe_extras(
    config: DataConfig, frames: Sequence[TransformsFrame]
) -> tuple[tuple[str, ...], str]:
    """Return the names of data that ``data.ignore_*`` leaves out, and a description of all.

    Names: ``distortion``, ``motion``, ``masks``, ``depth``.
    """
    lenses = list(filter(None, map(lens_of, frames)))
    found = {
        "distortion": lenses,
        "motion": [f for f in frames if f.values.transform_matrix_close is not None],
        "masks": [f for f in frames if f.values.mask_path],
        "depth": [f for f in frames if f.values.depth_file_path],
    }
    ignored = tuple(k for k, have in found.items() if have and getattr(config, f"ignore_{k}"))
    text = ""
    if names := sorted({f"{lens.kind} ({', '.join(lens.coefficients())})" for lens in lenses}):
        text += f"; lens {' and '.join(names)}" + " ignored" * ("distortion" in ignored)
    if "masks" in ignored:
        text += "; masks (mask_path) ignored"
    elif count := sum("mask" in frame.files for frame in frames):
        text += f"; masks of {count:,} of {len(frames):,} photographs"
    if "depth" in ignored:
        text += "; depth (depth_file_path) ignored"
    elif units := sorted({_depth_unit(f) for f in frames if "depth" in f.files}):
        text += f"; depth in units of {' and '.join(f'{unit:g}' for unit in units)}"
    if "motion" in ignored:
        text += f"; motion ({CLOSE_POSE_KEY}) ignored"
    return ignored, text
