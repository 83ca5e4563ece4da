"""Photographs with frames that say where their cameras were, as views of a dataset.

Views are sorted by file name, and every ``data.test_every``-th is for testing, as in Mip-NeRF 360
and 3DGS. Frames may have a lens, a second pose, a mask and depths: see ``drgs.data.extras``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.data.extras import files_of, ignored, notes, optics_of
from drgs.data.images import check_room, threads_for
from drgs.data.orientation import as_calibrated
from drgs.data.reading import READ, SIZES_ALONE, Reading
from drgs.data.transforms import (
    Frame,
    focal_from_angle,
    focal_length,
    in_parallel,
    principal_point,
    unique_names,
)
from drgs.data.types import Dataset, Keeps, View, all_of_them
from drgs.io.pictures import has_alpha

MAX_WIDTH = 1600
"""px: wider photographs are scaled down to this, as in the 3DGS reference, unless a size is set."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """What a folder has, as its layout says."""

    layout: str  # its name
    source: Path  # what says it, for messages
    frames: Sequence[Frame]
    files: Sequence[Path]  # the frames' pictures
    point_cloud: Path | None = None  # to start from
    note: str = ""  # what else there is to say, for the dataset's description


def check_splits(config: DataConfig, source: Path, num_views: int) -> None:
    """Raise :class:`UserError` where there is no split as configured, or nothing to measure on."""
    if config.test_split not in (None, "test"):
        raise UserError(
            f"{source}: this layout has no split {config.test_split}; leave data.test_split out "
            "(data.test_every chooses the test views)"
        )
    if num_views < 2:
        raise UserError(
            f"{source}: at least 2 views are needed, one of them to test; got {num_views}"
        )


def dataset_of(config: DataConfig, photographs: Photographs, keeps: Keeps = all_of_them) -> Dataset:
    """All views; those at indices 0, n, 2n, ... of the sorted names are the test split."""
    frames, files = photographs.frames, photographs.files
    config = _completed(config, files)

    def load_view(index: int, name: str) -> View:
        reading = READ if keeps(name) else SIZES_ALONE
        return _load_view(config, frames[index], files[index], name, reading)

    order = sorted(range(len(frames)), key=lambda index: frames[index].own.file_path)
    names = unique_names([frames[index].own.file_path for index in order])
    kept = [files[index] for index, name in zip(order, names, strict=True) if keeps(name)]
    check_room(kept, config.image_size)
    views = in_parallel(load_view, order, names, threads=threads_for(files))
    test = views[:: config.test_every]
    train = tuple(v for i, v in enumerate(views) if i % config.test_every != 0)
    return Dataset(
        train=train,
        test=test,
        test_split="test",
        background=config.background_rgb,
        start_half_extent=None,
        description=(
            f"{config.path.name} ({photographs.layout} layout): {len(train)} train views, measured "
            f"on {len(test)} views (every {config.test_every}th by file name), "
            f"{views[0].width}x{views[0].height}, background {config.background}"
            + notes(config, frames)
            + photographs.note
        ),
        ignored=ignored(config, frames),
        point_cloud=photographs.point_cloud,
    )


def _completed(config: DataConfig, files: Sequence[Path]) -> DataConfig:
    """With what follows from the photographs where nothing is given."""
    changes: dict[str, object] = {}
    if config.background is None:
        changes["background"] = "white" if any(map(has_alpha, files)) else "black"
    if config.image_size is None:
        changes["image_size"] = MAX_WIDTH
    return config.model_copy(update=changes)


def _load_view(config: DataConfig, frame: Frame, file: Path, name: str, reading: Reading) -> View:
    pixels = as_calibrated(reading.pixels(file), file, frame)
    height, width = pixels.shape[:2]
    values = frame.values
    for key, given, size in (("w", values.w, width), ("h", values.h, height)):
        if given is not None and given != size:
            raise UserError(
                f"{frame.where(key)} must be the image's size, {size} px ({file}), got "
                f"{given:g}; scale the intrinsics or the images"
            )
    fx = _focal(frame, "x", width)
    has_fy = values.fl_y is not None or values.camera_angle_y is not None
    fy = _focal(frame, "y", height) if has_fy else fx
    cx, cy = (_principal(frame, key, size) for key, size in (("cx", width), ("cy", height)))

    pictures = reading.pictures(config, frame, file, pixels)
    new_height, new_width = pictures["image"].shape[:2]
    scale_x, scale_y = new_width / width, new_height / height
    return View(
        name=name,
        camera_to_world=frame.own.transform_matrix,
        fx=fx * scale_x,
        fy=fy * scale_y,
        cx=cx * scale_x,
        cy=cy * scale_y,
        width=new_width,
        height=new_height,
        files=files_of(config, frame, file),
        **optics_of(config, frame),
        **pictures,
    )


def _focal(frame: Frame, axis: str, size: int) -> float:
    """Px, of a picture of ``size`` px."""
    focal, angle = (getattr(frame.values, f"{key}_{axis}") for key in ("fl", "camera_angle"))
    if focal is not None:
        return focal_length(focal, frame.where(f"fl_{axis}"), size)
    if angle is not None:
        return focal_from_angle(angle, size)
    raise UserError(
        f"{frame.where(f'fl_{axis}')} is missing, and there is no camera_angle_{axis} either"
    )


def _principal(frame: Frame, key: str, size: int) -> float:
    """Px; in the middle of a picture of ``size`` px where nothing else is said."""
    value = getattr(frame.values, key)
    return size / 2 if value is None else principal_point(value, frame.where(key), size)
