"""Cameras in OpenCV axes, and the lens that is there by default, a pinhole.

A :class:`Camera` is what projection reads. Its numbers are Dr.Jit scalars that live on the device,
so that kernels are compiled once for all views, and a Mitsuba sensor's transform is never read back
to the host.

How points come to the film is up to the camera's *lens*, blur to its *aperture*, motion to its
*shutter*: protocols say what they must have. All but :class:`Pinhole` are in modules of their own,
imported when a sensor has one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, Protocol

import drjit as dr
import numpy as np

from drgs.core.arrays import types_of
from drgs.core.constants import TAN_CLAMP


class Lens(Protocol):
    """How points come to the film, and what its places look along.

    Positions are Array3f in camera axes, one a lane; *slopes* are x / z and y / z. The bodies here
    are what most lenses do.
    """

    label: ClassVar[str]
    """What messages call it."""
    distorts: ClassVar[bool] = False
    """Whether a pinhole could take its place."""
    parallel: ClassVar[bool] = False
    """Whether its rays are, instead of meeting in the camera."""

    def upload(self, float_type: type) -> Lens:
        """The lens with Dr.Jit scalars of this type for its numbers."""
        del float_type
        return self

    def fitted(self, camera: Camera) -> Lens:
        """The lens that knows what the film of ``camera`` sees."""
        del camera
        return self

    def named(self) -> dict[str, Any]:
        """The lens's coefficients by name."""
        return {}

    def with_named(self, values: dict[str, Any]) -> Lens:
        """The same lens with other numbers for its coefficients."""
        del values
        return self

    def look(self, camera: Camera, position: Any) -> tuple[Any, Any, Any]:
        """Whether a mean is seen, its position, and its depth (scene units).

        The position and the depth of one that is not seen are replaced: a masked lane must not
        divide by zero, as 0 * inf would poison the gradient of its neighbours.
        """
        ...

    def true_slopes(self, camera: Camera, position: Any) -> list[Any] | None:
        """Of a mean; None: the projection is linearised at the mean, wherever it is."""
        ...

    def clamped_slopes(self, camera: Camera, position: Any) -> list[Any] | None:
        """The same, but not far outside the film: see ``constants.TAN_CLAMP``."""
        ...

    def film_point(self, camera: Camera, position: Any) -> Any:
        """Where a point is on the film, Array2f, px."""
        ...

    def film_directions(self, camera: Camera, position: Any, slopes: list[Any] | None) -> list[Any]:
        """Derivatives of the place on the film, two Array3f, world: px per scene unit.

        slopes: of the ray along which the mean is projected.
        """
        ...

    def depth_direction(self, camera: Camera, position: Any) -> Any:
        """Derivative of the depth divided by the depth, Array3f, world."""
        ...

    def view_direction(self, camera: Camera, offset: Any) -> Any:
        """In which a mean is seen, Array3f, world, of any length; offset: from the centre."""
        del camera
        return offset

    def origin(self, camera: Camera, x: Any, y: Any) -> Any:
        """Where the ray through a point of the film (px) begins, Array3f, camera axes."""
        del camera, y
        return types_of(type(x)).Array3f(0, 0, 0)

    def ray(self, camera: Camera, x: Any, y: Any) -> Any:
        """Its direction, Array3f, camera axes, of any length."""
        ...

    def ray_range(self, direction: Any, near: Any, far: Any) -> tuple[Any, Any]:
        """Where a ray of unit ``direction`` (camera axes) reaches two depths."""
        ...

    def place_of_ray(self, camera: Camera, origin: Any, direction: Any) -> Any:
        """Where on the film a ray (Array3f, camera axes) begins, Array2f, px."""
        del origin
        return self.film_point(camera, direction)


class Perspective(Lens, Protocol):
    """What lenses have in common that see along rays from a centre, in front of them."""

    def look(self, camera: Camera, position: Any) -> tuple[Any, Any, Any]:
        """Whether a mean is seen, its position, and its depth."""
        x, y, z = position
        seen = z >= camera.near
        z = dr.select(seen, z, 1)
        return seen, type(position)(x, y, z), z

    def true_slopes(self, camera: Camera, position: Any) -> list[Any]:
        """Of a mean."""
        del camera
        return [position.x / position.z, position.y / position.z]

    def clamped_slopes(self, camera: Camera, position: Any) -> list[Any]:
        """The same, but not far outside the film: see ``constants.TAN_CLAMP``."""
        start, end = self.frustum(camera)
        margin = TAN_CLAMP * (end - start) / 2
        slopes = self.true_slopes(camera, position)
        bounds = zip(slopes, start - margin, end + margin, strict=True)
        return [dr.select(s < lo, lo, dr.select(s > hi, hi, s)) for s, lo, hi in bounds]

    def depth_direction(self, camera: Camera, position: Any) -> Any:
        """Derivative of the depth divided by the depth, Array3f, world."""
        return camera.rotation[2] / position.z

    def ray_range(self, direction: Any, near: Any, far: Any) -> tuple[Any, Any]:
        """Where a ray of unit ``direction`` reaches two depths."""
        return near / direction.z, far / direction.z

    def frustum(self, camera: Camera) -> tuple[Any, Any]:
        """The least and the largest slopes on the film, Array2f."""
        ...


