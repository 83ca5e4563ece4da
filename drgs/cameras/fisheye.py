"""OpenCV's fisheye lens.

Coefficients, and the end of the lens model: as in ``drgs.cameras.radial_tangential``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import numpy as np
from typing_extensions import override

from drgs.cameras.distortion import (
    derivative,
    first_root,
    grouped_coefficients,
    horner,
    polynomial,
    radius_at,
)
from drgs.cameras.lens import LENSES, CameraParameters, Lens, film_coordinates, pixel_coordinates
from drgs.core.arrays import is_float64, types_of
from drgs.core.types import Array2f, Array3f, Bool, Float, Scalar

MAX_ANGLE = 0.95 * math.pi
"""Radians from the axis: points behind the camera have no place on the film."""

NEAR_AXIS = 0.1
"""tan^2 of the angle below which series are used: theta / rho is 0 / 0 on the axis, and what its
derivative needs is a difference that cancels near it."""

AXIS_TERMS = {False: 8, True: 16}
"""Terms of these series in single and in double precision: 0.1^n is below their roundings."""


@LENSES.register("fisheye")
@dataclass(frozen=True)
class Fisheye(Lens):
    """A point at the angle theta from the axis is seen at a distance from the principal point of

        theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

    in its direction (Kannala and Brandt 2006, as in OpenCV's ``fisheye`` module). Means whose angle
    has a cosine below ``min_cosine`` are not seen.
    """

    groups: ClassVar[Mapping[str, tuple[str, ...]]] = {"radial_terms": ("k1", "k2", "k3", "k4")}

    radial_terms: tuple[Scalar, ...]  # k1 up to the last that is given
    min_cosine: Scalar

    @classmethod
    @override
    def from_coefficients(cls, **coefficients: float) -> Fisheye:
        """Return the lens with OpenCV's ``k1`` to ``k4``; missing ones are zero."""
        (terms,) = grouped_coefficients(cls, coefficients)
        growth = [1.0, *((2 * n + 3) * k for n, k in enumerate(terms))]
        turn = math.sqrt(first_root(np.array(growth)))
        return cls(terms, math.cos(min(turn, MAX_ANGLE)))

    @override
    def shows(self, position: Array3f) -> Bool:
        """Return whether a point's angle from the axis is within the model."""
        return position.z > self.min_cosine * dr.norm(position)

    @override
    def project_point(self, camera: CameraParameters, position: Array3f) -> Array2f:
        return pixel_coordinates(camera, *place_of(position, self.radial_terms))

    @override
    def projection_jacobian(
        self, camera: CameraParameters, position: Array3f, slopes: list[Float] | None = None
    ) -> list[Array3f]:
        directions = place_directions(camera, position, self.radial_terms)
        return [f * direction for f, direction in zip(camera.focal, directions, strict=True)]

    @override
    def ray(self, camera: CameraParameters, x: Float, y: Float) -> Array3f:
        t, film = types_of(type(x)), film_coordinates(camera, x, y)
        squared = dr.squared_norm(film)
        off_axis = squared > 0
        radius = dr.sqrt(dr.select(off_axis, squared, 1))
        with dr.suspend_grad():
            end = dr.acos(self.min_cosine)
            angle = radius_at(self._distorted_angle, radius, end)
        # The last step of Newton's method is differentiated, as in ``RadialTangential``.
        value, slope = self._distorted_angle(angle)
        following = angle + (radius - value) / dr.detach(slope)
        sine, cosine = dr.sincos(dr.select(following < end, following, angle))
        scale = dr.select(off_axis, sine / radius, 1)
        return t.Array3f(scale * film.x, scale * film.y, dr.select(off_axis, cosine, 1))

    def _distorted_angle(self, angle: Float) -> tuple[Float, Scalar]:
        """Return theta_d of an angle, and its derivative."""
        squared = angle * angle
        h, dh = polynomial(self.radial_terms, squared), derivative(self.radial_terms, squared)
        return h * angle, h + 2 * dh * squared


def place_of(position: Array3f, coefficients: Sequence[Scalar] = ()) -> tuple[Float, Float]:
    """Return the place of a point (camera axes) on the film, in focal lengths."""
    x, y, _ = position
    per_radius, _ = _angle_per_radius(position)
    scale = per_radius * polynomial(coefficients, _squared_angle(position, per_radius))
    return scale * x, scale * y


def place_directions(
    camera: CameraParameters, position: Array3f, coefficients: Sequence[Scalar] = ()
) -> list[Array3f]:
    """Return the derivatives of that place, world: per scene unit.

    With rho^2 = x^2 + y^2, n^2 = rho^2 + z^2, a = theta / rho, b = (d a / d rho) / rho, and
    theta_d = h theta: the place is A (x, y) with A = h a, (d A / d rho) / rho = B = h b +
    2 h' a^2 z / n^2, where h' = d h / d theta^2, and d A / d z = -(h + 2 h' theta^2) / n^2.
    """
    x, y, z = position
    a, b = _angle_per_radius(position)
    squared = _squared_angle(position, a)
    h, dh = polynomial(coefficients, squared), derivative(coefficients, squared)
    inverse = dr.rcp(dr.squared_norm(position))
    scale, bend = h * a, h * b + 2 * dh * (a * a) * (z * inverse)
    tilt = (h + 2 * dh * squared) * inverse
    right, down, forward = camera.rotation
    change = bend * (x * right + y * down) - tilt * forward
    return [scale * axis + c * change for axis, c in zip((right, down), (x, y), strict=True)]


def _angle_per_radius(position: Array3f) -> tuple[Float, Float]:
    """Return a = theta / rho and b = (z / n^2 - a) / rho^2, near the axis by their series.

    With t = rho / z: z a = 1 - t^2 / 3 + t^4 / 5 ..., z^3 b = -2/3 + 4/5 t^2 - 6/7 t^4 ...
    """
    x, y, z = position
    squared = x * x + y * y
    on_axis = (z > 0) & (squared < NEAR_AXIS * (z * z))
    depth = dr.select(on_axis, z, 1)
    t = dr.select(on_axis, squared, 0) / (depth * depth)
    terms = range(AXIS_TERMS[is_float64(type(z))])
    series_a = polynomial([(-1) ** (k + 1) / (2 * k + 3) for k in terms], t) / depth
    series_b = [(-1) ** (k + 1) * (2 * k + 2) / (2 * k + 3) for k in terms]
    series_b = horner(series_b, t) / (depth * depth * depth)
    squared = dr.select(on_axis, 1, squared)
    radius = dr.sqrt(squared)
    a = dr.atan2(radius, z) / radius
    b = (z / (squared + z * z) - a) / squared
    return dr.select(on_axis, series_a, a), dr.select(on_axis, series_b, b)


def _squared_angle(position: Array3f, per_radius: Float) -> Float:
    return (per_radius * per_radius) * (dr.square(position.x) + dr.square(position.y))
