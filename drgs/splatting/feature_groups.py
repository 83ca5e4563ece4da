"""Compositing of many features in groups, which bounds the compilation time of kernels.

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

from drgs.core.types import Bool, Float, UInt32
from drgs.splatting.footprint import FeatureGroup
from drgs.splatting.rasterize import ONE_SAMPLE, Layers, Records, SplatGradients
from drgs.splatting.tiles import TileBins

FEATURES_AT_ONCE = {4: 32, 8: 8}
"""Maximum number of features of a group, by bytes per number. With AVX2, such kernels compile in
7 s and 3 s, forward and backward; kernels of twice the size in 25 s and 12 s."""


def group_features(order: Any, bins: TileBins) -> Any:
    """Return ``order``, or one that composites in groups if there are many features.

    Each is a :class:`drgs.splatting.rendering.CenterOrder`.
    """
    return InGroups(order) if len(_groups(bins)) > 1 else order


@dataclass(frozen=True)
class GroupedLayers:
    """Layers of each group."""

    groups: tuple[FeatureGroup, ...]
    parts: tuple[Layers, ...]  # of each of them
    count: int  # planes besides the transmittance

    def planes(self) -> list[Float]:
        """See :meth:`drgs.splatting.rasterize.Layers.planes`."""
        planes: dict[int, Float] = {}
        for group, part in zip(self.groups, self.parts, strict=True):
            places = [0, *(1 + place for place in group.planes)]
            planes |= zip(places, part.planes(), strict=True)
        return [planes[place] for place in range(1 + self.count)]


@dataclass(frozen=True)
class InGroups:
    """Composite group by group, in the order of another object."""

    order: Any  # drgs.splatting.rendering.CenterOrder: of each group

    def records(self, bins: TileBins) -> tuple[Records, ...]:
        """Records of each group."""
        geometry, end = bins.model.falloff.num_geometry, bins.num_features

        def numbers(group: FeatureGroup, rank: UInt32, active: Bool) -> list[Float]:
            row = bins.rows.load(rank, active)
            features, keys = row[geometry:], row[geometry + end :]
            return row[:geometry] + [features[place] for place in group.stored] + keys

        return tuple(
            Records.from_ranks(_select_group(group, bins), partial(numbers, group))
            for group in _groups(bins)
        )

    def composite(self, bins: TileBins, records: Sequence[Records]) -> GroupedLayers:
        """See :func:`drgs.splatting.rasterize.composite`."""
        groups, count = _groups(bins), bins.model.features.num_planes(bins.num_features)
        parts = [
            self.order.composite(_select_group(group, bins), own)
            for group, own in zip(groups, records, strict=True)
        ]
        return GroupedLayers(groups, tuple(parts), count)

    def adjoint(
        self,
        bins: TileBins,
        records: Sequence[Records],
        layers: GroupedLayers,
        d_features: list[Float],
        d_transmittance: Float,
        samples: range = ONE_SAMPLE,
        before: SplatGradients | None = None,
    ) -> SplatGradients:
        """See :func:`drgs.splatting.rasterize.composite_adjoint`. One sample is added at a time."""
        for sample in samples:
            sample = range(sample, sample + 1)
            found = self._adjoint(bins, records, layers, d_features, d_transmittance, sample)
            before = found if before is None else before.plus(found)
            dr.eval(before)
        assert before is not None, "there is at least one sample"
        return before

    def _adjoint(
        self,
        bins: TileBins,
        records: Sequence[Records],
        layers: GroupedLayers,
        d_features: list[Float],
        d_transmittance: Float,
        samples: range,
    ) -> SplatGradients:
        """Add the groups' derivatives of one sample."""
        cotangents = [d_transmittance, *d_features]
        dr.eval(cotangents)  # so that all groups share kernels
        zeros = dr.opaque(type(d_transmittance), 0, dr.width(d_transmittance))
        zero, falloff = bins.rows.Float(0), bins.model.falloff
        geometry, features = [zero] * falloff.num_geometry, [zero] * bins.num_features
        for group, own, part in zip(_groups(bins), records, layers.parts, strict=True):
            places = [0, *(1 + place for place in group.planes)]
            d_own, *d_planes = [cotangents[place] for place in places]
            for place in places:  # planes of several groups count once
                cotangents[place] = zeros
            found = self.order.adjoint(
                _select_group(group, bins), own, part, d_planes, d_own, samples
            )
            geometry = [a + b for a, b in zip(geometry, found.geometry, strict=True)]
            for place, derivative in zip(group.stored, found.features, strict=True):
                features[place] = features[place] + derivative
            dr.eval(geometry, features)
        return SplatGradients(geometry, features)

    def tangent(
        self,
        bins: TileBins,
        records: Sequence[Records],
        layers: GroupedLayers,
        tangents: SplatGradients,
    ) -> GroupedLayers:
        """See :func:`drgs.splatting.rasterize.composite_tangent`."""
        parts = []
        for group, own, part in zip(_groups(bins), records, layers.parts, strict=True):
            direction = replace(tangents, features=[tangents.features[k] for k in group.stored])
            parts.append(self.order.tangent(_select_group(group, bins), own, part, direction))
        return replace(layers, parts=tuple(parts))


def _groups(bins: TileBins) -> tuple[FeatureGroup, ...]:
    size = FEATURES_AT_ONCE[dr.itemsize_v(bins.rows.Float)]
    return tuple(bins.model.features.groups(bins.num_features, size))


def _select_group(group: FeatureGroup, bins: TileBins) -> TileBins:
    """Return the bins with the features of one group."""
    model = replace(bins.model, features=group.features)
    return replace(bins, num_features=len(group.stored), model=model)