@dataclass(frozen=True)
class Pinhole(Perspective):
    """A point (x, y, z) is seen at focal (x, y) / z + principal."""

    label: ClassVar[str] = "Pinhole"

    def film_point(self, camera: Camera, position: Any) -> Any:
        """Where a point is on the film, Array2f, px."""
        x, y, z = position
        return camera.focal * types_of(type(z)).Array2f(x, y) / z + camera.principal

    def film_directions(self, camera: Camera, position: Any, slopes: list[Any]) -> list[Any]:
        """Derivatives of the place on the film, two Array3f, world: px per scene unit.

        J's rows are focal / z (e_axis - slope e_z), with the ``slopes`` of a mean at ``position``,
        or of another ray.
        """
        right, down, forward = camera.rotation
        return [
            (axis - slope * forward) * (focal / position.z)
            for axis, focal, slope in zip((right, down), camera.focal, slopes, strict=True)
        ]

    def frustum(self, camera: Camera) -> tuple[Any, Any]:
        """The least and the largest slopes on the film, Array2f."""
        # Of the whole film: a crop window is a part of the same picture.
        start = (camera.film_start - camera.principal) / camera.focal
        end = (camera.film_end - camera.principal) / camera.focal
        return start, end

    def ray(self, camera: Camera, x: Any, y: Any) -> Any:
        """Through a point of the film (px), Array3f, camera axes, of any length."""
        t = types_of(type(x))
        film = (t.Array2f(x, y) - camera.principal) / camera.focal
        return t.Array3f(film.x, film.y, 1)


class Aperture(Protocol):
    """Of a lens that blurs what is not in focus: rays of one place start all over it."""

    @property
    def radius(self) -> Any:
        """Float, scene units."""
        ...

    def variance(self, camera: Camera, depth: Any) -> Any:
        """Float, px^2: along either axis, of the place on the film of a point at ``depth``."""
        ...

    def rays(self, camera: Camera, x: Any, y: Any, count: int) -> tuple[Any, Any]:
        """See :meth:`Camera.view_directions`."""
        ...

    def in_focus(self, origin: Any, direction: Any) -> Any:
        """The point of a ray (Array3f, camera axes) that is in focus."""
        ...


class Shutter(Protocol):
    """How a camera moves while it is open, from time 0, where it is as it says, to 1."""

    label: ClassVar[str]
    """What messages call it."""

    def cameras(self, camera: Camera) -> list[Camera]:
        """Those whose pictures are averaged."""
        ...

    def pose(self, camera: Camera, time: Any) -> Camera:
        """Where ``camera`` is at a time; it does not move."""
        ...

    def camera_of(self, means: Any, camera: Camera) -> Camera:
        """Where ``camera`` is when it sees means (Array3f, world), one a lane."""
        ...


MISSED = 0.01
"""px: how far from its place a ray's point may be seen."""


