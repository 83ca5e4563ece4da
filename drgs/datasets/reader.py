"""Readers of dataset folders: an extension point; and the views that every reader makes of frames.

A reader is a subclass of :class:`DatasetReader`, registered by ``READERS.register(NAME)``. A
configuration chooses it by ``data.type: NAME``; ``auto``, the first that recognizes the folder.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np
from pydantic import BaseModel

from drgs.cameras.viewpoints import panorama_intrinsics
from drgs.config.extensions import READERS
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError, format_names, note_user, one_line
from drgs.core.folders import digest
from drgs.datasets.files import SMALLER
from drgs.datasets.images import (
    MemoryStore,
    Pixels,
    can_shift,
    choose_store,
    compact_mask,
    compact_photograph,
    downscale_depth,
    downscale_mask,
    downscaled_size,
    is_array,
    is_scaled,
    num_threads,
    placeholder_pixels,
    read_depth,
    read_mask,
    unread_image,
)
from drgs.datasets.splits import Lists, left_out, split_of
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
from drgs.datasets.types import Dataset, View, ViewFilter, all_views
from drgs.io.images import colour_profile, read_header, read_pixels, upright

__all__ = ["READERS", "DatasetReader", "Photographs", "TransformsFrame"]

MAX_WIDTH = 1600
"""px: wider photographs are scaled down to this, as in the 3DGS reference, unless a size is set."""

DEPTH_IMAGE_UNIT = 1e-3
"""Scene units in a step of a depth image without ``depth_unit_scale_factor``, as in nerfstudio."""

MAX_NOTE_CHARACTERS = 1000

MAX_STRETCH = 0.02  # of pixels of a panorama: as wide as high, in angle, but for this

T = TypeVar("T")

Intrinsics = tuple[float, float, float, float]  # fx, fy, cx, cy of a view, px

Images = tuple[Pixels, Pixels | None, Pixels | None, Pixels | None]
"""Image, alpha, mask and depth of a view."""


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

    order: ClassVar[int] = 9
    """Readers are asked in ascending order whether they recognize a folder."""

    def __init__(self, section: BaseModel | None) -> None:
        """section: the one that the reader has registered, or None."""

    def recognizes(self, folder: Path) -> bool:
        """Return whether a folder has this layout."""
        return False

    def photographs(self, config: DataConfig) -> Photographs:
        """Return a frame for each photograph in a folder: see :class:`TransformsFrame`."""
        raise NotImplementedError

    def load(self, config: DataConfig, keeps: ViewFilter = all_views) -> Dataset:
        """Return all views, sorted by file name, in the splits of :func:`split_of`.

        keeps: accepts, by name, the views whose images are read.
        """
        photographs = self.photographs(config)
        ignored = {"mask" * config.ignore_masks, "depth" * config.ignore_depth}
        frames = [
            replace(frame, files={k: v for k, v in frame.files.items() if k not in ignored})
            for frame in sorted(photographs.frames, key=lambda frame: frame.file_path)
        ]
        names = [frame.file_path for frame in frames]
        split = split_of(config, photographs.source, photographs.lists, names, photographs.notes)
        left = left_out(config, frames)
        changes: dict[str, object] = {"image_size": config.image_size or MAX_WIDTH}
        if config.background is None:
            opened = [f.files["image"] for f in frames if f.file_path not in left]
            is_any_transparent = any(read_photograph(read_header, f).has_alpha for f in opened)
            changes["background"] = "white" if is_any_transparent else "black"
        config, notices = config.model_copy(update=changes), Notices(config.path)
        used = [i for i in sorted({*split.train, *split.test}) if names[i] not in left]
        views = load_views(config, [frames[i] for i in used], _intrinsics, keeps, notices)
        views = dict(zip(used, views, strict=True))
        train = tuple(views[i] for i in split.train if i in views)
        test = tuple(views[i] for i in split.test if i in views)
        return make_dataset(config, photographs, train, test, split.name, f"({split.how})", notices)

    def image_files(self, config: DataConfig) -> Sequence[Path]:
        """Return the files of the photographs, from whose sizes a configuration is chosen."""
        return [frame.files["image"] for frame in self.photographs(config).frames]


def make_dataset(
    config: DataConfig,
    photographs: Photographs,
    train: tuple[View, ...],
    test: tuple[View, ...],
    test_split: str,
    how: str,
    notices: Notices,
) -> Dataset:
    """Return a dataset of loaded views, and emit the notes on it; how: test views were chosen."""
    if not train:
        raise UserError(f"data.leave_out: no photograph is left to train on in {config.path}")
    notices.emit(photographs.notes, train, () if test_split == "train" else test)
    ignored, extras = describe_extras(config, photographs.frames)
    return Dataset(
        train=train,
        test=test,
        test_split=test_split,
        background=config.background_rgb,
        start_half_extent=None,
        description=(
            f"{config.path.name} ({photographs.layout} layout): {len(train)} train views, "
            f"measured on {len(test)} views {how}, {train[0].width}x{train[0].height}, "
            f"background {config.background}{extras}{photographs.note}"
            + (f"; {len(config.leave_out)} left out" if config.leave_out else "")
        ),
        ignored=ignored,
        point_cloud=photographs.point_cloud,
    )


def load_views(
    config: DataConfig,
    frames: Sequence[TransformsFrame],
    intrinsics: Callable[[TransformsFrame, tuple[int, ...], tuple[int, int]], Intrinsics],
    keeps: ViewFilter,
    notices: Notices,
) -> tuple[View, ...]:
    """Return the views of frames; images that ``keeps`` does not accept by name are not read.

    intrinsics: takes a frame, the shape of its photograph (H, W, C) and the size W, H of the view.
    """
    names = unique_names([frame.file_path for frame in frames])
    files = [frame.files["image"] for frame in frames]
    kept = [file for file, name in zip(files, names, strict=True) if keeps(name)]
    store = choose_store(kept, config.image_size, config.in_memory)

    def load(frame: TransformsFrame, name: str) -> View:
        file, is_read = frame.files["image"], keeps(name)
        pixels = read_photograph(read_pixels if is_read else placeholder_pixels, file)
        pixels = orient_as_calibrated(pixels, frame)
        if is_read:
            notices.inspect(file, pixels)
        height, width = pixels.shape[:2]
        size = downscaled_size(width, height, config.image_size)
        camera = intrinsics(frame, pixels.shape, size)  # first: raises for a wrong size
        read = _read_images(config, frame, pixels, store, notices) if is_read else None
        image, alpha, mask, depth = read or _unread_images(frame, pixels, size)
        if (lens := lens_of(frame)) is not None and lens.distorts and config.ignore_distortion:
            lens = None
        return View(
            name,
            frame.values.transform_matrix,
            *camera,
            *size,
            lens=lens,
            motion=None if config.ignore_motion else motion_of(frame, config.shutter_samples),
            image=image,
            alpha=alpha,
            mask=mask,
            depth=depth,
            files=frame.files,
        )

    return map_on_threads(load, frames, names, threads=num_threads(files))


def read_photograph(read: Callable[[Path], T], file: Path) -> T:
    """Read a photograph; an error names the remedy that always helps."""
    try:
        return read(file)
    except UserError as error:
        raise UserError(f"{error}; or leave it out: --leave-out {Path(*file.parts[-2:])}") from None


def map_on_threads(
    function: Callable[..., T], *arguments: Sequence[object], threads: int | None = None
) -> tuple[T, ...]:
    """Map a function on threads, in order: decoding images releases Python's lock."""
    with ThreadPoolExecutor(threads) as pool:
        return tuple(pool.map(function, *arguments))


