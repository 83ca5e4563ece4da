"""Gaussians that float apart from the rest, found on a grid of voxels as by splat-transform.

The meaning of size, opacity and contribution is that of PlayCanvas' splat-transform 2 (its
``--filter-floaters`` and ``--filter-cluster``). Host code.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from drgs.core.errors import UserError
from drgs.export.merging import shapes_of
from drgs.gaussians.parameters import Gaussians

REACH = 3.0  # standard deviations along a Gaussian's own axes: the box in which it counts

MAX_VISITS, MAX_GIVEN_VISITS = 20_000_000, 200_000_000
"""Pairs of a Gaussian and a voxel that a default size, or a given one, may visit: 4 s, 40 s."""

MAX_BOX = 64  # voxels along a side of a Gaussian's box: it is haze or sky, which fills none

VISITS_AT_ONCE = 1 << 21

KEY_BITS = 20  # of a voxel's number along one axis
MAX_VOXELS = 1 << KEY_BITS  # along one axis

WIDE, MIN_SHARE = 2.0, 0.1
"""A Gaussian whose box has a side of more than WIDE voxels is in a cluster only if it contributes
to this share of the voxels in its box: spikes that merely touch a cluster do not."""


@dataclass(frozen=True)
class VoxelRule:
    """Size of the voxels, least opacity of solid ones, and least contribution to one of them."""

    size: float  # world units; as a default: shares of the scene's extent
    opacity: float  # in (0, 1)
    contribution: float  # >= 0

    def scale_to(self, gaussians: Gaussians[np.ndarray], extent: float) -> VoxelRule:
        """Return a default in world units (as ``extent``), doubled until few enough are visited."""
        size = self.size * extent
        voxels = Voxels(gaussians, size)
        while voxels.num_visits > MAX_VISITS or max(voxels.sides) >= MAX_VOXELS:
            size *= 2
            voxels = Voxels(gaussians, size)
        return replace(self, size=size)


FLOATERS, CLUSTER = VoxelRule(0.02, 0.1, 0.004), VoxelRule(0.4, 0.999, 0.1)
"""Defaults, as splat-transform's, whose sizes of 0.05 and 1 are meant for scenes in metres."""


