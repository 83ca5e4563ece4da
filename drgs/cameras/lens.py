"""Lenses: where points are on the film, and along which ray a place of the film looks.

A lens is a frozen dataclass derived from :class:`Lens`, whose fields are its coefficients. It is
known by the name under which it enters :data:`LENSES`: as ``lens`` of the sensor ``calibrated`` and
as ``camera_model`` of a ``transforms.json``. :class:`Pinhole` is the default; the other lenses are
in modules of their own, which are imported when a camera has one.

Conventions: camera axes are OpenCV's (x right, y down, z forward); places on the film are in pixels
from its upper left corner; lengths are in scene units. Positions are Dr.Jit arrays, one a lane.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from itertools import chain
from typing import ClassVar

import drjit as dr
from typing_extensions import override

from drgs.core.arrays import types_of
from drgs.core.constants import MAX_COEFFICIENT, TAN_CLAMP
from drgs.core.errors import UserError
from drgs.core.registry import ClassRegistry
from drgs.core.types import Array2f, Array3f, Bool, Float, Matrix3f, Scalar, UInt32

LENSES: ClassRegistry[Lens] = ClassRegistry("lens", "drgs.lenses")
"""Lenses by name."""

NEWTON_STEPS = 24
"""Steps of the search for a ray: most need 5; those that would leave the lens are halved."""


@dataclass(frozen=True)
class CameraParameters:
    """Parameters of a camera that its lens may use: Dr.Jit scalars.

    A world point x has camera coordinates ``rotation (x - center)``. The centre is kept rather
    than the translation ``-rotation center``, which cancels far from the origin.
    """

    rotation: Matrix3f  # world to camera: its rows are the camera's axes in the world
    center: Array3f  # world
    focal: Array2f  # (fx, fy), px
    principal: Array2f  # (cx, cy), px
    film_start: Array2f  # px: where the whole film begins, (0, 0) unless this is a crop window
    film_end: Array2f  # px: where it ends, (width, height) unless this is a crop window
    near: Float  # scene units: means with smaller z are culled


@dataclass(frozen=True)
class Lens:
    """A lens whose rays meet in the camera's centre, and may come from beside and behind it.

    A subclass defines :meth:`project_point`, :meth:`projection_jacobian` and, unless it leaves that
    to Newton's method, :meth:`ray`. The other methods suit most lenses; :class:`Perspective` is the
    base of lenses that see what is in front of them only.
    """

    kind: ClassVar[str] = ""  # name in LENSES
    distorts: ClassVar[bool] = True  # whether a pinhole could take its place
    parallel: ClassVar[bool] = False  # whether its rays are, instead of meeting in the camera
    whole_turn: ClassVar[bool] = False
    """True if the whole film is a turn about the vertical axis. Its left side then continues at the
    right one, and the camera's focal lengths and principal point are not used."""
    groups: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Names of coefficients by field, a tuple of the first of them; none: a field is a coefficient.
    """

    @abstractmethod
    def project_point(self, camera: CameraParameters, position: Array3f) -> Array2f:
        """Return the place of a point on the film, px; position: camera axes."""
        raise NotImplementedError

    @abstractmethod
    def projection_jacobian(
        self, camera: CameraParameters, position: Array3f, slopes: list[Float] | None = None
    ) -> list[Array3f]:
        """Return the derivatives of x and of y on the film, world: px per scene unit.

        slopes: of the ray of projection, see :meth:`clamped_slopes`; None: those of the point.
        """
        raise NotImplementedError

    def ray(self, camera: CameraParameters, x: Float, y: Float) -> Array3f:
        """Return the direction of the ray through a place of the film (px).

        It is in camera axes, of any length. Here it is found by Newton's method on the
        sphere of directions, from the axis. The search is not differentiated, but its last step: a
        step from the solution has the solution's derivative (the implicit function theorem).
        """
        t = types_of(type(x))
        axes = replace(camera, rotation=dr.identity(t.Matrix3f))

        def step(direction: Array3f, factor: Scalar = 1) -> Array3f:
            """Return where ``factor`` of the shortest step of a linear projection leads."""
            missed = t.Array2f(x, y) - self.project_point(axes, direction)
            with dr.suspend_grad():
                dx, dy = self.projection_jacobian(axes, direction)
                xx, xy, yy = dr.dot(dx, dx), dr.dot(dx, dy), dr.dot(dy, dy)
                per_determinant = factor / (xx * yy - xy * xy)
            along_x = (yy * missed.x - xy * missed.y) * per_determinant
            along_y = (xx * missed.y - xy * missed.x) * per_determinant
            return dr.normalize(direction + along_x * dx + along_y * dy)

        def body(count: UInt32, direction: Array3f, factor: Float) -> tuple[UInt32, Array3f, Float]:
            following = step(direction, factor)
            shown = self.shows(following)
            factor = dr.select(shown, dr.minimum(2 * factor, 1), factor / 2)
            return count + 1, dr.select(shown, following, direction), factor

        with dr.suspend_grad():
            _, direction, _ = dr.while_loop(
                state=(t.UInt32(0), t.Array3f(0, 0, 1), t.Float(1)),
                cond=lambda count, direction, factor: count < NEWTON_STEPS,
                body=body,
                labels=("count", "direction", "factor"),
            )
        return step(direction)

    @classmethod
    def coefficient_names(cls) -> tuple[str, ...]:
        """Return the names of all coefficients."""
        return tuple(chain(*cls.groups.values())) or tuple(field.name for field in fields(cls))

    @classmethod
    def from_coefficients(cls, **coefficients: float) -> Lens:
        """Return the lens; UserError for a coefficient that is missing, or too large."""
        check_coefficients(coefficients)
        try:
            return cls(**{name: float(value) for name, value in coefficients.items()})
        except TypeError:
            names = ", ".join(cls.coefficient_names())
            got = ", ".join(coefficients) or "none"
            raise UserError(f"lens {cls.kind} has the coefficients {names}; got {got}") from None

    def coefficients(self) -> dict[str, Scalar]:
        """Return the coefficients by name, without those that are left out."""
        if not self.groups:
            return {name: getattr(self, name) for name in self.coefficient_names()}
        groups = (zip(names, getattr(self, f), strict=False) for f, names in self.groups.items())
        return dict(chain(*groups))

    def with_coefficients(self, values: Mapping[str, Scalar]) -> Lens:
        """Return the lens with other numbers for its coefficients; the model's end stays."""
        if not self.groups:
            return replace(self, **{name: values[name] for name in self.coefficients()})
        given = {f: names[: len(getattr(self, f))] for f, names in self.groups.items()}
        return replace(self, **{f: tuple(values[n] for n in names) for f, names in given.items()})

    def describe(self) -> str:
        """Return the lens's name and the names of its coefficients."""
        names = ", ".join(self.coefficients())
        return f"{self.kind} ({names})" if names else self.kind

    def upload(self, float_type: type) -> Lens:
        """Return the lens with Dr.Jit scalars for its numbers: kernels are the same for all."""

        def opaque(value: object) -> object:
            if isinstance(value, tuple):
                return tuple(opaque(item) for item in value)
            return dr.opaque(float_type, value) if isinstance(value, float) else value

        return replace(self, **{f.name: opaque(getattr(self, f.name)) for f in fields(self)})

    def for_camera(self, camera: CameraParameters) -> Lens:
        """Return the lens with the limits of the film of ``camera``."""
        return self

    def shows(self, position: Array3f) -> Bool:
        """Return whether the lens sees a point (camera axes) at any distance.

        Points that it does not see need no place on the film: they are moved to the axis first.
        """
        return position.z > 0

    def visibility(
        self, camera: CameraParameters, position: Array3f
    ) -> tuple[Bool, Array3f, Float]:
        """Return whether a point is seen, its position, and its depth: the distance, scene units.

        Position and depth of a point that is not seen are replaced: a masked lane must not divide
        by zero, as 0 * inf would poison the gradient of its neighbours.
        """
        seen = (dr.norm(position) >= camera.near) & self.shows(position)
        _, position, _ = with_unseen_on_axis(position, seen)
        return seen, position, dr.norm(position)

    def true_slopes(self, camera: CameraParameters, position: Array3f) -> list[Float] | None:
        """Return x / z and y / z of a point; None if the projection is linearised at the point."""
        return None

    def clamped_slopes(self, camera: CameraParameters, position: Array3f) -> list[Float] | None:
        """Return the same, but not far outside the film: see ``constants.TAN_CLAMP``."""
        return None

    def depth_direction(self, camera: CameraParameters, position: Array3f) -> Array3f:
        """Return the derivative of the depth divided by the depth, world."""
        right, down, forward = camera.rotation
        x, y, z = position / dr.squared_norm(position)
        return x * right + y * down + z * forward

    def ray_range(self, direction: Array3f, near: Float, far: Float) -> tuple[Float, Float]:
        """Return where a ray of unit ``direction`` (camera axes) reaches two depths."""
        return near, far

    def view_direction(self, camera: CameraParameters, offset: Array3f) -> Array3f:
        """Return a point's direction, world, any length; offset: from the centre to it, world."""
        return offset

    def origin(self, camera: CameraParameters, x: Float, y: Float) -> Array3f:
        """Return where the ray through a place of the film (px) begins, camera axes."""
        return types_of(type(x)).Array3f(0, 0, 0)

    def place_of_ray(
        self, camera: CameraParameters, origin: Array3f, direction: Array3f
    ) -> Array2f:
        """Return the place on the film of a ray (camera axes), px."""
        return self.project_point(camera, direction)

    def focal_lengths(self, camera: CameraParameters) -> Array2f:
        """Return px per radian on the axis."""
        return camera.focal

    def period(self, camera: CameraParameters) -> Float | None:
        """Return after how many px along x the film shows the same again; None: it does not."""
        return camera.film_end.x - camera.film_start.x if self.whole_turn else None

    def offset(self, camera: CameraParameters, start: Array2f, end: Array2f) -> Array2f:
        """Return the shortest way from one place of the film to another, px."""
        x, y = end - start
        return type(start)(shortest(x, self.period(camera)), y)


