"""Cameras on the host, without photographs: poses, intrinsics, and the point that they look at."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Self

from drgs.core.constants import SHUTTER_SAMPLES
from drgs.core.errors import UserError

if TYPE_CHECKING:
    from drgs.cameras.lens import Lens

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
OPENCV_TO_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])
OPENGL_TO_MITSUBA = OPENCV_TO_OPENGL @ OPENCV_TO_MITSUBA
"""Axes of cameras: OpenCV's (x right, y down, z forward), which drgs uses, OpenGL's of datasets (x
right, y up, z backward), and Mitsuba's (x left, y up, z forward). A matrix stands on the right of a
pose (camera to world) and is its own inverse."""

PARALLEL_AXES = 1e-3
"""Smallest eigenvalue of mean(I - d d^T), d the optical axes: about the mean squared sine of
their angle to a common direction. Below this (1.8 degrees) their nearest point is noise."""

FIELD_OF_VIEW = 40.0  # degrees, horizontal: that of the NeRF-synthetic cameras, rounded

MAX_COORDINATE = 1e9  # of a camera, scene units: far beyond what float32 resolves within a scene


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Motion of a camera while its shutter is open."""

    close_to_world: np.ndarray  # (4, 4) float64, OpenCV axes: the pose at the end
    shutter: str  # global: all pixels are exposed at once; rolling: row after row
    samples: int = SHUTTER_SAMPLES  # global: times at which the image is rendered


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera in the world, and the size of its image."""

    name: str  # unique among those rendered together; a file name without folders or suffix
    camera_to_world: np.ndarray  # (4, 4) float64, rigid, OpenCV axes: x right, y down, z forward
    fx: float  # px
    fy: float  # px
    cx: float  # px; pixel centres are at (i + 0.5, j + 0.5)
    cy: float  # px
    width: int  # px
    height: int  # px
    lens: Lens | None = None  # with numbers of the host; None: a pinhole
    motion: CameraMotion | None = None  # while the shutter is open; None: the camera does not move

    @property
    def center(self) -> np.ndarray:
        """Position (3,) of the camera, world."""
        return self.camera_to_world[:3, 3]

    @property
    def K(self) -> np.ndarray:  # noqa: N802
        """Matrix (3, 3) float64 from camera coordinates to homogeneous pixel coordinates."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    @property
    def viewmat(self) -> np.ndarray:
        """Pose (4, 4) float64, world to camera, OpenCV axes, as ``drgs.rasterization`` takes it."""
        rotation = self.camera_to_world[:3, :3].T
        viewmat = np.eye(4)
        viewmat[:3] = np.column_stack([rotation, -rotation @ self.center])
        return viewmat

    def with_offset(self, offset: np.ndarray) -> Self:
        """Return the same camera with ``offset`` (3,) added to its position."""
        shift = np.zeros((4, 4))
        shift[:3, 3] = offset
        return self.with_poses(lambda pose: pose + shift) if np.any(offset) else self

    def with_poses(self, change: Callable[[np.ndarray], np.ndarray]) -> Self:
        """Return the same camera, whose poses (4, 4) ``change`` maps to others."""
        motion = self.motion
        if motion is not None:
            motion = replace(motion, close_to_world=change(motion.close_to_world))
        return replace(self, camera_to_world=change(self.camera_to_world), motion=motion)


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


def panorama_intrinsics(width: int, height: int) -> tuple[float, float, float, float]:
    """Return fx, fy (px per radian), cx and cy (px) of a film that is a whole turn."""
    return width / (2 * math.pi), height / math.pi, width / 2, height / 2


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


def between_opencv_and_opengl(pose: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4), camera to world, in the other of the two conventions, float64."""
    turned = np.array(pose, np.float64)
    turned[:3, 1:3] *= -1
    return turned
