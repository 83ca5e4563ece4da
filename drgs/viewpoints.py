"""Cameras without photographs: where new pictures of a scene are taken from.

Layer 1. Read from a file of poses, placed by hand with :func:`look_at`, or on an orbit that
follows from the cameras of a dataset (:func:`orbit_of_views`) or from the Gaussians alone
(:func:`orbit_of_gaussians`). A :class:`Viewpoint` has the fields of :class:`drgs.data.types.View`
that ``drgs.scene.make_sensors`` reads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drgs.checks import UserError
from drgs.constants import SHUTTER_SAMPLES
from drgs.data.frames import (
    InheritedValues,
    focal_from_angle,
    lens_of,
    motion_of,
    number,
    opencv_camera_to_world,
    positive,
    read_transforms,
)
from drgs.data.points import focus_of
from drgs.data.types import View
from drgs.gaussians import Gaussians

FIELD_OF_VIEW = 40.0
"""Degrees, horizontal: that of the NeRF-synthetic cameras, rounded."""

ELEVATION = math.radians(30)
"""Of an orbit around Gaussians whose cameras are unknown."""

MAX_ELEVATION = math.radians(80)
"""Beyond this an orbit is a spin on the spot."""

ORBIT_SIZE = 400
"""px: the longer side of an orbit's pictures, at most."""

OPAQUE = 0.5
"""Gaussians with at least this opacity decide where an orbit without cameras looks."""

SPREAD = 0.98
"""Part of those Gaussians that such an orbit keeps in the picture; the rest may be outliers."""

LARGEST_GAP = math.radians(100)
"""Azimuth that may lie between two neighbouring cameras of a capture from all sides: behind
anything larger is what no photograph shows."""

AMPLITUDE = 0.8
"""Of the cameras' own arc, for the sway of an orbit that must not go all the way round."""

TILT_WEIGHT = 1e-3
"""Weight of the mean of the cameras' up vectors where their right vectors leave ``up`` open."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera and the size of its picture."""

    name: str  # unique among those rendered together; a file name without suffix
    camera_to_world: np.ndarray  # (4, 4) float64, rigid, OpenCV axes: x right, y down, z forward
    fx: float  # px
    fy: float  # px
    cx: float  # px; pixel centres are at (i + 0.5, j + 0.5)
    cy: float  # px
    width: int  # px
    height: int  # px
    lens: Any = None  # of drgs.lenses; None: a pinhole
    motion: Any = None  # of drgs.data.types; None: it does not move


@dataclass(frozen=True, eq=False)
class Orbit:
    """A closed path around ``focus`` at constant height, all of whose cameras look at it.

    The azimuth runs all the way round (``half_arc`` None), or sways by ``half_arc`` about its
    start: there and back again, where the scene was photographed from one side only.
    """

    focus: np.ndarray  # (3,) world
    up: np.ndarray  # (3,) unit, world: the axis of rotation
    start: np.ndarray  # (3,) unit, world, perpendicular to up: from the focus to azimuth zero
    radius: float  # world units: distance of the cameras to the focus
    elevation: float  # radians above the plane through the focus
    half_arc: float | None  # radians

    def viewpoints(self, count: int, width: int, height: int, fov: float) -> list[Viewpoint]:
        """``count`` cameras in equal steps of time; fov: degrees, horizontal."""
        side = np.cross(self.up, self.start)
        views = []
        for index in range(count):
            phase = 2 * math.pi * index / count
            azimuth = phase if self.half_arc is None else self.half_arc * math.sin(phase)
            level = math.cos(azimuth) * self.start + math.sin(azimuth) * side
            offset = math.cos(self.elevation) * level + math.sin(self.elevation) * self.up
            pose = look_at(self.focus + self.radius * offset, self.focus, self.up)
            views.append(pinhole(f"orbit_{index:03d}", pose, width, height, fov))
        return views


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
    forward = target - origin
    right = np.cross(forward, up)
    scale = np.linalg.norm(forward) * np.linalg.norm(up)
    if not np.linalg.norm(right) > 1e-6 * scale:
        raise UserError(
            f"camera: the direction from origin {_show(origin)} to target {_show(target)} must "
            f"not be zero or parallel to up {_show(up)}"
        )
    forward, right = (v / np.linalg.norm(v) for v in (forward, right))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, origin], axis=1)
    return pose


def orbit_of_views(views: Sequence[View], gaussians: Gaussians) -> Orbit:
    """The orbit at the cameras' mean height and median distance around what they look at.

    Where their optical axes meet nowhere, what they look at is the middle of ``gaussians``.
    """
    centers = np.stack([view.center for view in views])
    try:
        focus, radius = focus_of(views)
    except UserError:
        focus = _middle(gaussians)[0]
        radius = float(np.median(np.linalg.norm(centers - focus, axis=1)))
    up = up_of(views)
    start, side = _level_axes(up, (centers - focus).mean(axis=0))
    offsets = centers - focus
    distances = np.maximum(np.linalg.norm(offsets, axis=1), np.finfo(np.float64).tiny)
    elevation = float(np.mean(np.arcsin(np.clip(offsets @ up / distances, -1, 1))))
    middle, half_arc = _covered_arc(np.arctan2(offsets @ side, offsets @ start))
    return Orbit(
        focus=focus,
        up=up,
        start=math.cos(middle) * start + math.sin(middle) * side,
        radius=radius,
        elevation=float(np.clip(elevation, -MAX_ELEVATION, MAX_ELEVATION)),
        half_arc=half_arc,
    )