class Perspective(Lens):
    """A lens that sees points in front of it, and whose depth is z."""

    @override
    def visibility(
        self, camera: CameraParameters, position: Array3f
    ) -> tuple[Bool, Array3f, Float]:
        x, y, z = position
        seen = z >= camera.near
        z = dr.select(seen, z, 1)
        return seen, type(position)(x, y, z), z

    @override
    def true_slopes(self, camera: CameraParameters, position: Array3f) -> list[Float] | None:
        return slopes_of(position)

    @override
    def clamped_slopes(self, camera: CameraParameters, position: Array3f) -> list[Float] | None:
        start, end = self.frustum(camera)
        margin = TAN_CLAMP * (end - start) / 2
        bounds = zip(slopes_of(position), start - margin, end + margin, strict=True)
        return [dr.select(s < lo, lo, dr.select(s > hi, hi, s)) for s, lo, hi in bounds]

    @override
    def depth_direction(self, camera: CameraParameters, position: Array3f) -> Array3f:
        return camera.rotation[2] / position.z

    @override
    def ray_range(self, direction: Array3f, near: Float, far: Float) -> tuple[Float, Float]:
        return near / direction.z, far / direction.z

    def frustum(self, camera: CameraParameters) -> tuple[Array2f, Array2f]:
        """Return the least and the largest slopes on the film."""
        # Of the whole film: a crop window is a part of the same image.
        start = (camera.film_start - camera.principal) / camera.focal
        end = (camera.film_end - camera.principal) / camera.focal
        return start, end


