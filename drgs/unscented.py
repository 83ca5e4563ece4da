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


def unscented(rows: GaussianRows, camera: Camera, position: Any, low_pass: float) -> FilmShape:
    """The unscented transform of a Gaussian through the camera.

    position: Array3f, camera axes, the mean. Points before the near plane are moved into it.
    """
    offsets = _sigma_points(rows, camera, position)
    shift = [WEIGHT * sum(axis[1:], axis[0]) for axis in offsets]
    # The mean itself has the offset 0.
    columns = [
        [-math.sqrt(CENTER_WEIGHT) * mu, *(math.sqrt(WEIGHT) * (o - mu) for o in axis)]
        for axis, mu in zip(offsets, shift, strict=True)
    ]
    means2d = film_point(camera, position) + types_of(type(shift[0])).Array2f(shift)
    return whiten(means2d, *columns, low_pass)


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
    return replace(film, perspective=type(m0)(kx, ky, dr.select(h > 0, h, 0)))


def _sigma_points(rows: GaussianRows, camera: Camera, position: Any) -> list[list[Any]]:
    """x and y (px, from the mean's place on the film) of the six points besides the mean.

    With c = +-sqrt(3) and a column (m, n) of the half axes on the film and in depth, the point's
    depth is z' = z (1 + c n), and its place c m z / z': a difference that does not cancel. Where z'
    is replaced, f (x / z) (z (1 + c n) - z') / z' is added.
    """
    slopes, z = true_slopes(position), position.z
    m0, m1, n = film_axes(rows, camera, position, slopes)
    offsets: list[list[Any]] = [[], []]
    for c in (SPREAD, -SPREAD):
        for k in range(3):
            true_depth = z * dr.fma(c, n[k], 1)
            depth = dr.select(true_depth < camera.near, camera.near, true_depth)
            excess = dr.select(true_depth < camera.near, true_depth - camera.near, 0)
            for axis, (m, focal, slope) in enumerate(
                zip((m0, m1), camera.focal, slopes, strict=True)
            ):
                offsets[axis].append((c * m[k] * z + focal * slope * excess) / depth)
    return offsets
