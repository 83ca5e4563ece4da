"""Colour in the direction of each pixel's ray: ``sh_direction: pixel``.

A splat's spherical harmonics are stored, and evaluated in the direction of each pixel. The basis
functions depend on the pixel alone and are computed once per lane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
from typing_extensions import override

from drgs.cameras.camera import Camera
from drgs.core.constants import COLOR_MIN
from drgs.core.errors import UnsupportedError
from drgs.core.types import Array3f, Float
from drgs.gaussians.sh import num_coefficients, sh_basis
from drgs.splatting.footprint import SamplePositions, SplatFeatures
from drgs.splatting.grid import Lanes
from drgs.splatting.projection import GaussianRows

CHANNELS = 3


def stored_coefficients(rows: GaussianRows, direction: Array3f, sh_degree: int) -> list[Float]:
    """Return the stored numbers of a splat's colour: its coefficients, three colours each."""
    del direction
    return [value for c in rows.sh[: num_coefficients(sh_degree)] for value in c]


@dataclass(frozen=True)
class RayColors(SplatFeatures):
    """Colours by SH coefficients, stored first. Not differentiated: the direction."""

    sh_degree: int
    camera: Camera | None = None
    basis: tuple[list[Float], ...] = ()  # by pixel, for the lanes of one kernel

    @property
    def num_coefficients(self) -> int:
        """The number of stored numbers of a Gaussian."""
        return CHANNELS * num_coefficients(self.sh_degree)

    @override
    def num_planes(self, num_stored: int) -> int:
        return num_stored - self.num_coefficients + CHANNELS

    @override
    def for_camera(self, camera: Camera) -> RayColors:
        return replace(self, camera=camera)

    @override
    def check_differentiable_in_camera(self) -> None:
        if self.sh_degree == 0:
            return
        raise UnsupportedError(
            "splats: sh_direction 'pixel' is not differentiable in the camera; use 'mean'"
        )

    @override
    def with_weight_derivatives(self) -> RayColors:
        return WithWeightDerivatives(self.sh_degree, self.camera)

    @override
    def bind(self, lanes: Lanes, positions: SamplePositions) -> RayColors:
        assert self.camera is not None, "bound by for_camera"
        points = positions.points(lanes, type(self.camera.near))
        basis = tuple(sh_basis(self._direction(x, y), self.sh_degree) for x, y in points)
        return replace(self, basis=basis)

    def _direction(self, x: Float, y: Float) -> Array3f:
        assert self.camera is not None, "bound by for_camera"
        camera = self.camera.at_row(y)
        return dr.normalize(camera.rotation.T @ camera.lens.ray(camera, x, y))

    @override
    def pixel_values(self, stored: list[Float], pixel: int) -> list[Float]:
        sums = self._sums(stored, pixel)
        colors = [dr.select(value < COLOR_MIN, COLOR_MIN, value) for value in sums]
        return colors + stored[self.num_coefficients :]

    def _sums(self, stored: list[Float], pixel: int, start: float = 0.5) -> list[Float]:
        sums = [type(stored[0])(start)] * CHANNELS
        for k, basis in enumerate(self.basis[pixel]):
            coefficients = stored[CHANNELS * k : CHANNELS * (k + 1)]
            sums = [dr.fma(c, basis, total) for c, total in zip(coefficients, sums, strict=True)]
        return sums

    @override
    def add_derivatives(
        self, totals: list[Float], stored: list[Float], pixel: int, weight: Float, g: list[Float]
    ) -> list[Float]:
        pairs = zip(self._sums(stored, pixel), g[:CHANNELS], strict=True)
        d_colors = [dr.select(value < COLOR_MIN, 0, weight * d) for value, d in pairs]
        coefficients, others = totals[: self.num_coefficients], totals[self.num_coefficients :]
        d_basis = [(basis, d) for basis in self.basis[pixel] for d in d_colors]
        pairs = zip(coefficients, d_basis, strict=True)
        sums = [dr.fma(d, basis, total) for total, (basis, d) in pairs]
        rest = zip(others, g[CHANNELS:], strict=True)
        return sums + [dr.fma(weight, derivative, total) for total, derivative in rest]

    @override
    def tangents(self, stored: list[Float], d_stored: list[Float], pixel: int) -> list[Float]:
        pairs = zip(self._sums(stored, pixel), self._sums(d_stored, pixel, 0), strict=True)
        d_colors = [dr.select(value < COLOR_MIN, 0, d) for value, d in pairs]
        return d_colors + d_stored[self.num_coefficients :]


class WithWeightDerivatives(RayColors):
    """The same, with the weights of compositing as derivatives of the first coefficient."""

    @override
    def add_derivatives(
        self, totals: list[Float], stored: list[Float], pixel: int, weight: Float, g: list[Float]
    ) -> list[Float]:
        del stored, pixel
        return [dr.fma(weight, g[0], totals[0]), *totals[1:]]
