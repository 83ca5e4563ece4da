"""Cameras without photographs: where new pictures of a scene are taken from.

Read from a file of poses, placed by hand with :func:`look_at`, or on an orbit that follows from the
cameras of a dataset or from the Gaussians alone (``drgs.datasets.orbits``).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drgs.core.constants import SHUTTER_SAMPLES
from drgs.core.errors import UserError, UserNote
from drgs.datasets.transforms import (
    MAX_COORDINATE,
    Frame,
    focal_from_angle,
    focal_length,
    lens_of,
    motion_of,
    note_unread,
    principal_point,
    read_transforms,
)
from drgs.datasets.types import Viewpoint

FIELD_OF_VIEW = 40.0
"""Degrees, horizontal: that of the NeRF-synthetic cameras, rounded."""


def pinhole(name: str, pose: np.ndarray, width: int, height: int, fov: float) -> Viewpoint:
    """A camera with its principal point in the middle; fov: degrees, horizontal."""
    focal = 0.5 * width / math.tan(math.radians(fov) / 2)
    return Viewpoint(name, pose, focal, focal, width / 2, height / 2, width, height)


def look_at(origin: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(4, 4) camera to world, OpenCV axes, of a camera at ``origin`` that looks at ``target``.

    origin, target, up: (3,) world; ``up`` points up in the picture and has any length.

    Raises :class:`UserError` where they determine no camera.
    """
    origin, target, up = (np.asarray(v, np.float64) for v in (origin, target, up))
    for name, place in (("origin", origin), ("target", target)):
        if not np.abs(place).max() <= MAX_COORDINATE:
            raise UserError(
                f"camera: the coordinates of {name} must be at most {MAX_COORDINATE:g} in size, "
                f"got {shown(place)}; scale the scene down"
            )
    given, up = up, near_one(up)
    forward = target - origin
    right = np.cross(forward, up)
    scale = np.linalg.norm(forward) * np.linalg.norm(up)
    if not np.linalg.norm(right) > 1e-6 * scale:
        raise UserError(
            f"camera: the direction from origin {shown(origin)} to target {shown(target)} must "
            f"not be zero or parallel to up {shown(given)}"
        )
    forward, right = (v / np.linalg.norm(v) for v in (forward, right))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, origin], axis=1)
    return pose


def near_one(vector: np.ndarray) -> np.ndarray:
    """The vector times a power of two, which rounds nothing, so that its square is a number."""
    return np.ldexp(vector, -np.frexp(np.abs(vector).max())[1])


def field_of_view(views: Sequence[Viewpoint]) -> float:
    """Degrees: the median horizontal field of view."""
    return math.degrees(np.median([2 * math.atan(0.5 * v.width / v.fx) for v in views]))


def read_viewpoints(
    path: Path, size: tuple[int, int] | None, shutter_samples: int = SHUTTER_SAMPLES
) -> list[Viewpoint]:
    """The cameras of a file in the layout of ``transforms.json``, without its pictures.

    ``camera_angle_x``, or ``fl_x`` in pixels of ``w`` (and ``fl_y`` and ``cy`` of ``h``, ``cx`` of
    ``w``), and lens distortion, at the top or, overriding that, in a frame; a second pose in a
    frame. size: width and height, px; None for those that the file gives. shutter_samples: times at
    which what motion blurs is rendered.

    Raises :class:`UserError` naming the file, the key, what was expected and what was got.
    """
    meta = read_transforms(path)
    if meta.unread:
        warnings.warn(UserNote(note_unread(meta.path, meta.unread)), stacklevel=2)
    frames = meta.frames
    digits = len(str(len(frames) - 1))
    return [
        _viewpoint_of(frame, f"camera_{index:0{digits}d}", size, shutter_samples)
        for index, frame in enumerate(frames)
    ]


def _viewpoint_of(
    frame: Frame, name: str, size: tuple[int, int] | None, shutter_samples: int
) -> Viewpoint:
    values = frame.values
    if size is None:
        missing = [key for key in ("w", "h") if getattr(values, key) is None]
        if missing:
            where = frame.where(missing[0])
            raise UserError(f"{where} is missing; give --size WIDTH HEIGHT instead")
        size = max(1, round(values.w)), max(1, round(values.h))
    width, height = size

    def scaled(value: float, given: str, to: int) -> float:
        """From px of the file's picture to px of the one that is wanted."""
        if (of := getattr(values, given)) is None:
            raise UserError(f"{frame.where(given)} is missing; the file's other numbers need it")
        return to * value / of

    if values.fl_x is not None:
        focal = focal_length(scaled(values.fl_x, "w", width), frame.where("fl_x"), width)
    elif values.camera_angle_x is not None:
        focal = focal_from_angle(values.camera_angle_x, width)
    else:
        raise UserError(f"{frame.where('camera_angle_x')} (or fl_x with w) is missing")
    focal_y, cx, cy = focal, width / 2, height / 2
    if values.fl_x is not None and values.fl_y is not None:
        focal_y = focal_length(scaled(values.fl_y, "h", height), frame.where("fl_y"), height)
    if values.cx is not None and values.cy is not None:
        cx = principal_point(scaled(values.cx, "w", width), frame.where("cx"), width)
        cy = principal_point(scaled(values.cy, "h", height), frame.where("cy"), height)
    pose, lens, motion = values.transform_matrix, lens_of(frame), motion_of(frame, shutter_samples)
    return Viewpoint(name, pose, focal, focal_y, cx, cy, width, height, lens, motion)


def shown(vector: np.ndarray) -> str:
    """A vector as messages write it."""
    return f"({', '.join(f'{v:g}' for v in vector)})"
