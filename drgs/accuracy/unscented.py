"""Splats from sigma points: ``projection: unscented``.

Imported when it is chosen. The scaled unscented transform (Julier and Uhlmann 1997; Wan and van der
Merwe 2000; for splatting: Wu et al. 2025, "3DGUT") with alpha = 1, beta = 2, kappa = 0: the mean
and the points sqrt(3) standard deviations away from it along the three axes are projected exactly,
and their weighted mean and covariance are those of the splat. All weights of the covariance are
positive, so that it is a sum of outer products, without cancellation.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import singledispatch

import drjit as dr

from drgs.cameras.camera import Camera
from drgs.cameras.lens import Lens, Pinhole
from drgs.config.approximations import PROJECTIONS
from drgs.core.arrays import types_of
from drgs.core.types import Array3f, Bool, Float
from drgs.splatting.projection import (
    FilmShape,
    GaussianRows,
    ProjectionModel,
    ewa,
    factor_conic,
    film_axes,
    world_axes,
)

SIGMA_POINT_STDS = math.sqrt(3)
"""Standard deviations from the mean to a sigma point: sqrt(n + lambda), lambda = 0."""

CENTER_WEIGHT = 2.0
"""Weight of the mean in the covariance, lambda / (n + lambda) + 1 - alpha^2 + beta; its weight in
the mean of the points is 0."""

SIGMA_POINT_WEIGHT = 1 / 6  # weight of each other point, in both

MIN_RELATIVE_DEPTH = 1 / 3
"""Part of the mean's depth: where a point would be nearer, a Gaussian has no mean or covariance on
the film, or ones that have nothing to do with its middle. The same holds far outside the film,
where slopes are clamped. Such splats are projected by the affine approximation."""


def unscented_shape(
    rows: GaussianRows, camera: Camera, position: Array3f, low_pass: Float | float
) -> FilmShape:
    """Return the unscented transform; the limit MIN_RELATIVE_DEPTH is not differentiated."""
    offsets, mean, usable = _sigma_points(camera.lens, rows, camera, position)
    # The mean itself has the offset 0.
    columns = [
        [-math.sqrt(CENTER_WEIGHT) * mu, *(math.sqrt(SIGMA_POINT_WEIGHT) * (o - mu) for o in axis)]
        for axis, mu in zip(offsets, mean, strict=True)
    ]
    shift = types_of(type(position.z)).Array2f(mean)
    means2d = camera.lens.project_point(camera, position) + shift
    affine = ewa(rows, camera, position, low_pass)
    return dr.select(usable, factor_conic(means2d, columns[0], columns[1], low_pass), affine)


@PROJECTIONS.register("unscented")
class Unscented(ProjectionModel):
    """The unscented transform."""

    shape = staticmethod(unscented_shape)


SigmaPoints = tuple[list[list[Float]], list[Float], Bool | bool]
"""The six points besides the mean, by side of the film: places (px, from the mean's) and their
mean; and whether they can be used."""


@singledispatch
def _sigma_points(lens: Lens, rows: GaussianRows, camera: Camera, position: Array3f) -> SigmaPoints:
    """Project the sigma points through any lens, as it projects points."""
    center, slopes = lens.project_point(camera, position), lens.true_slopes(camera, position)
    not_nearer = replace(camera, near=MIN_RELATIVE_DEPTH * lens.visibility(camera, position)[2])
    usable = _same(slopes, lens.clamped_slopes(camera, position))
    offsets: list[list[Float]] = [[], []]
    for axis in world_axes(rows):
        for c in (SIGMA_POINT_STDS, -SIGMA_POINT_STDS):
            seen, point, _ = lens.visibility(not_nearer, position + c * (camera.rotation @ axis))
            usable &= seen
            place = lens.project_point(camera, point)
            for side, offset in zip(offsets, lens.offset(camera, center, place), strict=True):
                side.append(offset)
    return offsets, [SIGMA_POINT_WEIGHT * sum(o[1:], o[0]) for o in offsets], usable


@_sigma_points.register
def _(lens: Pinhole, rows: GaussianRows, camera: Camera, position: Array3f) -> SigmaPoints:
    """Project the sigma points through a pinhole, by formulas that do not cancel."""
    slopes = lens.true_slopes(camera, position)
    m0, m1, n = film_axes(rows, camera, position, slopes)
    # No point is too near.
    far_enough = dr.max(dr.abs(n)) <= (1 - MIN_RELATIVE_DEPTH) / SIGMA_POINT_STDS
    offsets, mean = [_sigma_offsets(m, n) for m in (m0, m1)], [_mean_offset(m, n) for m in (m0, m1)]
    return offsets, mean, _same(slopes, lens.clamped_slopes(camera, position)) & far_enough


def _same(slopes: list[Float] | None, clamped: list[Float] | None) -> Bool | bool:
    if slopes is None or clamped is None:
        return True
    return (slopes[0] == clamped[0]) & (slopes[1] == clamped[1])


def _sigma_offsets(m: Array3f, n: Array3f) -> list[Float]:
    """Return the places of the six points along one side of the film, px, from the mean's.

    m, n: half axes on the film and in depth. With c = +-sqrt(3), a point's depth is z (1 + c n) and
    its place c m / (1 + c n): a difference that does not cancel.
    """
    return [
        c * m_k / _depth(c * n_k)
        for c in (SIGMA_POINT_STDS, -SIGMA_POINT_STDS)
        for m_k, n_k in zip(m, n, strict=True)
    ]


def _mean_offset(m: Array3f, n: Array3f) -> Float:
    """Return their weighted mean: two of opposite c add up to -2 c^2 m n / (1 - c^2 n^2)."""
    terms = [
        m_k * n_k / (_depth(SIGMA_POINT_STDS * n_k) * _depth(-SIGMA_POINT_STDS * n_k))
        for m_k, n_k in zip(m, n, strict=True)
    ]
    return -2 * SIGMA_POINT_STDS**2 * SIGMA_POINT_WEIGHT * sum(terms[1:], terms[0])


def _depth(change: Float) -> Float:
    """Return a point's depth, relative to the mean's; finite also where it is not used."""
    nearest, depth = MIN_RELATIVE_DEPTH / 2, 1 + change
    return dr.select(depth > nearest, depth, nearest)