@dataclass(frozen=True)
class Camera:
    """A camera: x right, y down, z forward; pixel centres at (i + 0.5, j + 0.5).

    A world point x has camera coordinates ``rotation (x - center)``. The centre is kept rather
    than the translation ``-rotation center``, which cancels far from the origin.
    """

    rotation: Any  # 3 x 3 (Matrix3f), world to camera
    center: Any  # Array3f, world
    focal: Any  # Array2f (fx, fy), px
    principal: Any  # Array2f (cx, cy), px
    film_start: Any  # Array2f, px: where the whole film begins, (0, 0) unless this is a crop window
    film_end: Any  # Array2f, px: where it ends, (width, height) unless this is a crop window
    near: Any  # Float, scene units: means with smaller z are culled
    width: int
    height: int
    lens: Lens = Pinhole()
    aperture: Aperture | None = None  # of a lens that blurs
    shutter: Shutter | None = None  # of a camera that moves while it is open

    @staticmethod
    def create(
        float_type: type,
        rotation: np.ndarray,
        center: np.ndarray,
        K: np.ndarray,
        width: int,
        height: int,
        near: float,
        lens: Lens = Pinhole(),
    ) -> Camera:
        """Upload a camera given as numpy arrays: rotation (3, 3), center (3,), K (3, 3) px."""
        t = types_of(float_type)
        rotation, center, K = (np.asarray(a, dtype=np.float64) for a in (rotation, center, K))

        def scalar(value: float) -> Any:
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

    def look_through(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """The ray through a place of the film (px): its origin, its direction, if it is one.

        Origin and direction (of any length) are Array3f in camera axes. A lens shows nothing at
        places where its model ends: what it looks for is then found elsewhere.
        """
        direction = self.lens.ray(self, x, y)
        origin = self.lens.origin(self, x, y)
        if not self.lens.distorts:
            return origin, direction, True
        seen, _, _ = self.lens.look(replace(self, near=type(self.near)(0)), direction)
        t = types_of(type(self.near))
        missed = self.lens.film_point(self, direction) - t.Array2f(x, y)
        return origin, direction, seen & (dr.squared_norm(missed) < MISSED**2)

    def view_directions(self, x: Any, y: Any, count: int) -> tuple[Any, Any, int]:
        """Directions in which places of the film (px) see: Array3f, world, of any length.

        count: how many there are of each place, next to each other, where the lens has an aperture,
        over which they are spread evenly; otherwise there is one.

        Returns them, whether they are any, and how many there are of each place.
        """
        if self.aperture is not None:
            return *self.aperture.rays(self, x, y, count), count
        camera = self.at_row(y)
        _, ray, seen = camera.look_through(x, y)
        return camera.rotation.T @ ray, seen, 1

    def place_of_ray(self, origin: Any, direction: Any) -> tuple[Any, Any]:
        """Where on the film a ray begins, Array2f, px; and how far from the middle of the lens.

        origin, direction: Array3f, camera axes. The latter is at most the radius of the aperture,
        Float, scene units.
        """
        if self.aperture is None:
            return self.lens.place_of_ray(self, origin, direction), type(self.near)(0)
        point = self.aperture.in_focus(origin, direction)
        return self.lens.film_point(self, point), self.aperture.radius

    def at_row(self, y: Any) -> Camera:
        """Where a camera is whose rows are read one after the other, when it reads that of y, px.

        One that does not move is as it is.
        """
        if self.shutter is None:
            return self
        row = (y - self.film_start.y) / (self.film_end.y - self.film_start.y)
        return self.shutter.pose(self, row)

    def seeing(self, means: Any) -> Camera:
        """Where a camera is whose rows are read one after the other, when it reads those of means.

        means: Array3f, world. One that does not move is as it is.
        """
        return self if self.shutter is None else self.shutter.camera_of(means, self)

    def numbers(self) -> list[Any]:
        """Pose, focal lengths, principal point and lens as Float of one entry, in a fixed order."""
        return [n for name in _DIFFERENTIABLE for n in _numbers_of(getattr(self, name))]

    def by_lane(self, width: int) -> Camera:
        """The same camera with these numbers stored for each of ``width`` lanes.

        Derivatives of each lane's are then known apart, and can be summed in a fixed order.
        """
        lanes = dr.zeros(types_of(type(self.near)).UInt32, width)
        return replace(
            self, **{name: _gathered(getattr(self, name), lanes) for name in _DIFFERENTIABLE}
        )

    def with_lens(self, lens: Lens) -> Camera:
        """The same camera with another lens."""
        return replace(self, lens=lens.upload(type(self.near)).fitted(self))


_DIFFERENTIABLE = ("rotation", "center", "focal", "principal", "lens", "aperture", "shutter")


def _numbers_of(value: Any) -> list[Any]:
    if is_dataclass(value):
        return [n for f in fields(value) for n in _numbers_of(getattr(value, f.name))]
    if isinstance(value, tuple) or (dr.is_array_v(value) and dr.depth_v(value) > 1):
        return [n for item in value for n in _numbers_of(item)]
    return [value] if dr.is_array_v(value) else []


def _gathered(value: Any, lanes: Any) -> Any:
    if is_dataclass(value):
        changes = {f.name: _gathered(getattr(value, f.name), lanes) for f in fields(value)}
        return replace(value, **changes)
    if isinstance(value, tuple):
        return tuple(_gathered(item, lanes) for item in value)
    return dr.gather(type(value), value, lanes) if dr.is_array_v(value) else value


def cameras_in_time(camera: Camera) -> list[Camera]:
    """The cameras whose pictures are averaged: one unless it is blurred by motion."""
    return [camera] if camera.shutter is None else camera.shutter.cameras(camera)


def uploaded(lens: Lens, float_type: type) -> Lens:
    """The lens, a dataclass, with Dr.Jit scalars for its numbers: kernels are the same for all."""

    def opaque(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(opaque(item) for item in value)
        return dr.opaque(float_type, value) if isinstance(value, float) else value

    return replace(lens, **{f.name: opaque(getattr(lens, f.name)) for f in fields(lens)})


def with_unseen_on_axis(position: Any, seen: Any) -> tuple[Any, Any, Any]:
    """``seen``, positions with those on the axis that are not seen, and their z.

    position: Array3f, camera axes; seen: Bool. A mean that is not seen is put at (0, 0, 1), where
    every lens is differentiable.
    """
    x, y, z = position
    z = dr.select(seen, z, 1)
    return seen, type(position)(dr.select(seen, x, 0), dr.select(seen, y, 0), z), z
