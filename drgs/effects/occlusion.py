"""Surfaces between the splats: the occluded part of each splat, at each pixel.

At a pixel, a surface k at depth z_k that stops the part p_k of the light behind it lies between
splats like one more splat. With w_i = T_i a_i the weights of the splats without it (see
``drgs.splatting.rasterize``),

    C = sum_i s_i w_i c_i,   s_i = 1 - sum of p_k over the surfaces in front (z_k < z_i),

and each surface's own share is p_k times T_k, the transmittance in front of it:

    T_k = 1 - sum_{i: z_i <= z_k} w_i.

So surfaces change no alpha and no transmittance: they scale features, and one more plane for each
sums the weights in front. Which splats are in front is decided by the depths that order them: those
of their means, or of their peaks at each pixel. Not differentiated: z, p, and that decision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import drjit as dr
from typing_extensions import override

from drgs.cameras.camera import Camera
from drgs.core.types import Float
from drgs.splatting.footprint import FeatureGroup, ImageModel, SamplePositions, SplatFeatures
from drgs.splatting.grid import PIXELS, Lanes, TileGrid, load_pixels


@dataclass(frozen=True, eq=False)
class Surface:
    """A surface at each pixel: the nearest, or the next one visible through it."""

    depth: Float  # (H * W,) scene units, as the splats' depth; without a surface, the largest
    coverage: Float  # (H * W,) in [0, 1]: p, the part of all light that it stops


@dataclass(frozen=True)
class OccludedFeatures(SplatFeatures):
    """Features of splats that surfaces may hide; last planes: the weights in front of each."""

    features: SplatFeatures
    surfaces: tuple[Surface, ...]  # nearest first
    grid: TileGrid
    bound: list[tuple] = field(default_factory=list)  # at the 16 pixels of a lane: (z, rest behind)

    @override
    def groups(self, num_stored: int, size: int) -> list[FeatureGroup]:
        depth, end = num_stored - 1, self.num_planes(num_stored)
        fronts = range(end - len(self.surfaces), end)
        return [
            FeatureGroup(
                [*g.stored, depth], [*g.planes, *fronts], replace(self, features=g.features)
            )
            for g in self.features.groups(num_stored - 1, size)
        ]

    @override
    def num_planes(self, num_stored: int) -> int:
        return self.features.num_planes(num_stored - 1) + len(self.surfaces)

    @override
    def for_camera(self, camera: Camera) -> OccludedFeatures:
        return replace(self, features=self.features.for_camera(camera))

    @override
    def check_differentiable_in_camera(self) -> None:
        self.features.check_differentiable_in_camera()

    @override
    def bind(self, lanes: Lanes, positions: SamplePositions) -> OccludedFeatures:
        rests, bound = [1.0] * PIXELS, []
        for surface in self.surfaces:
            depths = load_pixels(surface.depth, lanes, self.grid)
            coverage = load_pixels(surface.coverage, lanes, self.grid)
            rests = [rest - c for rest, c in zip(rests, coverage, strict=True)]
            bound.append(list(zip(depths, rests, strict=True)))
        features = self.features.bind(lanes, positions)
        return replace(self, features=features, bound=list(zip(*bound, strict=True)))

    @override
    def at_depth(self, stored: list[Float], depth: Float) -> list[Float]:
        return [*stored[:-1], depth]

    @override
    def pixel_values(self, stored: list[Float], pixel: int) -> list[Float]:
        *others, depth = stored
        seen = self._transmitted_share(depth, pixel)
        values = [seen * value for value in self.features.pixel_values(others, pixel)]
        return values + self._in_front(type(depth)(1), depth, pixel)

    @override
    def add(
        self, planes: list[Float], stored: list[Float], pixel: int, weight: Float
    ) -> list[Float]:
        *others, depth = stored
        own, fronts = self._split(planes)
        seen = self.features.add(own, others, pixel, self._transmitted_share(depth, pixel) * weight)
        pairs = zip(fronts, self._in_front(weight, depth, pixel), strict=True)
        return [*seen, *(front + more for front, more in pairs)]

    @override
    def feature_gradient(self, stored: list[Float], pixel: int, g: list[Float]) -> Float:
        *others, depth = stored
        own, fronts = self._split(g)
        seen = self._transmitted_share(depth, pixel)
        gradient = seen * self.features.feature_gradient(others, pixel, own)
        return gradient + sum(
            dr.select(depth <= z, d_front, 0)
            for (z, _), d_front in zip(self.bound[pixel], fronts, strict=True)
        )

    @override
    def add_derivatives(
        self, totals: list[Float], stored: list[Float], pixel: int, weight: Float, g: list[Float]
    ) -> list[Float]:
        *others, depth = stored
        *totals, nothing = totals
        weight = self._transmitted_share(depth, pixel) * weight
        sums = self.features.add_derivatives(totals, others, pixel, weight, self._split(g)[0])
        return [*sums, nothing]

    @override
    def tangents(self, stored: list[Float], d_stored: list[Float], pixel: int) -> list[Float]:
        *others, depth = stored
        seen = self._transmitted_share(depth, pixel)
        tangents = self.features.tangents(others, d_stored[:-1], pixel)
        return [seen * value for value in tangents] + [type(depth)(0)] * len(self.surfaces)

    def _split(self, planes: list[Float]) -> tuple[list[Float], list[Float]]:
        count = len(self.surfaces)
        return planes[:-count], planes[-count:]

    def _transmitted_share(self, depth: Float, pixel: int) -> Float:
        """Return s, the part of a splat that surfaces in front of it let through."""
        Float = type(depth)
        farther_first = reversed(self.bound[pixel])
        nearer_rests = [*reversed([rest for _, rest in self.bound[pixel][:-1]]), Float(1)]
        seen = self.bound[pixel][-1][1]
        for (z, _), rest in zip(farther_first, nearer_rests, strict=True):
            seen = dr.select(depth <= z, rest, seen)
        return seen

    def _in_front(self, value: Float, depth: Float, pixel: int) -> list[Float]:
        return [dr.select(depth <= z, value, 0) for z, _ in self.bound[pixel]]


def occlude(model: ImageModel, surfaces: Sequence[Surface], camera: Camera) -> ImageModel:
    """Return an image model of splats that the surfaces may hide; nearest surface first."""
    grid = TileGrid(camera.width, camera.height)
    return replace(model, features=OccludedFeatures(model.features, tuple(surfaces), grid))
