"""Cameras in OpenCV axes, with a lens, and perhaps an aperture and a shutter.

Numbers are Dr.Jit scalars on the device: kernels are compiled once for all views, and a Mitsuba
sensor's transform is never read back to the host.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, Protocol

import drjit as dr
import numpy as np

from drgs.cameras.lens import PINHOLE, CameraParameters, Lens
from drgs.core.arrays import types_of
from drgs.core.types import Array2f, Array3f, Bool, Float, Matrix3f, Scalar

MAX_RAY_ERROR_PX = 0.01  # px: largest distance of the point of a ray from the place of the ray


@dataclass(frozen=True)
class Aperture:
    """The round aperture of a thin lens, as Mitsuba's ``thinlens``; ``effects.defocus`` uses it."""

    radius: Float  # scene units
    focus_distance: Float  # scene units, along the axis

    def variance(self, camera: Camera, depth: Float) -> Float:
        """Return the variance along either axis, px^2, of the blur of a point at ``depth``.

        Its radius is focal radius |1 / focus_distance - 1 / depth| (similar triangles), and a
        uniform disc of radius r has the variance r^2 / 4. Pixels are square.
        """
        radius = camera.focal.x * self.radius * (1 / self.focus_distance - 1 / depth)
        return dr.square(radius) / 4

    def rays(self, camera: Camera, x: Float, y: Float, count: int) -> tuple[Array3f, Bool | bool]:
        """Return directions (world) of ``count`` rays of each place (px), and validity.

        They begin all over the disc and meet at the focus distance.
        """
        t = types_of(type(x))
        on_disc = dr.tile(t.Array2f(_disc(count)), dr.width(x))
        x, y = dr.repeat(x, count), dr.repeat(y, count)
        camera = camera.at_row(y)
        _, ray, seen = camera.look_through(x, y)
        begin = t.Array3f(on_disc.x, on_disc.y, 0)
        ray = ray * self.focus_distance - begin * self.radius
        return camera.rotation.T @ ray, seen

    def cameras(self, camera: Camera, count: int) -> list[Camera]:
        """Return pinholes all over the aperture; the mean of their images is that of the lens."""
        cameras, t = [], types_of(type(camera.near))
        for x, y in _disc(count).T.tolist():
            begin = self.radius * t.Array3f(x, y, 0)
            shift = t.Array2f(begin.x, begin.y) * camera.focal / self.focus_distance
            center = camera.center + camera.rotation.T @ begin
            pinhole = replace(camera, center=center, principal=camera.principal + shift)
            cameras.append(replace(pinhole, aperture=None))
        return cameras

    def in_focus(self, origin: Array3f, direction: Array3f) -> Array3f:
        """Return the point of a ray (camera axes) where all rays of its place meet."""
        t = (self.focus_distance - origin.z) / direction.z
        return origin + t * direction


class Shutter(Protocol):
    """The shutter of a camera that moves while it is open: see ``drgs.cameras.motion``."""

    label: ClassVar[str]  # for messages
    reads_rows: ClassVar[bool] = False  # one after the other: rolling

    def pose(self, camera: Camera, time: Scalar) -> Camera:
        """Return ``camera``, which is at time 0, at another time, without a shutter."""
        ...

    def in_axes(self, rotation: Matrix3f) -> Shutter:
        """Return the shutter of the same motion, seen in rotated axes."""
        ...

    def cameras(self, camera: Camera, samples: int | None) -> list[Camera]:
        """Return the cameras whose images are averaged; samples: their number, None: its own."""
        return [camera]

    def camera_of(self, means: Array3f, camera: Camera) -> Camera:
        """Return the camera that sees each of some means (world)."""
        raise ValueError("a camera that motion blurs has an image for each of its cameras_in_time")


@dataclass(frozen=True)
class RowReading:
    """The motion of a camera from time 0 to the row that it reads, and of points before it."""

    velocity: Array3f  # camera axes, per time in which all rows are read
    turn: Matrix3f  # from the camera's axes at time 0 to those at the row
    travel: Array3f  # of the centre, in the axes at time 0


