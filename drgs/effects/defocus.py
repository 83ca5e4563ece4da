"""Depth of field: what is out of focus is blurred, as a thin lens blurs it.

A point is spread over a disc, whose variance is added to the splat's covariance on the film; the
opacity falls such that its integral stays, and the alpha at which it ends with it: many small
splats far out of focus are as opaque as in focus. What is seen past a blurred edge needs rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from drgs.cameras.camera import Camera
from drgs.core.constants import NEGLIGIBLE_ALPHA
from drgs.splatting.cutoffs import Cutoffs
from drgs.splatting.footprint import Footprint, GaussianFalloff, Offsets, Positions
from drgs.splatting.projection import FilmShape, GaussianRows, Projection, Splats2D


@dataclass(frozen=True)
class Defocused:
    """A projection, blurred by the camera's aperture."""

    shape: Projection

    def __call__(
        self, rows: GaussianRows, camera: Camera, position: Any, low_pass: float
    ) -> FilmShape:
        """Return the blurred shape, whose ``dimming`` keeps the integral."""
        film = self.shape(rows, camera, position, low_pass)
        spread = camera.aperture.variance(camera, position.z)
        blurred = self.shape(rows, camera, position, low_pass + spread)
        return replace(
            blurred,
            determinant=film.determinant,
            added_determinant=film.added_determinant,
            dimming=blurred.root_determinant() / film.root_determinant(),
        )


@dataclass(frozen=True)
class DimmedFalloff(GaussianFalloff):
    """Falloff whose splats end as if undimmed; geometry: then the base-2 logarithm of dimming."""

    of: GaussianFalloff

    @property
    def num_geometry(self) -> int:
        return self.of.num_geometry + 1

    @property
    def num_moments(self) -> int:
        return self.of.num_moments

    def for_camera(self, camera: Camera) -> DimmedFalloff:
        return replace(self, of=self.of.for_camera(camera))

    def log2_opacity(self, geometry: list[Any]) -> Any:
        return self.of.log2_opacity(geometry[:-1])

    def log2_floor(self, geometry: list[Any], cutoffs: Cutoffs) -> Any:
        log2_dimming = geometry[-1]
        floor = cutoffs.log2_floor(self.log2_opacity(geometry) - log2_dimming) + log2_dimming
        least = math.log2(NEGLIGIBLE_ALPHA)
        return dr.select(floor > least, floor, least)

    def geometry(self, splats: Splats2D) -> list[Any]:
        return [*self.of.geometry(splats), dr.log2(splats.dimming)]

    def differentiable(self, splats: Splats2D) -> list[Any]:
        return [*self.of.differentiable(splats), dr.detach(splats.dimming)]

    def bounds(self, splats: Splats2D, geometry: list[Any], reach: Any) -> tuple[Any, Any]:
        return self.of.bounds(splats, geometry[:-1], reach)

    def outline(self, geometry: list[Any], reach: Any) -> list[Any]:
        """Mean x, y, p, r, s of an ellipse |U d|^2 <= ``reach`` that holds the splat."""
        return self.of.outline(geometry[:-1], reach)

    def coordinates(self, geometry: list[Any], x: Any, y: Any) -> tuple[Any, Any]:
        return self.of.coordinates(geometry[:-1], x, y)

    def footprint(self, geometry: list[Any], offsets_from: Offsets, active: Any) -> Footprint:
        return self.of.footprint(geometry[:-1], offsets_from, active)

    def moments(self, footprint: Footprint, weights: list[Any], positions: Positions) -> list[Any]:
        """Sums over the 16 pixels."""
        return self.of.moments(footprint, weights, positions)

    def derivatives(self, geometry: list[Any], totals: list[Any]) -> list[Any]:
        """From moments to the derivatives of what :meth:`differentiable` lists."""
        derivatives = self.of.derivatives(geometry[:-1], totals)
        return [*derivatives, dr.zeros(type(totals[0]), dr.width(totals[0]))]

    def pack_tangents(self, geometry: list[Any], tangents: list[Any]) -> list[Any]:
        return [*self.of.pack_tangents(geometry[:-1], tangents[:-1]), tangents[-1]]

    def tangent(
        self, geometry: list[Any], footprint: Footprint, d_geometry: list[Any]
    ) -> list[Any]:
        return self.of.tangent(geometry[:-1], footprint, d_geometry[:-1])
