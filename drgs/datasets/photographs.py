"""Photographs with frames that say where their cameras were, as views of a dataset.

Views are sorted by file name, and every ``data.test_every``-th is for testing, as in Mip-NeRF 360
and 3DGS, unless the dataset lists the views of its splits: see ``drgs.datasets.splits``. Frames may
have a lens, a second pose, a mask and depths: see ``drgs.datasets.frame_extras``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.datasets.frame_extras import ignored, notes, optics_of
from drgs.datasets.images import check_room, threads_for
from drgs.datasets.notices import Notices
from drgs.datasets.orientation import as_calibrated
from drgs.datasets.reading import READ, SIZES_ALONE, Reading
from drgs.datasets.splits import Lists, split_of
from drgs.datasets.transforms import (
    Frame,
    focal_from_angle,
    focal_length,
    in_parallel,
    principal_point,
    unique_names,
)
from drgs.datasets.types import Dataset, Keeps, View, all_of_them
from drgs.io.pictures import has_alpha

MAX_WIDTH = 1600
"""px: wider photographs are scaled down to this, as in the 3DGS reference, unless a size is set."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """What a folder has, as its layout says."""

    layout: str  # its name
    source: Path  # what says it, for messages
    frames: Sequence[Frame]  # whose photographs are there
    lists: Lists | None = None  # of splits
    point_cloud: Path | None = None  # to start from
    note: str = ""  # what else there is to say, for the dataset's description
    notes: list[str] = field(default_factory=list)  # for the user, a line each


def dataset_of(config: DataConfig, photographs: Photographs, keeps: Keeps = all_of_them) -> Dataset:
    """All views of the splits, by :func:`drgs.datasets.splits.split_of`, with notes.

    Raises :class:`UserError` as that does, and for a photograph or a frame that cannot be read.
    """
    frames = sorted(photographs.frames, key=lambda frame: frame.own.file_path)
    file_names, said = [frame.own.file_path for frame in frames], photographs.notes
    split = split_of(config, photographs.source, photographs.lists, file_names, said)
    files = [frame.files["image"] for frame in frames]
    config = _completed(config, files)
    notices = Notices(config.path)

    def load_view(index: int, name: str) -> View:
        reading = READ if keeps(name) else SIZES_ALONE
        return _load_view(config, frames[index], name, reading, notices)

    used = sorted({*split.train, *split.test})
    names = dict(zip(used, unique_names([file_names[index] for index in used]), strict=True))
    check_room([files[index] for index in used if keeps(names[index])], config.image_size)
    threads = threads_for(files)
    views = dict(
        zip(used, in_parallel(load_view, used, [*names.values()], threads=threads), strict=True)
    )
    train, test = (tuple(views[i] for i in indices) for indices in (split.train, split.test))
    measured = () if split.name == "train" else test
    notices.say(said, train, measured, photographs.point_cloud)
    return Dataset(
        train=train,
        test=test,
        test_split=split.name,
        background=config.background_rgb,
        start_half_extent=None,
        description=(
            f"{config.path.name} ({photographs.layout} layout): {len(train)} train views, measured "
            f"on {len(test)} views ({split.how}), {train[0].width}x{train[0].height}, background "
            f"{config.background}{notes(config, frames)}{photographs.note}"
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


def _load_view(
    config: DataConfig, frame: Frame, name: str, reading: Reading, notices: Notices
) -> View:
    file = frame.files["image"]
    pixels = as_calibrated(reading.pixels(file), file, frame)
    if reading is READ:
        notices.look_at(file, pixels)
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
        files=frame.files,
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
