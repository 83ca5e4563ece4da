"""The order in which splats are composited, and compositing of many features in groups.

LLVM compiles large kernels in more than linear time, and each feature adds 16 numbers to a lane's
state: with AVX2, 64 features of float64 take four minutes to compile in one kernel, and 6 s in
groups, which share a kernel. Each group composites all splats again, with the same transmittance,
decisions and weights.

The adjoint is linear in the derivatives of the planes: the groups' derivatives of the geometry are
added. Planes that several groups share, such as transmittance, are differentiated in the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
from typing_extensions import override

from drgs.cameras.camera import Camera
from drgs.config.approximations import ORDERS, Approximations
from drgs.core.types import Bool, Float, UInt32
from drgs.splatting.footprint import FeatureGroup
from drgs.splatting.projection import FilmProjection, ProjectionModel, Splats2D
from drgs.splatting.rasterize import (
    ONE_SAMPLE,
    CompositedTiles,
    Records,
    SplatGradients,
    composite,
    composite_adjoint,
    composite_tangent,
)
from drgs.splatting.tiles import TileBins


@ORDERS.register("center")
@dataclass(frozen=True)
class CenterOrder:
    """The order of compositing, by the depth of the means; the base of all orders."""

    @classmethod
    def create(
        cls, projection: type[ProjectionModel], approximations: Approximations
    ) -> tuple[FilmProjection, CenterOrder]:
        """Return the projection, extended by the inputs of the order, and the order."""
        del approximations
        return projection.shape, cls()

    def for_camera(self, camera: Camera) -> CenterOrder:
        """Return this order for one camera; here, it is independent of the camera."""
        del camera
        return self

    def keys(self, splats: Splats2D) -> list[Float]:
        """Return further columns for compositing, if the order needs any."""
        del splats
        return []

    def sort_depths(self, splats: Splats2D) -> Float:
        """Return the sort keys of the splats, Float (N,), in ascending order."""
        return splats.depths

    def records(self, bins: TileBins) -> Any:
        """Return the rows that compositing loads, one per sorted entry, evaluated."""
        return Records.from_splats(bins, bins.rows.load)

    def composite(self, bins: TileBins, records: Any) -> CompositedTiles:
        """Composite front to back."""
        return composite(bins, records)

    def adjoint(
        self,
        tiles: CompositedTiles,
        d_planes: Sequence[Float],
        samples: range = ONE_SAMPLE,
        before: SplatGradients | None = None,
    ) -> SplatGradients:
        """See :func:`drgs.splatting.rasterize.composite_adjoint`."""
        return composite_adjoint(tiles, d_planes, samples, before)

    def tangent(self, tiles: CompositedTiles, tangents: SplatGradients) -> list[Float]:
        """See :func:`drgs.splatting.rasterize.composite_tangent`."""
        return composite_tangent(tiles, tangents)


FEATURES_AT_ONCE = {4: 32, 8: 8}
"""Maximum number of features of a group, by bytes per number. With AVX2, such kernels compile in
7 s and 3 s, forward and backward; kernels of twice the size in 25 s and 12 s."""


def group_features(order: CenterOrder, bins: TileBins) -> CenterOrder:
    """Return ``order``, or one that composites in groups if there are many features."""
    return InGroups(order) if len(_groups(bins)) > 1 else order


@dataclass(frozen=True)
class CompositedGroups(CompositedTiles):
    """The tiles of each group; ``values`` are those of the first, ``ends`` and ``stop`` of all."""

    parts: tuple[CompositedTiles, ...]

    @override
    def planes(self) -> list[Float]:
        return _join_planes(self, [part.planes() for part in self.parts])


@dataclass(frozen=True)
class InGroups(CenterOrder):
    """Composite group by group, in the order of another object."""

    order: CenterOrder  # of each group

    @override
    def records(self, bins: TileBins) -> tuple[Records, ...]:
        """Return the records of each group."""
        geometry, end = bins.model.falloff.num_geometry, bins.num_features

        def numbers(group: FeatureGroup, splat: UInt32, active: Bool) -> list[Float]:
            row = bins.rows.load(splat, active)
            features, keys = row[geometry:], row[geometry + end :]
            return row[:geometry] + [features[place] for place in group.stored] + keys

        return tuple(
            Records.from_splats(_select_group(group, bins), partial(numbers, group))
            for group in _groups(bins)
        )

    @override
    def composite(self, bins: TileBins, records: Sequence[Records]) -> CompositedGroups:
        pairs = zip(_groups(bins), records, strict=True)
        parts = tuple(self.order.composite(_select_group(g, bins), each) for g, each in pairs)
        first, count = parts[0], bins.model.features.num_planes(bins.num_features)
        return CompositedGroups(bins, records, first.values, first.ends, first.stop, count, parts)

    @override
    def adjoint(
        self,
        tiles: CompositedTiles,
        d_planes: Sequence[Float],
        samples: range = ONE_SAMPLE,
        before: SplatGradients | None = None,
    ) -> SplatGradients:
        """See :func:`drgs.splatting.rasterize.composite_adjoint`. One sample is added at a time."""
        dr.eval(d_planes)  # so that all groups share kernels
        zeros = dr.opaque(type(d_planes[0]), 0, dr.width(d_planes[0]))
        zero, num_geometry = tiles.bins.rows.Float(0), tiles.bins.model.falloff.num_geometry
        for sample in samples:
            cotangents = list(d_planes)
            geometry, features = [zero] * num_geometry, [zero] * tiles.bins.num_features
            for group, part in _parts(tiles):
                d_part = [cotangents[place] for place in group.places]
                for place in group.places:  # planes of several groups count once
                    cotangents[place] = zeros
                gradients = self.order.adjoint(part, d_part, range(sample, sample + 1))
                geometry = [a + b for a, b in zip(geometry, gradients.geometry, strict=True)]
                for place, derivative in zip(group.stored, gradients.features, strict=True):
                    features[place] = features[place] + derivative
                dr.eval(geometry, features)
            total = SplatGradients(geometry, features)
            before = total if before is None else before.plus(total)
            dr.eval(before)
        assert before is not None, "there is at least one sample"
        return before

    @override
    def tangent(self, tiles: CompositedTiles, tangents: SplatGradients) -> list[Float]:
        planes = []
        for group, part in _parts(tiles):
            direction = replace(tangents, features=[tangents.features[k] for k in group.stored])
            planes.append(self.order.tangent(part, direction))
        return _join_planes(tiles, planes)


def _groups(bins: TileBins) -> tuple[FeatureGroup, ...]:
    size = FEATURES_AT_ONCE[dr.itemsize_v(bins.rows.Float)]
    return tuple(bins.model.features.groups(bins.num_features, size))


def _join_planes(tiles: CompositedTiles, parts: Sequence[list[Float]]) -> list[Float]:
    """Return the planes of all groups, from those of each."""
    planes: dict[int, Float] = {}
    for group, part in zip(_groups(tiles.bins), parts, strict=True):
        planes |= zip(group.places, part, strict=True)
    return [planes[place] for place in range(1 + tiles.count)]


def _select_group(group: FeatureGroup, bins: TileBins) -> TileBins:
    model = replace(bins.model, features=group.features)
    return replace(bins, num_features=len(group.stored), model=model)


def _parts(tiles: CompositedTiles) -> list[tuple[FeatureGroup, CompositedTiles]]:
    """Return each group with its tiles, for the model that the tiles have now."""
    assert isinstance(tiles, CompositedGroups), "made by InGroups.composite"
    pairs = zip(_groups(tiles.bins), tiles.parts, strict=True)
    return [(g, replace(part, bins=_select_group(g, tiles.bins))) for g, part in pairs]
