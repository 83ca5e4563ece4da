"""Splats from sigma points: the projection ``unscented``.

Layer 2, imported when it is chosen. The scaled unscented transform (Julier and Uhlmann 1997; Wan
and van der Merwe 2000; for splatting: Wu et al. 2025, "3DGUT") with alpha = 1, beta = 2, kappa = 0:
the mean and the points sqrt(3) standard deviations away from it along the three axes are projected
exactly, and their weighted mean and covariance are those of the splat. All weights of the
covariance are positive, so that it is a sum of outer products, without cancellation.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import drjit as dr

from drgs.arrays import types_of
from drgs.camera import Camera
from drgs.projection import (
    FilmShape,
    GaussianRows,
    clamped_slopes,
    ewa,
    film_axes,
    film_point,
    true_slopes,
    whiten,
)

SPREAD = math.sqrt(3)
"""Standard deviations from the mean to a sigma point: sqrt(n + lambda), lambda = 0."""

CENTER_WEIGHT = 2.0
"""Of the mean in the covariance, lambda / (n + lambda) + 1 - alpha^2 + beta; its weight in the mean
of the points is 0."""

WEIGHT = 1 / 6
"""Of each other point, in both."""

NEAREST = 1 / 3
"""Of the mean's depth: where a point would be nearer, a Gaussian has neither mean nor covariance on
the film, or ones that have nothing to do with its middle. The same holds far outside the film,
where slopes are clamped. Such splats are projected by the affine approximation."""


def unscented(rows: GaussianRows, camera: Camera, position: Any, low_pass: float) -> FilmShape:
    """The unscented transform of a Gaussian through the camera.

    position: Array3f, camera axes, the mean. Not differentiated: where :data:`NEAREST` decides.
    """
    slopes, clamped = true_slopes(position), clamped_slopes(camera, position)
    m0, m1, n = film_axes(rows, camera, position, slopes)
    on_film = [_sigma_offsets(m, n) for m in (m0, m1)]
    shift = [_mean_offset(m, n) for m in (m0, m1)]
    # The mean itself has the offset 0.
    columns = [
        [-math.sqrt(CENTER_WEIGHT) * mu, *(math.sqrt(WEIGHT) * (o - mu) for o in axis)]
        for axis, mu in zip(on_film, shift, strict=True)
    ]
    means2d = film_point(camera, position) + types_of(type(shift[0])).Array2f(shift)
    usable = (slopes[0] == clamped[0]) & (slopes[1] == clamped[1]) & _far_enough(n)
    affine = ewa(rows, camera, position, low_pass)
    transformed = whiten(means2d, *columns, low_pass)
    return dr.select(usable, transformed, affine)


def unscented_with_depth(
    rows: GaussianRows, camera: Camera, position: Any, low_pass: float
) -> FilmShape:
    """As :func:`unscented`, and what is needed for the depth at a pixel.

    The Gaussian's covariance with the depth is the affine one, and h is not negative.
    """
    film = unscented(rows, camera, position, low_pass)
    m0, m1, n = film_axes(rows, camera, position, true_slopes(position))
    p, r, s = film.whitening
    kx, ky = dr.dot(m0, n), dr.dot(m1, n)
    kx, ky = dr.fma(p, kx, r * ky), s * ky
    h = dr.squared_norm(n) - dr.fma(kx, kx, ky * ky)
    return replace(film, perspective=[kx, ky, dr.select(h > 0, h, 0)])


def _far_enough(n: Any) -> Any:
    """Whether no point is too near; n: half axes in depth, relative to the mean's."""
    return dr.max(dr.abs(n)) <= (1 - NEAREST) / SPREAD


def _sigma_offsets(m: Any, n: Any) -> list[Any]:
    """Places of the six points besides the mean, px, along one side of the film, from the mean's.

    m, n: half axes on the film and in depth. With c = +-sqrt(3), a point's depth is z (1 + c n) and
    its place c m / (1 + c n): a difference that does not cancel.
    """
    return [
        c * m_k / _depth(c * n_k) for c in (SPREAD, -SPREAD) for m_k, n_k in zip(m, n, strict=True)
    ]


def _mean_offset(m: Any, n: Any) -> Any:
    """The weighted mean of these places: two of opposite c add up to -2 c^2 m n / (1 - c^2 n^2)."""
    terms = [
        m_k * n_k / (_depth(SPREAD * n_k) * _depth(-SPREAD * n_k))
        for m_k, n_k in zip(m, n, strict=True)
    ]
    return -2 * SPREAD**2 * WEIGHT * sum(terms[1:], terms[0])


def _depth(change: Any) -> Any:
    """Of a point, relative to the mean's. One that is too near is not used, but stays finite."""
    nearest, depth = NEAREST / 2, 1 + change
    return dr.select(depth > nearest, depth, nearest)
