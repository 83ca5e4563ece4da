"""Cameras without photographs, for new images of a scene; and the point that cameras look at."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from drgs.core.constants import SHUTTER_SAMPLES
from drgs.core.errors import UserError, UserNote
from drgs.datasets.transforms import (
    MAX_COORDINATE,
    TransformsFrame,
    focal_from_angle,
    focal_length,
    lens_of,
    motion_of,
    note_unread,
    panorama_intrinsics,
    principal_point,
    read_transforms,
)
from drgs.datasets.types import Viewpoint

PARALLEL_AXES = 1e-3
"""Smallest eigenvalue of mean(I - d d^T), d the optical axes: about the mean squared sine of
their angle to a common direction. Below this (1.8 degrees) their nearest point is noise."""

FIELD_OF_VIEW = 40.0  # degrees, horizontal: that of the NeRF-synthetic cameras, rounded


def pinhole(name: str, pose: np.ndarray, width: int, height: int, fov: float) -> Viewpoint:
    """Return a camera with its principal point in the middle; fov: degrees, horizontal."""
    focal = 0.5 * width / math.tan(math.radians(fov) / 2)
    return Viewpoint(name, pose, focal, focal, width / 2, height / 2, width, height)


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike) -> np.ndarray:
    """Return the pose (4, 4), camera to world, OpenCV axes, of a camera that looks at ``target``.

    origin, target, up: (3,) world; ``up`` points up in the image and has any length.

    Raises :class:`UserError` where they determine no camera.
    """
    origin, target, up = (np.asarray(v, np.float64) for v in (origin, target, up))
    for name, place in (("origin", origin), ("target", target)):
        if not np.abs(place).max() <= MAX_COORDINATE:
            raise UserError(
                f"camera: the coordinates of {name} must be at most {MAX_COORDINATE:g} in size, "
                f"got {format_vector(place)}; scale the scene down"
            )
    forward = target - origin
    with np.errstate(over="ignore", invalid="ignore"):  # becomes infinite, and is refused
        right = np.cross(forward, up)
        scale = np.linalg.norm(forward) * np.linalg.norm(up)
        is_determined = np.linalg.norm(right) > 1e-6 * scale
    if not is_determined:
        raise UserError(
            f"camera: the direction from origin {format_vector(origin)} to target "
            f"{format_vector(target)} must not be zero or parallel to up {format_vector(up)}"
        )
    forward, right = (v / np.linalg.norm(v) for v in (forward, right))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, origin], axis=1)
    return pose


def panorama(view: Viewpoint, up: np.ndarray | None = None) -> Viewpoint:
    """Return a panorama from the same place; up: (3,) world, of its middle row, None: as it is."""
    from drgs.cameras.equirectangular import Equirectangular

    pose = view.camera_to_world
    if up is not None:
        forward, _ = level_axes(up / np.linalg.norm(up), pose[:3, 2])
        pose = look_at(view.center, view.center + forward, up)
    fx, fy, cx, cy = panorama_intrinsics(view.width, view.height)
    return replace(view, camera_to_world=pose, fx=fx, fy=fy, cx=cx, cy=cy, lens=Equirectangular())


def level_axes(up: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that complete ``up``: the level part of ``towards``, and up x it."""
    level = towards - (towards @ up) * up
    if np.linalg.norm(level) <= 1e-6 * np.linalg.norm(towards):
        level = np.eye(3)[np.argmin(np.abs(up))]
        level = level - (level @ up) * up
    level = level / np.linalg.norm(level)
    return level, np.cross(up, level)


def field_of_view(views: Sequence[Viewpoint]) -> float:
    """Return the median horizontal field of view, degrees; 90 of panoramas."""
    angles = [math.pi / 2 if is_panorama(v) else 2 * math.atan(0.5 * v.width / v.fx) for v in views]
    return math.degrees(np.median(angles))


def is_panorama(view: Viewpoint) -> bool:
    """Return whether the view shows all directions."""
    return view.lens is not None and view.lens.whole_turn


def read_viewpoints(
    path: Path, size: tuple[int, int] | None, shutter_samples: int = SHUTTER_SAMPLES
) -> list[Viewpoint]:
    """Return the cameras of a file in the layout of ``transforms.json``, without its images.

    size: width and height, px; None for the file's. ``fl_x`` and ``cx`` are px of the file's ``w``,
    ``fl_y`` and ``cy`` of its ``h``. shutter_samples: times at which motion blur is rendered.

    Raises :class:`UserError` as :func:`read_transforms`.
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


def format_vector(vector: np.ndarray) -> str:
    """Return a vector as messages write it."""
    return f"({', '.join(f'{v:g}' for v in vector)})"


def focus_of(views: Sequence[Viewpoint]) -> tuple[np.ndarray, float]:
    """Return the point (3,) nearest to all optical axes, and its distance from the cameras.

    Minimises sum_i |(I - d_i d_i^T)(p - c_i)|^2 over p, with c_i the centres and d_i the axes;
    the distance is the median of |p - c_i|.

    Raises :class:`UserError` where the axes do not determine it or diverge.
    """
    centers = np.stack([view.center for view in views])
    axes = np.stack([view.camera_to_world[:3, 2] for view in views])
    if any(map(is_panorama, views)):
        raise _no_focus("panoramas, which look in all directions")
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = projectors.mean(axis=0)
    if len(views) == 1:
        raise _no_focus("one training camera, which does not tell how far away it looks")
    if np.linalg.eigvalsh(normal)[0] < PARALLEL_AXES:
        raise _no_focus("the cameras, whose optical axes are parallel")
    focus = np.linalg.solve(normal, np.einsum("nij,nj->i", projectors, centers) / len(views))
    depths = np.einsum("ni,ni->n", focus - centers, axes)
    if np.median(depths) <= 1e-6 * np.abs(centers - focus).max():
        raise _no_focus("the cameras, which look away from each other")
    return focus, float(np.median(np.linalg.norm(focus - centers, axis=1)))


def _no_focus(cameras: str) -> UserError:
    return UserError(
        f"init.half_extent: no start box can be derived from {cameras}; set init.half_extent, or "
        "give a point cloud (init.point_cloud)"
    )
