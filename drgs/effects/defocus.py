"""Depth of field of a thin lens: splats out of focus are blurred.

A point is spread over a disc, whose variance is added to the splat's covariance on the film; the
opacity falls such that its integral stays, and the alpha at which it ends with it: many small
splats far out of focus are as opaque as in focus. Partial occlusion at blurred edges needs rays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
from typing_extensions import override

from drgs.cameras.camera import Camera
from drgs.core.constants import NEGLIGIBLE_ALPHA
from drgs.core.types import Array2f, Array3f, Bool, Float
from drgs.splatting.footprint import (
    Cutoffs,
    GaussianFalloff,
    MicroTileFootprint,
    Offsets,
    SamplePositions,
)
from drgs.splatting.grid import Lanes
from drgs.splatting.projection import FilmProjection, FilmShape, GaussianRows, Splats2D


@dataclass(frozen=True)
class Defocused:
    """A projection, blurred by the camera's aperture."""

    shape: FilmProjection

    def __call__(
        self, rows: GaussianRows, camera: Camera, position: Array3f, low_pass: Float | float
    ) -> FilmShape:
        """Return the blurred shape, whose ``opacity_compensation`` keeps the integral."""
        film = self.shape(rows, camera, position, low_pass)
        assert camera.aperture is not None, "see with_effects"
        spread = camera.aperture.variance(camera, position.z)
        blurred = self.shape(rows, camera, position, low_pass + spread)
        return replace(
            blurred,
            determinant=film.determinant,
            added_determinant=film.added_determinant,
            opacity_compensation=blurred.root_determinant() / film.root_determinant(),
        )


@dataclass(frozen=True)
class DimmedFalloff(GaussianFalloff):
    """Falloff with the extent of the undimmed splat; last geometry: log2 of the dimming factor."""

    falloff: GaussianFalloff

    @property
    @override
    def follows_rays(self) -> bool:
        return self.falloff.follows_rays

    @property
    @override
    def num_geometry(self) -> int:
        return self.falloff.num_geometry + 1

    @property
    @override
    def num_moments(self) -> int:
        return self.falloff.num_moments

    @override
    def for_camera(self, camera: Camera) -> DimmedFalloff:
        return replace(self, falloff=self.falloff.for_camera(camera))

    @override
    def bind(self, lanes: Lanes, positions: SamplePositions) -> DimmedFalloff:
        return replace(self, falloff=self.falloff.bind(lanes, positions))

    @override
    def with_camera_tangents(self, camera_tangents: Sequence[Float]) -> DimmedFalloff:
        return replace(self, falloff=self.falloff.with_camera_tangents(camera_tangents))

    @override
    def log2_opacity(self, geometry: list[Float]) -> Float:
        return self.falloff.log2_opacity(geometry[:-1])

    @override
    def log2_floor(self, geometry: list[Float], cutoffs: Cutoffs) -> Float:
        log2_dimming = geometry[-1]
        floor = cutoffs.log2_floor(self.log2_opacity(geometry) - log2_dimming) + log2_dimming
        least = math.log2(NEGLIGIBLE_ALPHA)
        return dr.select(floor > least, floor, least)

    @override
    def geometry(self, splats: Splats2D) -> list[Float]:
        assert splats.opacity_compensation is not None, "see Defocused"
        return [*self.falloff.geometry(splats), dr.log2(splats.opacity_compensation)]

    @override
    def differentiable(self, splats: Splats2D) -> list[Float]:
        assert splats.opacity_compensation is not None, "see Defocused"
        return [*self.falloff.differentiable(splats), dr.detach(splats.opacity_compensation)]

    @override
    def bounds(
        self, splats: Splats2D, geometry: list[Float], reach: Float
    ) -> tuple[Array2f, Array2f]:
        return self.falloff.bounds(splats, geometry[:-1], reach)

    @override
    def outline(self, geometry: list[Float], reach: Float) -> list[Float]:
        return self.falloff.outline(geometry[:-1], reach)

    @override
    def coordinates(self, geometry: list[Float], x: Float, y: Float) -> tuple[Float, Float]:
        return self.falloff.coordinates(geometry[:-1], x, y)

    @override
    def footprint(
        self, geometry: list[Float], offsets_from: Offsets, active: Bool | bool
    ) -> MicroTileFootprint:
        return self.falloff.footprint(geometry[:-1], offsets_from, active)

    @override
    def moments(
        self, footprint: MicroTileFootprint, weights: list[Float], positions: SamplePositions
    ) -> list[Float]:
        return self.falloff.moments(footprint, weights, positions)

    @override
    def derivatives(self, geometry: list[Float], totals: list[Float]) -> list[Float]:
        derivatives = self.falloff.derivatives(geometry[:-1], totals)
        return [*derivatives, dr.zeros(type(totals[0]), dr.width(totals[0]))]

    @override
    def pack_tangents(self, geometry: list[Float], tangents: list[Float]) -> list[Float]:
        return [*self.falloff.pack_tangents(geometry[:-1], tangents[:-1]), tangents[-1]]

    @override
    def tangent(
        self, geometry: list[Float], footprint: MicroTileFootprint, d_geometry: list[Float]
    ) -> list[Float]:
        return self.falloff.tangent(geometry[:-1], footprint, d_geometry[:-1])
