"""COLMAP's fisheye lens with tangential and thin prism terms.

Coefficients, and the end of the lens model: as in ``drgs.cameras.radial_tangential``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
from typing_extensions import override

from drgs.cameras.distortion import (
    PlaneDistortion,
    derivative,
    grouped_coefficients,
    largest_squared_radius,
    polynomial,
    steepest_fall,
)
from drgs.cameras.fisheye import MAX_ANGLE, Fisheye, place_directions, place_of
from drgs.cameras.lens import LENSES, CameraParameters, film_coordinates, pixel_coordinates
from drgs.core.arrays import types_of
from drgs.core.types import Array2f, Array3f, Float, Scalar


@LENSES.register("thin_prism_fisheye")
@dataclass(frozen=True)
class ThinPrismFisheye(PlaneDistortion, Fisheye):
    """A fisheye whose elements are not quite centred and not quite upright.

    A point at the angle theta from the axis is at (u, v) in a fisheye without coefficients, theta
    from the principal point in its direction. With r^2 = u^2 + v^2 = theta^2 and
    L = 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, this one shows it at

        u' = L u + 2 p1 u v + p2 (r^2 + 2 u^2) + sx1 r^2
        v' = L v + p1 (r^2 + 2 v^2) + 2 p2 u v + sy1 r^2

    (COLMAP's model THIN_PRISM_FISHEYE, in its ``sensor/models.h``; thin prisms: Weng, Cohen and
    Herniou 1992). COLMAP itself shows nothing beside and behind the camera.
    """

    groups: ClassVar[Mapping[str, tuple[str, ...]]] = {
        **Fisheye.groups,
        "tangential": ("p1", "p2"),
        "prism": ("sx1", "sy1"),
    }

    tangential: tuple[Scalar, ...] = ()  # p1, p2; or none
    prism: tuple[Scalar, ...] = ()  # sx1, sy1; or none

    @classmethod
    @override
    def from_coefficients(cls, **coefficients: float) -> ThinPrismFisheye:
        """Return the lens with COLMAP's coefficients; missing ones are zero."""
        radial, tangential, prism = grouped_coefficients(cls, coefficients)
        limit = largest_squared_radius(radial, (), steepest_fall(tangential, prism))
        return cls(radial, math.cos(min(math.sqrt(limit), MAX_ANGLE)), tangential, prism)

    @override
    def squared_limit(self) -> Scalar:
        return dr.square(dr.acos(self.min_cosine))

    @override
    def radial(self, squared: Float) -> Scalar:
        return polynomial(self.radial_terms, squared)

    @override
    def radial_derivative(self, squared: Float) -> Scalar:
        return derivative(self.radial_terms, squared)

    @override
    def is_radial(self) -> bool:
        return not (self.tangential or self.prism)

    @override
    def distort(self, x: Float, y: Float) -> tuple[Float, Float]:
        shown_x, shown_y = super().distort(x, y)
        if not self.prism:
            return shown_x, shown_y
        squared, (sx1, sy1) = x * x + y * y, self.prism
        return shown_x + sx1 * squared, shown_y + sy1 * squared

    @override
    def distortion_jacobian(self, x: Float, y: Float) -> tuple[Float, Float, Float, Float]:
        xx, xy, yx, yy = super().distortion_jacobian(x, y)
        if not self.prism:
            return xx, xy, yx, yy
        sx1, sy1 = self.prism
        return xx + 2 * sx1 * x, xy + 2 * sx1 * y, yx + 2 * sy1 * x, yy + 2 * sy1 * y

    @override
    def project_point(self, camera: CameraParameters, position: Array3f) -> Array2f:
        return pixel_coordinates(camera, *self.distort(*place_of(position)))

    @override
    def projection_jacobian(
        self, camera: CameraParameters, position: Array3f, slopes: list[Float] | None = None
    ) -> list[Array3f]:
        xx, xy, yx, yy = self.distortion_jacobian(*place_of(position))
        dx, dy = place_directions(camera, position)
        return [camera.focal.x * (xx * dx + xy * dy), camera.focal.y * (yx * dx + yy * dy)]

    @override
    def ray(self, camera: CameraParameters, x: Float, y: Float) -> Array3f:
        t, film = types_of(type(x)), film_coordinates(camera, x, y)
        u, v = self.undistort(film.x, film.y)
        squared = u * u + v * v
        off_axis = squared > 0
        angle = dr.sqrt(dr.select(off_axis, squared, 1))
        sine, cosine = dr.sincos(angle)
        scale = dr.select(off_axis, sine / angle, 1)
        return t.Array3f(scale * u, scale * v, dr.select(off_axis, cosine, 1))
