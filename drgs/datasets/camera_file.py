"""Cameras of a file in the layout of ``transforms.json``, without its photographs."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

from drgs.cameras.viewpoints import Viewpoint, panorama_intrinsics
from drgs.core.constants import SHUTTER_SAMPLES
from drgs.core.errors import UserError, UserNote
from drgs.datasets.transforms import (
    TransformsFrame,
    focal_from_angle,
    focal_length,
    lens_of,
    motion_of,
    note_unread,
    principal_point,
    read_transforms,
)


def read_viewpoints(
    path: Path, size: tuple[int, int] | None, shutter_samples: int = SHUTTER_SAMPLES
) -> list[Viewpoint]:
    """Return the cameras of a file in the layout of ``transforms.json``, without its images.

    size: width and height, px; None for the file's. ``fl_x`` and ``cx`` are px of the file's ``w``,
    ``fl_y`` and ``cy`` of its ``h``. shutter_samples: times at which motion blur is rendered.
    """
    meta = read_transforms(path)
    if meta.unread:
        warnings.warn(UserNote(note_unread(meta.path, meta.unread)), stacklevel=2)
    digits = len(str(len(meta.frames) - 1))
    return [
        _viewpoint_of(frame, f"camera_{index:0{digits}d}", size, shutter_samples)
        for index, frame in enumerate(meta.frames)
    ]


def _viewpoint_of(
    frame: TransformsFrame, name: str, size: tuple[int, int] | None, shutter_samples: int
) -> Viewpoint:
    values = frame.values

    def value_of(key: str, remedy: str) -> float:
        if (value := getattr(values, key)) is None:
            raise UserError(f"{frame.location(key)} is missing; {remedy}")
        return value

    if size is None:
        given = (value_of(side, "give --size WIDTH HEIGHT instead") for side in ("w", "h"))
        width, height = (max(1, round(side)) for side in given)
    else:
        width, height = size

    def scale_length(key: str, side: str, check: Callable[[float, str, int], float]) -> float:
        """Return px of the wanted image from px of the file's."""
        pixels = width if side == "w" else height
        of = value_of(side, "the file's other numbers need it")
        return check(pixels * getattr(values, key) / of, frame.location(key), pixels)

    pose, lens, motion = values.transform_matrix, lens_of(frame), motion_of(frame, shutter_samples)
    if lens is not None and lens.whole_turn:
        intrinsics = panorama_intrinsics(width, height)
        return Viewpoint(name, pose, *intrinsics, width, height, lens, motion)
    cx, cy = width / 2, height / 2
    if values.fl_x is not None:
        focal = scale_length("fl_x", "w", focal_length)
    else:
        focal = focal_from_angle(value_of("camera_angle_x", "or give fl_x with w"), width)
    has_fl_y = values.fl_x is not None and values.fl_y is not None
    focal_y = scale_length("fl_y", "h", focal_length) if has_fl_y else focal
    if values.cx is not None and values.cy is not None:
        cx, cy = (
            scale_length(key, side, principal_point) for key, side in (("cx", "w"), ("cy", "h"))
        )
    return Viewpoint(name, pose, focal, focal_y, cx, cy, width, height, lens, motion)