def orient_as_calibrated(pixels: np.ndarray, frame: TransformsFrame) -> np.ndarray:
    """Return the pixels (H, W, C) of a photograph, turned by EXIF if that gives the frame's size.

    Viewers, OpenCV and Agisoft turn such a photograph; COLMAP, PyTorch's readers and the 3DGS
    reference do not.
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
) -> Intrinsics:
    values, (height, width) = frame.values, shape[:2]
    folders = frame.files["image"].parts[:-1]
    is_smaller = any(part.endswith(tuple(f"_{factor}" for factor in SMALLER)) for part in folders)
    if is_smaller and values.w is not None and values.h is not None:
        whole = round(values.w), round(values.h)
        width, height = whole if is_scaled((width, height), whole) else (width, height)
    for key, given, actual in (("w", values.w, width), ("h", values.h, height)):
        if given is not None and given != actual:
            raise UserError(
                f"{frame.location(key)} must be the image's size, {actual} px "
                f"({frame.files['image']}), got {given:g}; scale the intrinsics or the images"
            )
    if (lens := lens_of(frame)) is not None and lens.whole_turn:
        if abs(width - 2 * height) > max(2, MAX_STRETCH * width):
            raise UserError(
                f"{frame.files['image']}: a panorama of the whole sphere must be twice as wide as "
                f"high, got {width} x {height} px; pad what was cropped, and mask it (mask_path)"
            )
        return panorama_intrinsics(*size)
    fx = _focal(frame, "x", width)
    has_fy = values.fl_y is not None or values.camera_angle_y is not None
    fy = _focal(frame, "y", height) if has_fy else fx
    cx, cy = width / 2, height / 2
    if values.cx is not None:
        cx = principal_point(values.cx, frame.location("cx"), width)
    if values.cy is not None:
        cy = principal_point(values.cy, frame.location("cy"), height)
    x, y = size[0] / width, size[1] / height
    return fx * x, fy * y, cx * x, cy * y


def _focal(frame: TransformsFrame, axis: str, side: int) -> float:
    focal, angle = (getattr(frame.values, f"{key}_{axis}") for key in ("fl", "camera_angle"))
    if focal is not None:
        return focal_length(focal, frame.location(f"fl_{axis}"), side)
    if angle is not None:
        return focal_from_angle(angle, side)
    raise UserError(
        f"{frame.location(f'fl_{axis}')} is missing, and there is no camera_angle_{axis} either"
    )


# Images, masks and depths of a frame


def _read_images(
    config: DataConfig,
    frame: TransformsFrame,
    pixels: np.ndarray,
    store: MemoryStore,
    notices: Notices,
) -> Images:
    files, stored, depth = frame.files, (pixels.shape[1], pixels.shape[0]), None
    image, alpha = compact_photograph(pixels, config.background_rgb, config.image_size, store)
    mask = _mask(config, files["mask"], stored, store) if "mask" in files else None
    if "depth" in files:
        depth = read_depth(files["depth"], _depth_unit(frame), stored)
        if not depth.any():
            notices.add(files["image"], "whose depth is 0 everywhere, which means not known")
        depth = store.keep(downscale_depth(depth, config.image_size))
    return image, alpha, mask, depth


def _unread_images(frame: TransformsFrame, pixels: np.ndarray, size: tuple[int, int]) -> Images:
    """Return images that raise if their numbers are read."""
    shape, file, is_shifted = size[::-1], frame.files["image"], can_shift(pixels, size)
    image = unread_image((*shape, 3), file, is_shifted)
    alpha = unread_image(shape, file, is_shifted) if pixels.shape[2] == 4 else None
    plane = unread_image(shape, file)
    mask, depth = (plane if name in frame.files else None for name in ("mask", "depth"))
    return image, alpha, mask, depth


def _mask(config: DataConfig, file: Path, size: tuple[int, int], store: MemoryStore) -> Pixels:
    mask = downscale_mask(read_mask(file, size), config.image_size)
    if not mask.any():  # its PSNR is the mean of nothing
        raise UserError(
            f"{file}: must leave pixels that count (brighter than half), got a mask without any at "
            "the width of the views; remove the view from its file, set a larger data.image_size "
            "or data.ignore_masks"
        )
    return compact_mask(mask, store)


def _depth_unit(frame: TransformsFrame) -> float:
    """Return the scene units of a number in the file of depths."""
    if (unit := frame.values.depth_unit_scale_factor) is not None:
        return unit
    return 1.0 if is_array(frame.files["depth"]) else DEPTH_IMAGE_UNIT


def describe_extras(
    config: DataConfig, frames: Sequence[TransformsFrame]
) -> tuple[tuple[str, ...], str]:
    """Return the names of ignored data (distortion, motion, masks, depth) and a description."""
    lenses = list(filter(None, map(lens_of, frames)))
    data = {
        "distortion": [lens for lens in lenses if lens.distorts],
        "motion": [f for f in frames if f.values.transform_matrix_close is not None],
        "masks": [f for f in frames if f.values.mask_path],
        "depth": [f for f in frames if f.values.depth_file_path],
    }
    ignored = tuple(k for k, have in data.items() if have and getattr(config, f"ignore_{k}"))
    text = ""
    if names := sorted({lens.describe() for lens in lenses}):
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


# Notes for the user on the photographs


class Notices:
    """Collects findings while photographs are read, on several threads."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._findings: dict[str, list[str]] = {}  # names of photographs

    def inspect(self, file: Path, pixels: np.ndarray) -> None:
        """Record findings on a photograph; pixels: (H, W, C), as they were read."""
        if profile := colour_profile(file):
            self.add(file, f"with the colour profile {profile}, which is not applied")
        if pixels.shape[2] == 4 and not pixels[:, :, 3].any():
            self.add(file, "that are transparent everywhere")

    def add(self, file: Path, finding: str) -> None:
        """Record a finding on a photograph."""
        self._findings.setdefault(finding, []).append(self._name(file))

    def emit(self, notes: Sequence[str], train: Sequence[View], test: Sequence[View]) -> None:
        """Emit ``notes`` and the findings, each as a :class:`UserNote`."""
        texts = [f"photographs {what}: {_format_files(n)}" for what, n in self._findings.items()]
        texts += self._duplicate_notes(train, test)
        for note in (*notes, *(f"{self._folder}: {text}" for text in texts)):
            note_user(one_line(note, MAX_NOTE_CHARACTERS))

    def _name(self, file: Path) -> str:
        return str(file.relative_to(self._folder) if file.is_relative_to(self._folder) else file)

    def _duplicate_notes(self, train: Sequence[View], test: Sequence[View]) -> list[str]:
        """Return a note on duplicate photographs, or none."""
        groups = [[*train, *test]]
        for key in map(cache, (os.path.getsize, digest)):
            parts: dict[object, list[View]] = {}
            for index, group in enumerate(groups):
                for view in group:
                    parts.setdefault((index, key(view.files["image"])), []).append(view)
            groups = [part for part in parts.values() if len(part) > 1]
        if not groups:
            return []
        pairs = [" = ".join(self._name(v.files["image"]) for v in group) for group in groups]
        note = f"the same photograph more than once: {_format_files(pairs)}"
        in_train, in_test = ({view.files["image"] for view in views} for views in (train, test))
        files = [{view.files["image"] for view in group} for group in groups]
        both = sum(bool(group & in_train and group & in_test) for group in files)
        return [note + (f"; {both:,} of them both trained and measured on" if both else "")]


def _format_files(names: Sequence[str]) -> str:
    return f"{len(names):,} ({format_names(sorted(names))})"