def orbit_of_gaussians(gaussians: Gaussians, up: np.ndarray, fov: float) -> Orbit:
    """The orbit from which all but outliers of the opaque Gaussians are in a square picture.

    up: (3,) world, any length; fov: degrees.
    """
    length = np.linalg.norm(up)
    if not length > 0:
        raise UserError(f"camera: up must not be zero, got {_show(np.asarray(up))}")
    focus, spread = _middle(gaussians)
    up = np.asarray(up, np.float64) / length
    start, _ = _level_axes(up, np.array([0.0, -1.0, 0.0]))
    radius = spread / math.sin(math.radians(fov) / 2)
    return Orbit(focus, up, start, radius, ELEVATION, half_arc=None)


def up_of(views: Sequence[View]) -> np.ndarray:
    """(3,) unit: the world's up direction, as the photographers held their cameras.

    Minimises mean((r_i . u)^2) over unit vectors, r_i the cameras' right vectors: a camera that
    is tilted but not rolled keeps it horizontal. A small term draws u to the mean of the cameras'
    own up vectors, which decides where the right vectors are parallel, and the sign.
    """
    right = np.stack([view.camera_to_world[:3, 0] for view in views])
    mean_up = np.mean([-view.camera_to_world[:3, 1] for view in views], axis=0)
    matrix = right.T @ right / len(views) - TILT_WEIGHT * np.outer(mean_up, mean_up)
    up = np.linalg.eigh(matrix)[1][:, 0]
    return up if up @ mean_up >= 0 else -up


def field_of_view(views: Sequence[View]) -> float:
    """Degrees: the median horizontal field of view."""
    return math.degrees(np.median([2 * math.atan(0.5 * v.width / v.fx) for v in views]))


def orbit_size(views: Sequence[View]) -> tuple[int, int]:
    """Width and height in px: the shape of the first photograph, at most 400 px on either side."""
    first = views[0]
    scale = min(1.0, ORBIT_SIZE / max(first.width, first.height))
    return max(1, round(scale * first.width)), max(1, round(scale * first.height))


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
    frames = meta["frames"]
    digits = len(str(len(frames) - 1))
    return [
        _read_viewpoint(
            InheritedValues(own, f"{path}: frames[{i}].", meta, path),
            f"camera_{i:0{digits}d}",
            size,
            shutter_samples,
        )
        for i, own in enumerate(frames)
    ]


def _read_viewpoint(
    frame: InheritedValues, name: str, size: tuple[int, int] | None, shutter_samples: int
) -> Viewpoint:
    values, where = frame.values, frame.where
    pose = opencv_camera_to_world(values, where)
    if size is None:
        missing = [key for key in ("w", "h") if key not in values]
        if missing:
            raise UserError(f"{where}{missing[0]} is missing; give --size WIDTH HEIGHT instead")
        size = tuple(max(1, round(positive(values, key, where))) for key in ("w", "h"))
    width, height = size
    if "fl_x" in values:
        scale = width / positive(values, "w", where)
        focal = scale * positive(values, "fl_x", where)
    elif "camera_angle_x" in values:
        focal = focal_from_angle(values, "camera_angle_x", where, width)
    else:
        raise UserError(f"{where}camera_angle_x (or fl_x with w) is missing")
    focal_y = focal
    if "fl_x" in values and "fl_y" in values:
        focal_y = height * positive(values, "fl_y", where) / positive(values, "h", where)
    cx, cy = width / 2, height / 2
    if "cx" in values and "cy" in values:
        cx = width * number(values, "cx", where) / positive(values, "w", where)
        cy = height * number(values, "cy", where) / positive(values, "h", where)
    lens, motion = lens_of(frame), motion_of(frame, shutter_samples)
    return Viewpoint(name, pose, focal, focal_y, cx, cy, width, height, lens, motion)


def _middle(gaussians: Gaussians) -> tuple[np.ndarray, float]:
    """(3,) the median position of the opaque Gaussians, and the distance that holds most."""
    g = gaussians.numpy()
    means = g.means.astype(np.float64)
    opaque = means[g.opacities >= OPAQUE]
    means = opaque if len(opaque) else means
    middle = np.median(means, axis=0)
    return middle, float(np.quantile(np.linalg.norm(means - middle, axis=1), SPREAD)) or 1.0


def _level_axes(up: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that complete ``up``: the level part of ``towards``, and up x that."""
    level = towards - (towards @ up) * up
    if np.linalg.norm(level) <= 1e-6 * np.linalg.norm(towards):
        level = np.eye(3)[np.argmin(np.abs(up))]
        level = level - (level @ up) * up
    level = level / np.linalg.norm(level)
    return level, np.cross(up, level)


def _covered_arc(azimuths: np.ndarray) -> tuple[float, float | None]:
    """Where an orbit starts, and how far it may sway: None if there are cameras all around."""
    azimuths = np.sort(azimuths)
    gaps = np.diff(azimuths, append=azimuths[0] + 2 * math.pi)
    widest = int(np.argmax(gaps))
    if gaps[widest] <= LARGEST_GAP:
        return 0.0, None
    arc = 2 * math.pi - gaps[widest]
    first = azimuths[(widest + 1) % len(azimuths)]
    return float(first + arc / 2), float(AMPLITUDE * arc / 2)


def _show(vector: np.ndarray) -> str:
    return f"({', '.join(f'{v:g}' for v in vector)})"