class Voxels:
    """The boxes of Gaussians on a grid: voxel k spans size * k to size * (k + 1)."""

    def __init__(self, gaussians: Gaussians[np.ndarray], size: float) -> None:
        is_valid, scales, self.rotations = shapes_of(gaussians)
        self.size = size
        self.means = gaussians.means.astype(np.float64)
        self.opacities = np.where(is_valid, gaussians.opacities, 0.0).astype(np.float64)
        self.inverse_scales = 1 / np.maximum(scales, np.finfo(np.float32).tiny)
        self.half_sides = REACH * np.einsum("nij,nj->ni", np.abs(self.rotations), scales)
        self.first = np.floor((self.means - self.half_sides) / size)
        self.counts = np.floor((self.means + self.half_sides) / size) - self.first + 1
        self.is_wide = self.counts.max(axis=1) > MAX_BOX
        self.origin = np.floor(self.means / size).min(axis=0) - MAX_BOX
        self.sides = np.floor(self.means / size).max(axis=0) - self.origin + MAX_BOX

    @property
    def num_visits(self) -> float:
        """Number of pairs of a Gaussian that is not wide and a voxel that its box touches."""
        return float(self.counts[~self.is_wide].prod(axis=1).sum())

    @cached_property
    def centers(self) -> np.ndarray:
        """Keys (N,) of the voxels that contain the means."""
        return _keys(np.floor(self.means / self.size) - self.origin)

    def check(self, option: str) -> None:
        """Raise :class:`UserError`, naming ``option``, for voxels that are too small."""
        visits, most = self.num_visits, max(self.sides)
        if not (visits <= MAX_GIVEN_VISITS and most < MAX_VOXELS):
            raise UserError(
                f"{option}: voxels of {self.size:g} are too small: the Gaussians touch "
                f"{visits:.2g}, {most:.2g} along one axis, and at most {MAX_GIVEN_VISITS:.0e} and "
                f"{MAX_VOXELS:.0e} are possible; give a larger size, or --crop"
            )

    def visit(self, rows: np.ndarray, at_center: bool) -> Iterator[tuple[np.ndarray, ...]]:
        """Yield voxels' keys, Gaussians' indices and contributions o exp(-d^2 / 2), in parts.

        at_center: d, in deviations, is to the voxel's center; else to its point nearest the mean.
        """
        totals = self.counts[rows].prod(axis=1).astype(np.int64)
        part = (np.cumsum(totals) - totals) // VISITS_AT_ONCE
        for chunk in np.split(rows, np.flatnonzero(np.diff(part)) + 1):
            yield from self._visit_part(chunk, at_center)

    def _visit_part(self, rows: np.ndarray, at_center: bool) -> Iterator[tuple[np.ndarray, ...]]:
        counts = self.counts[rows].astype(np.int64)
        totals = counts.prod(axis=1)
        ends = np.cumsum(totals)
        for start in range(0, int(totals.sum()), VISITS_AT_ONCE):
            visit = np.arange(start, min(start + VISITS_AT_ONCE, ends[-1]))
            owner = np.searchsorted(ends, visit, side="right")
            visit -= (ends - totals)[owner]
            x, y, _ = counts[owner].T
            local = np.stack([visit % x, visit // x % y, visit // (x * y)], axis=1)
            row = rows[owner]
            voxel, mean = self.first[row] + local, self.means[row]
            low = voxel * self.size
            point = low + self.size / 2 if at_center else np.clip(mean, low, low + self.size)
            offset = np.einsum("nij,ni->nj", self.rotations[row], point - mean)
            distance = np.square(offset * self.inverse_scales[row]).sum(axis=1)
            yield _keys(voxel - self.origin), row, self.opacities[row] * np.exp(-0.5 * distance)

    def solid(self, opacity: float) -> np.ndarray:
        """Return sorted keys of voxels of at least this opacity, 1 - exp(-sum of contributions)."""
        keys, sums = np.zeros(0, np.int64), np.zeros(0)
        for voxel, _, value in self.visit(np.flatnonzero(~self.is_wide), at_center=False):
            keys, group = np.unique(np.concatenate([keys, voxel]), return_inverse=True)
            sums = np.bincount(group, np.concatenate([sums, value]), len(keys))
        return keys[1 - np.exp(-sums) >= opacity]

    def contributing(
        self, solid: np.ndarray, least: float, needed: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the mask (N,) of Gaussians whose mean is in one of the voxels ``solid``.

        Or that contribute at least ``least`` at the centers of ``needed`` (N,) of them (None: 1).
        """
        contributes = _contains(solid, self.centers)
        hits = np.zeros(len(contributes), np.int64)
        others = np.flatnonzero(~contributes & ~self.is_wide)
        for voxel, row, value in self.visit(others, at_center=True):
            is_hit = value >= least
            is_hit[is_hit] = _contains(solid, voxel[is_hit])
            hits += np.bincount(row[is_hit], minlength=len(hits))
        return contributes | (hits >= (1 if needed is None else needed))


def find_non_floaters(gaussians: Gaussians[np.ndarray], rule: VoxelRule) -> np.ndarray:
    """Return the mask (N,) of Gaussians that contribute to a solid voxel, or are wide."""
    voxels = Voxels(gaussians, rule.size)
    voxels.check("--filter-floaters")
    return voxels.is_wide | voxels.contributing(voxels.solid(rule.opacity), rule.contribution)


def find_cluster(
    gaussians: Gaussians[np.ndarray], rule: VoxelRule, seed: np.ndarray | None = None
) -> np.ndarray:
    """Return the mask (N,) of Gaussians in one cluster of solid voxels that share faces.

    seed: (3,), relative to the Gaussians' origin: the cluster nearest to it; None: that with the
    most means. Where no voxel is solid, none are kept.
    """
    voxels = Voxels(gaussians, rule.size)
    voxels.check("--filter-cluster")
    solid = voxels.solid(rule.opacity)
    if not len(solid):
        return np.zeros(gaussians.num_gaussians, bool)
    ends = []
    for axis in range(3):
        neighbour = np.searchsorted(solid, solid + (1 << axis * KEY_BITS))
        neighbour[neighbour == len(solid)] = 0
        start = np.flatnonzero(solid[neighbour] == solid + (1 << axis * KEY_BITS))
        ends.append((start, neighbour[start]))
    a, b = (np.concatenate(each) for each in zip(*ends, strict=True))
    edges = coo_matrix((np.ones(len(a), bool), (a, b)), (len(solid), len(solid)))
    label = connected_components(edges, directed=False)[1]
    number = np.stack([solid >> axis * KEY_BITS & MAX_VOXELS - 1 for axis in range(3)], axis=1)
    number = number + voxels.origin
    if seed is None:
        nearest = np.minimum(np.searchsorted(solid, voxels.centers), len(solid) - 1)
        is_solid = solid[nearest] == voxels.centers
        chosen = np.argmax(np.bincount(label[nearest[is_solid]], minlength=1))
    else:
        centers = (number + 0.5) * rule.size
        chosen = label[np.argmin(np.square(centers - seed).sum(axis=1))]
    sides = 2 * voxels.half_sides / rule.size
    share = np.ceil(MIN_SHARE * sides.prod(axis=1))
    needed = np.where(sides.max(axis=1) > WIDE, np.maximum(share, 1), 1)
    return voxels.contributing(solid[label == chosen], rule.contribution, needed)


def _keys(numbers: np.ndarray) -> np.ndarray:
    """Return one integer for each voxel (M, 3); x varies fastest."""
    x, y, z = numbers.astype(np.int64).T
    return x + (y << KEY_BITS) + (z << 2 * KEY_BITS)


def _contains(keys: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return whether each of ``wanted`` is among the sorted ``keys``."""
    if not len(keys):
        return np.zeros(len(wanted), bool)
    return keys[np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)] == wanted