@dataclass(frozen=True)
class Camera(CameraParameters):
    """A camera: x right, y down, z forward; pixel centres at (i + 0.5, j + 0.5)."""

    width: int
    height: int
    lens: Lens = PINHOLE
    aperture: Aperture | None = None  # of a lens that blurs
    shutter: Shutter | None = None  # of a camera that moves while it is open
    reading: RowReading | None = None  # of a camera at the row that it reads

    @staticmethod
    def create(
        float_type: type[Float],
        rotation: np.ndarray,
        center: np.ndarray,
        K: np.ndarray,
        width: int,
        height: int,
        near: float,
        lens: Lens = PINHOLE,
    ) -> Camera:
        """Upload a camera given as numpy arrays: rotation (3, 3), center (3,), K (3, 3) px."""
        t = types_of(float_type)
        rotation, center, K = (np.asarray(a, dtype=np.float64) for a in (rotation, center, K))

        def scalar(value: float) -> Float:
            return dr.opaque(float_type, float(value))

        camera = Camera(
            rotation=t.Matrix3f([[scalar(v) for v in row] for row in rotation]),
            center=t.Array3f([scalar(v) for v in center]),
            focal=t.Array2f(scalar(K[0, 0]), scalar(K[1, 1])),
            principal=t.Array2f(scalar(K[0, 2]), scalar(K[1, 2])),
            film_start=t.Array2f(scalar(0), scalar(0)),
            film_end=t.Array2f(scalar(width), scalar(height)),
            near=scalar(near),
            width=int(width),
            height=int(height),
        )
        return camera.with_lens(lens)

    def look_through(self, x: Float, y: Float) -> tuple[Array3f, Array3f, Bool | bool]:
        """Return the ray through a place of the film (px): origin, direction, and if it is one.

        Both are in camera axes, the direction of any length. A lens shows nothing beyond its model.
        """
        direction = self.lens.ray(self, x, y)
        origin = self.lens.origin(self, x, y)
        if not self.lens.distorts:
            return origin, direction, True
        seen, _, _ = self.lens.visibility(replace(self, near=type(self.near)(0)), direction)
        t = types_of(type(self.near))
        missed = self.lens.offset(self, t.Array2f(x, y), self.lens.project_point(self, direction))
        return origin, direction, seen & (dr.squared_norm(missed) < MAX_RAY_ERROR_PX**2)

    def view_directions(self, x: Float, y: Float, count: int) -> tuple[Array3f, Bool | bool, int]:
        """Return directions of rays through places of the film (px): world, any length.

        And whether they are any, and their number at each place, next to each other: ``count``,
        spread evenly over the aperture if there is one, else 1.
        """
        if self.aperture is not None:
            return *self.aperture.rays(self, x, y, count), count
        camera = self.at_row(y)
        _, ray, seen = camera.look_through(x, y)
        return camera.rotation.T @ ray, seen, 1

    def place_of_ray(self, origin: Array3f, direction: Array3f) -> tuple[Array2f, Float]:
        """Return the place of a ray (camera axes) on the film, px, and the aperture's radius."""
        if self.aperture is None:
            return self.lens.place_of_ray(self, origin, direction), type(self.near)(0)
        point = self.aperture.in_focus(origin, direction)
        return self.lens.project_point(self, point), self.aperture.radius

    def at_row(self, y: Float) -> Camera:
        """Return the camera when a rolling shutter reads the row at y, px; others as they are."""
        if self.shutter is None:
            return self
        row = (y - self.film_start.y) / (self.film_end.y - self.film_start.y)
        return self.shutter.pose(self, row)

    def for_means(self, means: Array3f) -> Camera:
        """Return the camera when a rolling shutter reads the rows of means (world)."""
        return self if self.shutter is None else self.shutter.camera_of(means, self)

    def in_own_axes(self) -> Camera:
        """Return the camera with its own axes as those of the world."""
        return replace(self, rotation=dr.identity(type(self.rotation)))

    def numbers(self) -> list[Float]:
        """Return pose, focal lengths, principal point and lens as Float, in a fixed order."""
        found: list[Float] = []
        self.map_numbers(lambda number: found.append(number) or number)
        return found

    def map_numbers(self, function: Callable[[Float], Float]) -> Camera:
        """Return the camera with ``function`` applied to each of its :meth:`numbers`, in order."""
        return replace(self, **{n: _map(getattr(self, n), function) for n in _DIFFERENTIABLE})

    def by_lane(self, width: int) -> Camera:
        """Return the camera with its numbers stored by lane: derivatives can be summed in order."""
        lanes = dr.zeros(types_of(type(self.near)).UInt32, width)
        return self.map_numbers(lambda number: dr.gather(type(number), number, lanes))

    def with_lens(self, lens: Lens) -> Camera:
        """Return the same camera with another lens."""
        return replace(self, lens=lens.upload(type(self.near)).for_camera(self))


def _disc(count: int) -> np.ndarray:
    """Return points (2, count) with equal shares of the unit disc: a sunflower's seeds."""
    k = np.arange(count)
    radii, angles = np.sqrt((k + 0.5) / count), np.pi * (3 - np.sqrt(5)) * k
    return np.array([radii * np.cos(angles), radii * np.sin(angles)])


_DIFFERENTIABLE = ("rotation", "center", "focal", "principal", "lens", "aperture", "shutter")


def _map(value: Any, function: Callable[[Float], Float]) -> Any:
    """Apply ``function`` to the floating point numbers of fields, tuples, vectors and matrices."""
    if is_dataclass(value) and not isinstance(value, type):
        changes = {f.name: _map(getattr(value, f.name), function) for f in fields(value)}
        return replace(value, **changes)
    if isinstance(value, tuple):
        return tuple(_map(item, function) for item in value)
    if isinstance(value, type) or not dr.is_array_v(value):
        return value
    if dr.depth_v(value) == 1:
        return function(value)
    return type(value)([_map(item, function) for item in value])


def cameras_in_time(camera: Camera, samples: int | None = None) -> list[Camera]:
    """Return cameras whose images are averaged; samples: of motion blur, None: the shutter's."""
    return [camera] if camera.shutter is None else camera.shutter.cameras(camera, samples)
