"""Many features, composited a few at a time: kernels that compile soon, whatever their number.

LLVM takes more than linear time for a kernel, and a feature adds a number for each of a lane's 16
pixels to it: 64 features of float64 in one kernel took four minutes with AVX2, and take 6 s in
groups, whose kernels are compiled once. Each group walks the splats again, so that its
transmittance, its decisions and its weights are those of all others.

The adjoint is linear in the derivatives of the planes: the groups' derivatives of the geometry are
added up, with that of the transmittance in the first group alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from drgs.splatting.image_model import SplatFeatures
from drgs.splatting.rasterize import Layers, Records, SplatGradients
from drgs.splatting.tiles import TileBins

FEATURES_AT_ONCE = {4: 32, 8: 8}
"""By the bytes of a number, the most features of a group. With AVX2, kernels of so many compile in
7 s and 3 s, forward and backward; those of twice as many in 25 s and 12 s."""


def in_groups(order: Any, bins: TileBins) -> Any:
    """``order``, or one that composites in groups where there are many features.

    Each is a :class:`drgs.splatting.rendering.Order`.

    Not where a pixel's features depend on all that is stored of a splat.
    """
    is_many = bins.num_features > FEATURES_AT_ONCE[dr.itemsize_v(bins.rows.Float)]
    return FeatureGroups(order) if is_many and type(bins.model.features) is SplatFeatures else order


@dataclass(frozen=True)
class GroupedLayers:
    """What compositing makes of each group."""

    parts: tuple[Layers, ...]

    @property
    def count(self) -> int:
        """Planes besides the transmittance."""
        return sum(part.count for part in self.parts)

    def planes(self) -> list[Any]:
        """See :meth:`drgs.splatting.rasterize.Layers.planes`."""
        first, *others = (part.planes() for part in self.parts)
        return first + [plane for planes in others for plane in planes[1:]]


@dataclass(frozen=True)
class FeatureGroups:
    """Composites in another order, group by group."""

    order: Any  # drgs.splatting.rendering.Order: of each group

    def records(self, bins: TileBins) -> tuple[Records, ...]:
        """Those of each group."""
        geometry, num_features = bins.model.response.num_geometry, bins.num_features

        def numbers(group: slice, rank: Any, active: Any) -> list[Any]:
            row = bins.rows.load(rank, active)
            features, keys = row[geometry:][:num_features], row[geometry + num_features :]
            return row[:geometry] + features[group] + keys

        return tuple(
            Records.of(own, lambda rank, active, group=group: numbers(group, rank, active))
            for group, own in _groups(bins)
        )

    def composite(self, bins: TileBins, records: Sequence[Records]) -> GroupedLayers:
        """See :func:`drgs.splatting.rasterize.composite`."""
        groups = zip(_groups(bins), records, strict=True)
        return GroupedLayers(tuple(self.order.composite(own, rows) for (_, own), rows in groups))

    def adjoint(
        self,
        bins: TileBins,
        records: Sequence[Records],
        layers: GroupedLayers,
        d_features: list[Any],
        d_transmittance: Any,
    ) -> SplatGradients:
        """See :func:`drgs.splatting.rasterize.composite_adjoint`."""
        dr.eval(d_features, d_transmittance)  # or each group would have kernels of its own
        geometry, features = None, []
        groups = zip(_groups(bins), records, layers.parts, strict=True)
        for (group, own), rows, part in groups:
            found = self.order.adjoint(own, rows, part, d_features[group], d_transmittance)
            total = zip(geometry or [0] * len(found.geometry), found.geometry, strict=True)
            geometry = [a + b for a, b in total]
            features += found.features
            dr.eval(geometry, features)
            d_transmittance = dr.opaque(type(d_transmittance), 0, dr.width(d_transmittance))
        return SplatGradients(geometry, features)

    def tangent(
        self,
        bins: TileBins,
        records: Sequence[Records],
        layers: GroupedLayers,
        tangents: SplatGradients,
    ) -> GroupedLayers:
        """See :func:`drgs.splatting.rasterize.composite_tangent`."""
        groups = zip(_groups(bins), records, layers.parts, strict=True)
        return GroupedLayers(
            tuple(
                self.order.tangent(
                    own, rows, part, replace(tangents, features=tangents.features[group])
                )
                for (group, own), rows, part in groups
            )
        )


def _groups(bins: TileBins) -> Iterator[tuple[slice, TileBins]]:
    """Which features are in each group, and the bins as if there were no others."""
    size = FEATURES_AT_ONCE[dr.itemsize_v(bins.rows.Float)]
    for start in range(0, bins.num_features, size):
        end = min(start + size, bins.num_features)
        yield slice(start, end), replace(bins, num_features=end - start)
