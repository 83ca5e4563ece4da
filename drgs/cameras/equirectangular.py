"""Panoramas: all directions on one film, as COLMAP's EQUIRECTANGULAR."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
from typing_extensions import override

from drgs.cameras.lens import LENSES, CameraParameters, Lens
from drgs.core.arrays import types_of
from drgs.core.types import Array2f, Array3f, Bool, Float

MIN_POLE_ANGLE = 1e-6
"""Radians: a mean that is nearer to the vertical axis has no longitude, and is not seen."""


@LENSES.register("equirectangular")
@dataclass(frozen=True)
class Equirectangular(Lens):
    """A point (x, y, z) of longitude theta and latitude phi is seen at

        width (theta / (2 pi) + 1/2), height (phi / pi + 1/2)

    with theta = atan2(x, z), phi = atan2(y, rho) and rho^2 = x^2 + z^2. The film is a whole turn:
    splats at one of its sides continue at the other.
    """

    distorts: ClassVar[bool] = False
    whole_turn: ClassVar[bool] = True

    @override
    def shows(self, position: Array3f) -> Bool:
        """Return whether a point has a longitude."""
        return _squared_radius(position) > MIN_POLE_ANGLE**2 * dr.squared_norm(position)

    @override
    def project_point(self, camera: CameraParameters, position: Array3f) -> Array2f:
        x, y, z = position
        place = types_of(type(x)).Array2f(
            dr.atan2(x, z), dr.atan2(y, dr.sqrt(_squared_radius(position)))
        )
        return place * self.focal_lengths(camera) + (camera.film_start + camera.film_end) / 2

    @override
    def projection_jacobian(
        self, camera: CameraParameters, position: Array3f, slopes: list[Float] | None = None
    ) -> list[Array3f]:
        # d theta = (z dx - x dz) / rho^2; d phi = (rho dy - y d rho) / |p|^2 with
        # d rho = (x dx + z dz) / rho.
        x, y, z = position
        right, down, forward = camera.rotation
        squared, focal = _squared_radius(position), self.focal_lengths(camera)
        radius = dr.sqrt(squared)
        around = (z * right - x * forward) * (focal.x / squared)
        outward = (x * right + z * forward) / radius
        along = (radius * down - y * outward) * (focal.y / dr.squared_norm(position))
        return [around, along]

    @override
    def focal_lengths(self, camera: CameraParameters) -> Array2f:
        size = camera.film_end - camera.film_start
        return type(size)(size.x / (2 * math.pi), size.y / math.pi)

    @override
    def ray(self, camera: CameraParameters, x: Float, y: Float) -> Array3f:
        t = types_of(type(x))
        middle = (camera.film_start + camera.film_end) / 2
        theta, phi = (t.Array2f(x, y) - middle) / self.focal_lengths(camera)
        (sin_theta, cos_theta), (sin_phi, cos_phi) = dr.sincos(theta), dr.sincos(phi)
        return t.Array3f(sin_theta * cos_phi, sin_phi, cos_theta * cos_phi)


def _squared_radius(position: Array3f) -> Float:
    return dr.square(position.x) + dr.square(position.z)
