"""Cameras in the layout of ``transforms.json``, without photographs: read, and as JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from drgs.cameras.viewpoints import Viewpoint, between_opencv_and_opengl, panorama_intrinsics
from drgs.core.constants import SHUTTER_SAMPLES
from drgs.core.errors import UserError, note_user
from drgs.core.origin import WORLD, Origin
from drgs.datasets.transforms import (
    CLOSE_POSE_KEY,
    TransformsFrame,
    focal_from_angle,
    focal_length,
    lens_of,
    motion_of,
    note_unread,
    principal_point,
    read_transforms,
)
from drgs.datasets.types import View

MODELS = {
    "opencv": "FULL_OPENCV",
    "fisheye": "OPENCV_FISHEYE",
    "thin_prism_fisheye": "THIN_PRISM_FISHEYE",
}
"""COLMAP's lens names; other lenses have their registered names."""


def read_viewpoints(
    path: Path, size: tuple[int, int] | None, shutter_samples: int = SHUTTER_SAMPLES
) -> list[Viewpoint]:
    """Return the cameras of a file in the layout of ``transforms.json``, without its images.

    size: width and height, px; None for the file's. ``fl_x`` and ``cx`` are px of the file's ``w``,
    ``fl_y`` and ``cy`` of its ``h``. shutter_samples: times at which motion blur is rendered.
    """
    meta = read_transforms(path)
    if meta.unread:
        note_user(note_unread(meta.path, meta.unread))
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
        cx = scale_length("cx", "w", principal_point)
        cy = scale_length("cy", "h", principal_point)
    return Viewpoint(name, pose, focal, focal_y, cx, cy, width, height, lens, motion)


def cameras_json(views: Iterable[View], origin: Origin) -> dict[str, object]:
    """Return cameras in the layout of ``transforms.json``, in world coordinates.

    origin: of the views' positions, world; recorded if not zero.
    """
    recorded = {"origin": list(origin)} if origin != WORLD else {}
    frames = []
    for view in (view.with_offset(np.array(origin)) for view in views):
        frame: dict[str, object] = {
            "file_path": view.name,
            "transform_matrix": between_opencv_and_opengl(view.camera_to_world).tolist(),
            **{"fl_x": view.fx, "fl_y": view.fy, "cx": view.cx, "cy": view.cy},
            **{"w": view.width, "h": view.height},
        }
        if (lens := view.lens) is not None:
            frame |= {"camera_model": MODELS.get(lens.kind, lens.kind), **lens.coefficients()}
        if view.motion is not None:
            frame[CLOSE_POSE_KEY] = between_opencv_and_opengl(view.motion.close_to_world).tolist()
            frame["shutter"] = view.motion.shutter
        frames.append(frame)
    return {**recorded, "frames": frames}
