"""Gaussians far behind everything, where photographs show sky: a dome around the cameras.

A direction shows sky where photographs that look that way have no points near there, and agree on
the colour of something infinitely far away. If there are enough of these directions, the dome has
their colours, and everywhere else that of the nearest ones: what no photograph shows is not black.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree

from drgs.datasets.film import is_projectable, to_camera, to_film
from drgs.datasets.types import View, evenly_spaced

MAX_PHOTOGRAPHS, NUM_DIRECTIONS = 60, 16_000

NUM_CELLS = 24  # in a row of a photograph; a cell without points in it and around it is empty

MIN_EMPTY_SHARE, MIN_VIEWS = 0.7, 2
"""Share of the photographs that look in a direction in which it is empty, and their number."""

MAX_DEVIATION = 0.06  # median of their colours from the median colour

MIN_SKY = 0.015  # share of all directions

NUM_GAUSSIANS, NUM_NEIGHBOURS = 2000, 8
"""Gaussians of the dome, and directions of sky that give one its colour."""

FARTHER, CAMERAS_FARTHER = 1.5, 30.0
"""The radius of the dome, in the distance of nearly all points, and at least in that of the
cameras, from their middle."""

OPACITY = 0.95  # at the start


@dataclass(frozen=True, eq=False)
class Sky:
    """Gaussians of a dome."""

    means: np.ndarray  # (N, 3) world
    colors: np.ndarray  # (N, 3) display space
    scale: float  # standard deviation, scene units
    share: float  # of all directions, those that show sky


def sphere_directions(count: int) -> np.ndarray:
    """Return evenly spread directions (count, 3): a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, math.pi * (1 + math.sqrt(5)) * k
    radius = np.sqrt(1 - z * z)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def find_sky(views: Sequence[View], points: np.ndarray) -> Sky | None:
    """Return the dome of a scene with points (N, 3) world; None: its photographs show no sky."""
    views = evenly_spaced([view for view in views if is_projectable(view)], MAX_PHOTOGRAPHS)
    if len(views) < MIN_VIEWS or any(view.alpha is not None for view in views):
        return None
    centers = np.stack([view.center for view in views])
    middle = centers.mean(axis=0)
    spread = float(np.linalg.norm(centers - middle, axis=1).max())
    reach = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.99))
    radius = max(FARTHER * reach, CAMERAS_FARTHER * spread)
    directions = sphere_directions(NUM_DIRECTIONS)
    seen, colors = np.zeros(NUM_DIRECTIONS, int), []
    for view in views:
        rows, empty, found = _look_at_sky(view, points, view.center + radius * directions)
        seen[rows] += 1
        each = np.full((NUM_DIRECTIONS, 3), np.nan, np.float32)
        each[rows[empty]] = found[empty]
        colors.append(each)
    number = np.sum([np.isfinite(each[:, 0]) for each in colors], axis=0)
    (rows,) = np.nonzero((number >= MIN_VIEWS) & (number >= MIN_EMPTY_SHARE * seen))
    if len(rows) < MIN_SKY * NUM_DIRECTIONS:
        return None
    samples = np.stack(colors)[:, rows]
    color = np.nanmedian(samples, axis=0)
    agrees = np.nanmedian(np.abs(samples - color), axis=0).mean(axis=1) <= MAX_DEVIATION
    rows, color = rows[agrees], color[agrees]
    if len(rows) < MIN_SKY * NUM_DIRECTIONS:
        return None
    dome = sphere_directions(NUM_GAUSSIANS)
    distance, nearest = KDTree(directions[rows]).query(dome, k=NUM_NEIGHBOURS)
    weight = 1 / np.maximum(distance, 0.02)[:, :, None] ** 2
    blended = (weight * color[nearest]).sum(axis=1) / weight.sum(axis=1)
    scale = radius * math.sqrt(4 * math.pi / NUM_GAUSSIANS)
    return Sky(middle + radius * dome, blended, scale, len(rows) / NUM_DIRECTIONS)


def _look_at_sky(
    view: View, points: np.ndarray, far: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which of the far points (M, 3) are in the image, whether it is empty there, colours.

    A masked pixel is not empty.
    """
    cell, shape = view.width / NUM_CELLS, (view.height, view.width)
    u, v, depth = to_film(view, to_camera(view, [*points.T]))
    kept = (depth > 0) & (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)
    cells = np.zeros((math.ceil(view.height / cell), NUM_CELLS), bool)
    cells[(v[kept] / cell).astype(int), (u[kept] / cell).astype(int)] = True
    near = np.asarray(binary_dilation(cells, np.ones((3, 3))), bool)
    u, v, depth = to_film(view, to_camera(view, [*far.T]))
    (rows,) = np.nonzero((depth > 0) & (u >= 0) & (u < shape[1]) & (v >= 0) & (v < shape[0]))
    u, v = u[rows], v[rows]
    at = v.astype(int), u.astype(int)
    empty = ~near[(v / cell).astype(int), (u / cell).astype(int)]
    if view.mask is not None:
        empty &= np.asarray(view.mask)[at] > 0
    return rows, empty, np.asarray(view.image)[at]
