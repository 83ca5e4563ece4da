"""Surfaces between the splats: what they hide of each splat, at each pixel.

Imported when a scene has surfaces. At a pixel, a surface at depth z that covers the part c of it
lies between splats like one more splat, of alpha c. With w_i = T_i a_i the weights of the splats as
they are without it (see ``drgs.splatting.rasterize``),

    C = sum_i s_i w_i c_i,   s_i = 1 in front (z_i <= z), 1 - c behind,

and the surface's own share is c times T_s, the transmittance in front of it:

    T_s = 1 - sum_{i in front} w_i.

So a surface changes no alpha and no transmittance: it scales features, and one more plane sums the
weights in front. Adjoint and tangent follow from the features', and nothing else has to know.

Which splats are in front is decided by the depths of their means, as their order is. Not
differentiated: z, c, and that decision.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr

from drgs.cameras.camera import Camera
from drgs.splatting.grid import Lanes, TileGrid
from drgs.splatting.image_model import FeatureGroup, Features, ImageModel, Positions
from drgs.splatting.lanes import load_pixels


@dataclass(frozen=True, eq=False)
class Surface:
    """The nearest surface at each pixel."""

    depth: Any  # Float (H * W,): as that of the splats, scene units; anything where nothing is
    coverage: Any  # Float (H * W,) in [0, 1]


@dataclass(frozen=True)
class OccludedFeatures:
    """Features of splats that a surface may hide.

    Of what is stored, the last is the splat's depth; of the planes, the last is the sum of the
    weights in front of the surface.
    """

    features: Features
    surface: Surface
    grid: TileGrid
    bound: list[tuple[Any, Any]] = field(default_factory=list)  # the 16 of each lane: z, 1 - c

    def groups(self, num_stored: int, size: int) -> list[FeatureGroup]:
        """Divide as without a surface; each group has the depth, and the weights in front."""
        depth, front = num_stored - 1, self.num_planes(num_stored) - 1
        return [
            FeatureGroup(
                stored=[*group.stored, depth],
                planes=[*group.planes, front],
                features=replace(self, features=group.features),
            )
            for group in self.features.groups(num_stored - 1, size)
        ]

    def num_planes(self, num_stored: int) -> int:
        """Planes that come of ``num_stored`` numbers per splat."""
        return self.features.num_planes(num_stored - 1) + 1

    def seen_by(self, camera: Camera) -> OccludedFeatures:
        """For one camera."""
        return replace(self, features=self.features.seen_by(camera))

    def check_differentiable_in_camera(self) -> None:
        """As the features; the surface stays where it is."""
        self.features.check_differentiable_in_camera()

    def bind(self, lanes: Lanes, positions: Positions) -> OccludedFeatures:
        """For the lanes of one kernel: loads the surface."""
        depths = load_pixels(self.surface.depth, lanes, self.grid)
        coverage = load_pixels(self.surface.coverage, lanes, self.grid)
        return replace(
            self,
            features=self.features.bind(lanes, positions),
            bound=[(z, 1 - c) for z, c in zip(depths, coverage, strict=True)],
        )

    def at(self, stored: list[Any], pixel: int) -> list[Any]:
        """The splat's features at a pixel, as far as they are seen; 1 in front, 0 behind."""
        *others, depth = stored
        values = self.features.at(others, pixel)
        front = self._in_front(type(depth)(1), depth, pixel)
        return [self._seen(value, depth, pixel) for value in values] + [front]

    def add(self, planes: list[Any], stored: list[Any], pixel: int, weight: Any) -> list[Any]:
        """As :meth:`at` says; it is the weight that is scaled, once for all features."""
        *others, depth = stored
        *planes, front = planes
        seen = self.features.add(planes, others, pixel, self._seen(weight, depth, pixel))
        return [*seen, front + self._in_front(weight, depth, pixel)]

    def feature_gradient(self, stored: list[Any], pixel: int, g: list[Any]) -> Any:
        """As :meth:`at` says; it is the sum that is scaled."""
        *others, depth = stored
        gradient = self._seen(self.features.feature_gradient(others, pixel, g[:-1]), depth, pixel)
        return gradient + self._in_front(g[-1], depth, pixel)

    def add_derivatives(
        self, totals: list[Any], stored: list[Any], pixel: int, weight: Any, g: list[Any]
    ) -> list[Any]:
        """As :meth:`at` says; the depth has none."""
        *others, depth = stored
        *totals, nothing = totals
        weight = self._seen(weight, depth, pixel)
        sums = self.features.add_derivatives(totals, others, pixel, weight, g[:-1])
        return [*sums, nothing]

    def tangents(self, stored: list[Any], d_stored: list[Any], pixel: int) -> list[Any]:
        """Tangents of the features at a pixel."""
        *others, depth = stored
        tangents = self.features.tangents(others, d_stored[:-1], pixel)
        return [self._seen(value, depth, pixel) for value in tangents] + [type(depth)(0)]

    def _seen(self, value: Any, depth: Any, pixel: int) -> Any:
        """What is left of a splat's number: all of it in front, 1 - c behind."""
        z, passes = self.bound[pixel]
        return dr.select(depth <= z, value, passes * value)

    def _in_front(self, value: Any, depth: Any, pixel: int) -> Any:
        """A splat's number in front, 0 behind."""
        z, _ = self.bound[pixel]
        return dr.select(depth <= z, value, 0)


def occluded_by(model: ImageModel, surface: Surface, camera: Camera) -> ImageModel:
    """An image model of splats some of which the surface hides."""
    grid = TileGrid(camera.width, camera.height)
    return replace(model, features=OccludedFeatures(model.features, surface, grid))
