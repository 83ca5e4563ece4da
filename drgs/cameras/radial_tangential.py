"""OpenCV's lens with radial and tangential distortion.

Coefficients are numbers of the host, or Dr.Jit scalars after :meth:`Lens.upload`. Nothing is
computed for those that are not given: after the last of a polynomial, or both tangential ones.

Far from the axis the model's polynomials turn around, and would fold what lies far outside back
into the image. Points beyond the angle at which the model first turns are not seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import drjit as dr
from typing_extensions import override

from drgs.cameras.distortion import (
    UNBOUNDED_SLOPE,
    PlaneDistortion,
    derivative,
    grouped_coefficients,
    largest_squared_radius,
    polynomial,
    steepest_fall,
)
from drgs.cameras.lens import (
    LENSES,
    CameraParameters,
    Perspective,
    film_coordinates,
    pixel_coordinates,
    slopes_of,
    with_unseen_on_axis,
)
from drgs.core.arrays import types_of
from drgs.core.types import Array2f, Array3f, Bool, Float, Scalar

BORDER_POINTS_PER_SIDE = 65
"""Points on each side of the film's border, whose slopes bound those on the film."""

MAX_SQUARED_SLOPE_ERROR = 1e-6  # squared distance, in slopes, at which Newton's method may end


@LENSES.register("opencv")
@dataclass(frozen=True)
class RadialTangential(PlaneDistortion, Perspective):
    """OpenCV's lens, which distorts slopes (x, y).

    With r^2 = x^2 + y^2 and L = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),

        x' = L x + 2 p1 x y + p2 (r^2 + 2 x^2),  y' = L y + p1 (r^2 + 2 y^2) + 2 p2 x y

    (Brown 1966; OpenCV's documentation, "Camera Calibration and 3D Reconstruction"). Means whose r
    is beyond ``max_squared_radius`` are not seen.
    """

    groups: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "numerator": ("k1", "k2", "k3"),
        "denominator": ("k4", "k5", "k6"),
        "tangential": ("p1", "p2"),
    }

    numerator: tuple[Scalar, ...]  # k1, k2, k3
    denominator: tuple[Scalar, ...]  # k4, k5, k6
    tangential: tuple[Scalar, ...]  # p1, p2; or none
    max_squared_radius: Scalar  # of the slopes
    on_film: tuple[Array2f, Array2f] | None = None  # the least and the largest slopes on the film

    @classmethod
    @override
    def from_coefficients(cls, **coefficients: float) -> RadialTangential:
        """Return the lens with OpenCV's ``k1`` to ``k6``, ``p1``, ``p2``; others are zero."""
        numerator, denominator, tangential = grouped_coefficients(cls, coefficients)
        limit = largest_squared_radius(numerator, denominator, steepest_fall(tangential))
        return cls(numerator, denominator, tangential, limit)

    @override
    def squared_limit(self) -> Scalar:
        return self.max_squared_radius

    @override
    def radial(self, squared: Float) -> Scalar:
        return polynomial(self.numerator, squared) / polynomial(self.denominator, squared)

    @override
    def radial_derivative(self, squared: Float) -> Scalar:
        denominator = polynomial(self.denominator, squared)
        change = derivative(self.numerator, squared)
        change = change - self.radial(squared) * derivative(self.denominator, squared)
        return change / denominator

    @override
    def visibility(
        self, camera: CameraParameters, position: Array3f
    ) -> tuple[Bool, Array3f, Float]:
        x, y, z = position
        # Not divided by z, which may be zero.
        limit = self.max_squared_radius * z * z
        return with_unseen_on_axis(position, (z >= camera.near) & (x * x + y * y < limit))

    @override
    def project_point(self, camera: CameraParameters, position: Array3f) -> Array2f:
        return pixel_coordinates(camera, *self.distort(*slopes_of(position)))

    @override
    def projection_jacobian(
        self, camera: CameraParameters, position: Array3f, slopes: list[Float] | None = None
    ) -> list[Array3f]:
        slopes = slopes or slopes_of(position)
        xx, xy, yx, yy = self.distortion_jacobian(*slopes)
        right, down, forward = camera.rotation
        dx, dy = (
            (axis - slope * forward) / position.z
            for axis, slope in zip((right, down), slopes, strict=True)
        )
        return [camera.focal.x * (xx * dx + xy * dy), camera.focal.y * (yx * dx + yy * dy)]

    @override
    def for_camera(self, camera: CameraParameters) -> RadialTangential:
        return replace(self, on_film=_slopes_on_border(self, camera))

    @override
    def frustum(self, camera: CameraParameters) -> tuple[Array2f, Array2f]:
        assert self.on_film is not None, "Camera.with_lens() sets it"
        return self.on_film

    @override
    def ray(self, camera: CameraParameters, x: Float, y: Float) -> Array3f:
        t, film = types_of(type(x)), film_coordinates(camera, x, y)
        return t.Array3f(*self.undistort(film.x, film.y), 1)


def _slopes_on_border(lens: RadialTangential, camera: CameraParameters) -> tuple[Array2f, Array2f]:
    """Return the box of slopes on the film's border; if not all are seen, up to the model's end."""
    t = types_of(type(camera.near))
    side = dr.linspace(t.Float, 0, 1, BORDER_POINTS_PER_SIDE)
    zero, one = dr.zeros(t.Float, BORDER_POINTS_PER_SIDE), dr.ones(t.Float, BORDER_POINTS_PER_SIDE)
    start, end = camera.film_start, camera.film_end
    x = dr.concat([side, side, zero, one]) * (end.x - start.x) + start.x
    y = dr.concat([zero, one, side, side]) * (end.y - start.y) + start.y
    film = film_coordinates(camera, x, y)
    slopes = lens.undistort(film.x, film.y)
    missed = dr.squared_norm(t.Array2f(*lens.distort(*slopes)) - film)
    bounded = dr.all(lens.is_within(*slopes) & (missed < MAX_SQUARED_SLOPE_ERROR))
    least, largest = (
        t.Array2f([dr.select(bounded, _mean_where(s, extreme(s)), other) for s in slopes])
        for extreme, other in ((dr.min, -UNBOUNDED_SLOPE), (dr.max, UNBOUNDED_SLOPE))
    )
    return least, largest


def _mean_where(values: Float, extreme: Float) -> Float:
    """Return ``extreme``, with the mean derivative of the values that are it.

    Several corners of a film may be equally far: Dr.Jit's own reductions add up their derivatives.
    """
    equal = values == extreme
    return dr.sum(dr.select(equal, values, 0)) / type(values)(dr.count(equal))