@LENSES.register("pinhole")
@dataclass(frozen=True)
class Pinhole(Perspective):
    """A point (x, y, z) is seen at focal (x, y) / z + principal."""

    distorts: ClassVar[bool] = False

    @override
    def project_point(self, camera: CameraParameters, position: Array3f) -> Array2f:
        x, y, z = position
        return camera.focal * types_of(type(z)).Array2f(x, y) / z + camera.principal

    @override
    def projection_jacobian(
        self, camera: CameraParameters, position: Array3f, slopes: list[Float] | None = None
    ) -> list[Array3f]:
        # J's rows are focal / z (e_axis - slope e_z).
        right, down, forward = camera.rotation
        slopes = slopes or slopes_of(position)
        return [
            (axis - slope * forward) * (focal / position.z)
            for axis, focal, slope in zip((right, down), camera.focal, slopes, strict=True)
        ]

    @override
    def ray(self, camera: CameraParameters, x: Float, y: Float) -> Array3f:
        film = film_coordinates(camera, x, y)
        return types_of(type(x)).Array3f(film.x, film.y, 1)


PINHOLE = Pinhole()


def shortest(dx: Float, period: Float | None) -> Float:
    """Return an offset along x, px, across the sides of the film where that is shorter."""
    return dx if period is None else dr.fma(-period, dr.round(dx / period), dx)


def slopes_of(position: Array3f) -> list[Float]:
    """Return x / z and y / z of a point, camera axes."""
    return [position.x / position.z, position.y / position.z]


def film_coordinates(camera: CameraParameters, x: Float, y: Float) -> Array2f:
    """Return a place of the film (px) in focal lengths from the principal point."""
    return (types_of(type(x)).Array2f(x, y) - camera.principal) / camera.focal


def pixel_coordinates(camera: CameraParameters, x: Float, y: Float) -> Array2f:
    """Return the place of the film, px; the inverse of :func:`film_coordinates`."""
    return camera.focal * types_of(type(x)).Array2f(x, y) + camera.principal


def check_coefficients(given: Mapping[str, float]) -> None:
    """Raise :class:`UserError` naming the first that is larger than :data:`MAX_COEFFICIENT`."""
    for name, value in given.items():
        if not abs(value) <= MAX_COEFFICIENT:
            raise UserError(
                f"{name} must be a coefficient of at most {MAX_COEFFICIENT:g} in size, got "
                f"{value:g}; calibrate the camera again"
            )


def with_unseen_on_axis(position: Array3f, seen: Bool) -> tuple[Bool, Array3f, Float]:
    """Return ``seen``, positions, z; the unseen at (0, 0, 1), where lenses are differentiable."""
    x, y, z = position
    z = dr.select(seen, z, 1)
    return seen, type(position)(dr.select(seen, x, 0), dr.select(seen, y, 0), z), z
