"""Fewer Gaussians, by merging pairs of neighbours that are alike. Host code.

As in NanoGS and splat-transform 2, each round merges disjoint pairs of least cost among nearest
neighbours. The cost is in closed form here instead of by sampling.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from drgs.gaussians.parameters import Gaussians

NUM_NEIGHBOURS = 12
PAIRS_AT_ONCE = 1 << 18
SURFACE_POWER = 1.6075  # Thomsen's approximation of an ellipsoid's surface: error below 1.1 %
FLOOR = 1e-4  # standard deviation that shapes have besides, of the median distance to the middle
OPACITY_LIMITS = 1e-4, 0.9999


def merge_down(gaussians: Gaussians[np.ndarray], count: int) -> Gaussians[np.ndarray]:
    """Return at most ``count`` Gaussians: the others are merged, and those not finite left out.

    A pair of the masses m = opacity * surface becomes one Gaussian of their mean, covariance and
    coefficients, weighted by mass, and of their common mass if its opacity can be below 1.
    The cost of a pair is the increase of entropy, sum_k p_k log(|C| / |C_k|) / 2 with p_k the
    shares of the mass, plus the squared difference of the coefficients.
    """
    is_valid, scales, rotations = shapes_of(gaussians)
    if np.count_nonzero(is_valid) <= count and is_valid.all():
        return gaussians
    means = gaussians.means[is_valid].astype(np.float64)
    scales, rotations = scales[is_valid], rotations[is_valid]
    covariances = np.einsum("nij,nj,nkj->nik", rotations, np.square(scales), rotations)
    masses = gaussians.opacities[is_valid].astype(np.float64) * _surface(scales)
    sh, rows = gaussians.sh[is_valid], np.flatnonzero(is_valid)  # rows: of those not merged
    spread = np.median(np.linalg.norm(means - np.median(means, axis=0), axis=1))
    floor = (FLOOR * spread) ** 2 * np.eye(3)
    while (surplus := len(means) - count) > 0:
        a, b = _neighbours(means)
        share = masses[a] / np.maximum(masses[a] + masses[b], np.finfo(np.float64).tiny)
        offset = means[a] - means[b]
        between = np.einsum("n,ni,nj->nij", share * (1 - share), offset, offset)
        merged = _mix(covariances, a, b, share) + between
        volumes = np.linalg.slogdet(covariances + floor)[1]
        cost = np.linalg.slogdet(merged + floor)[1] - _mix(volumes, a, b, share)
        cost = 0.5 * cost + _squared_differences(sh, a, b)
        pairs = _disjoint_pairs(a, b, cost, len(means))[:surplus]
        a, b, share, merged = a[pairs], b[pairs], share[pairs], merged[pairs]
        rest = np.ones(len(means), bool)
        rest[a] = rest[b] = False
        surfaces = _surface(np.sqrt(np.maximum(np.linalg.eigvalsh(merged), 0)))
        joint = np.minimum(masses[a] + masses[b], OPACITY_LIMITS[1] * surfaces)
        rows = rows[rest[: len(rows)]]
        means = np.concatenate([means[rest], _mix(means, a, b, share)])
        sh = np.concatenate([sh[rest], _mix(sh, a, b, share)])
        covariances = np.concatenate([covariances[rest], merged])
        masses = np.concatenate([masses[rest], joint])
    merged = _from_moments(*(values[len(rows) :] for values in (means, covariances, masses, sh)))
    merged = replace(merged, origin=gaussians.origin)
    return Gaussians.concatenate([gaussians[rows], merged])


def world_means(gaussians: Gaussians[np.ndarray]) -> np.ndarray:
    """Return the means (N, 3) in the world, float64."""
    return gaussians.means.astype(np.float64) + gaussians.origin


def shapes_of(gaussians: Gaussians[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return float64 standard deviations (N, 3) and rotations (N, 3, 3), preceded by a mask (N,).

    It marks the Gaussians whose numbers are all finite; others have zero scales.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        columns = (gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.sh)
        sums = [each.reshape(gaussians.num_gaussians, -1).sum(axis=1) for each in columns]
        is_valid = np.logical_and.reduce(np.isfinite(sums))
    quats = gaussians.quats.astype(np.float64)
    size = np.abs(quats).max(axis=1, keepdims=True)
    is_usable = is_valid[:, None] & (size > 0)
    quats = np.where(is_usable, quats, [1.0, 0, 0, 0]) / np.where(is_usable, size, 1)
    rotations = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    return is_valid, np.where(is_valid[:, None], gaussians.scales, 0).astype(np.float64), rotations


def _neighbours(means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs a < b of nearest neighbours, each once, in order."""
    count = min(NUM_NEIGHBOURS + 1, len(means))
    near = KDTree(means).query(means, k=count)[1].reshape(len(means), count)
    index = np.arange(len(means))[:, None]
    pair = np.minimum(near, index) * len(means) + np.maximum(near, index)
    a, b = np.divmod(np.unique(pair), len(means))
    return a[a < b], b[a < b]


def _disjoint_pairs(a: np.ndarray, b: np.ndarray, cost: np.ndarray, count: int) -> np.ndarray:
    """Return pairs' indices, by increasing cost: each is the cheapest left of both its members."""
    order = np.argsort(cost, kind="stable")
    a, b, rank = a[order], b[order], np.arange(len(order))
    chosen, is_free = [], np.ones(count, bool)
    while len(rank):
        cheapest = np.full(count, len(order))
        np.minimum.at(cheapest, a, rank)
        np.minimum.at(cheapest, b, rank)
        is_best = (cheapest[a] == rank) & (cheapest[b] == rank)
        chosen.append(rank[is_best])
        is_free[a[is_best]] = is_free[b[is_best]] = False
        is_left = is_free[a] & is_free[b]
        a, b, rank = a[is_left], b[is_left], rank[is_left]
    return order[np.sort(np.concatenate(chosen))]


def _squared_differences(values: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sums (M,) of squared differences of pairs of rows, some pairs at a time."""
    sums = np.empty(len(a))
    for start in range(0, len(a), PAIRS_AT_ONCE):
        part = slice(start, start + PAIRS_AT_ONCE)
        sums[part] = np.square(values[a[part]] - values[b[part]]).sum(axis=(1, 2))
    return sums


def _mix(values: np.ndarray, a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return means of pairs of rows; share (M,): the weights of the first ones."""
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return share * values[a] + (1 - share) * values[b]


def _surface(scales: np.ndarray) -> np.ndarray:
    """Return surfaces (N,) of ellipsoids, up to a factor."""
    x, y, z = np.power(scales, SURFACE_POWER).T
    return np.power((x * y + x * z + y * z) / 3, 1 / SURFACE_POWER)


def _from_moments(
    means: np.ndarray, covariances: np.ndarray, masses: np.ndarray, sh: np.ndarray
) -> Gaussians[np.ndarray]:
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    scales = np.sqrt(np.maximum(variances, np.finfo(np.float32).tiny))
    opacities = masses / np.maximum(_surface(scales), np.finfo(np.float64).tiny)
    opacities = np.clip(opacities, *OPACITY_LIMITS)
    quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    return Gaussians.from_numpy(means, quats, scales, opacities, sh)
