"""Points on the visual hull of the images' silhouettes, from their alpha channels.

The visual hull (Laurentini 1994) is the largest body with these silhouettes. An octree finds its
surface as in Szeliski, "Rapid octree construction from image sequences" (1993): a cube is outside
if some image shows only transparent pixels at its place, inside if no image shows one, and else on
the surface, and divided. A cube's place is a box of pixels that contains all of it, so that thin
parts of the hull are not lost. A summed-area table (Crow 1984) counts the opaque pixels in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from drgs.core.environment import denormals_kept
from drgs.datasets.film import Columns, is_projectable, to_camera, to_film
from drgs.datasets.types import View
from drgs.initialization.start_box import Box

MAX_EMPTY_ALPHA = 4 / 255  # of empty pixels: mattes have noise

MIN_POINT_ALPHA = 0.5  # of pixels that show points; fainter parts are found as thin parts are

MIN_TRANSPARENT_SHARE = 0.02  # of an image with a mask; corners emptied by undistortion have less

MIN_MASKED_SHARE, MIN_MASKED_VIEWS = 0.95, 3
"""Share and number of the views that must have a mask. With fewer, a hull is mostly their cones."""

MAX_VIEWS, MAX_SIDE_PX = 120, 512
"""Number of silhouettes, and their longest side: pixels of larger images are merged."""

MIN_SEEN_SHARE = 0.5  # of the views, which must see a cube: others cannot show it empty

ROOT_CUBES_PER_SIDE = 16  # cubes along the longest side of the box that is divided first

COARSE_CUBES, COARSE_LEVELS = 4000, 7
"""Cubes on the surface that are enough to know the hull's box, and its area to a few per cent; and
divisions, at most, to find so many: of a box 2,048 times as wide as the hull."""

SPARE, MAX_CUBES = 1.25, 3
"""In wanted numbers of points: the number that the first division aims at, as some are left out;
and cubes that are divided, at most. Silhouettes of noise have a surface everywhere."""

SHELL, MARGIN = 1.2, 1.6
"""In point distances: edge of a cube around a surface point, some pixel of which an image shows
empty; and edge to which cubes are widened so that half-empty ones contain all of that shell."""

THIN, THIN_LEVELS = 1.5, 3
"""Distance, in edges, of a cube from all points of the hull that makes it a thin part, which random
points miss; and divisions, at most, that confirm it. Where there are many, they are noise."""

CUBES_PER_CHUNK = 1 << 15  # projected at once: their numbers stay in the processor's cache


@dataclass(frozen=True, eq=False)
class Silhouette:
    """Opaque pixels of a view."""

    view: View
    scale: int  # width of a pixel in the view's
    solid: np.ndarray  # (rows, columns) bool: opaque to a half at least
    table: np.ndarray  # (rows + 1, columns + 1) int32: opaque pixels above and to the left
    transparent: float  # share of the image


def silhouettes_of(views: Sequence[View]) -> list[Silhouette]:
    """Return silhouettes of views that have alpha and a camera that does not move."""
    views = [v for v in subsample_views(views) if v.alpha is not None and is_projectable(v)]
    return [_silhouette(view) for view in views]


def subsample_views(views: Sequence[View]) -> Sequence[View]:
    """Return all views, or every n-th of many."""
    return views[:: -(-len(views) // MAX_VIEWS) or 1]


def _silhouette(view: View) -> Silhouette:
    alpha = np.asarray(view.alpha)
    opaque, solid = alpha > MAX_EMPTY_ALPHA, alpha >= MIN_POINT_ALPHA
    transparent = 1 - float(opaque.mean())
    if view.mask is not None:
        left_out = np.asarray(view.mask) == 0  # not known to be empty
        opaque |= left_out
        solid |= left_out
    scale = -(-max(opaque.shape) // MAX_SIDE_PX)
    for axis in (0, 1):  # squares of pixels, any of which is set; the last may be smaller
        starts = np.arange(0, opaque.shape[axis], scale)
        opaque, solid = (np.logical_or.reduceat(each, starts, axis) for each in (opaque, solid))
    table = np.zeros((opaque.shape[0] + 1, opaque.shape[1] + 1), np.int32)
    np.cumsum(opaque, axis=0, dtype=np.int32, out=table[1:, 1:])
    np.cumsum(table[1:, 1:], axis=1, out=table[1:, 1:])
    return Silhouette(view, scale, solid, table, transparent)


def num_transparent(silhouettes: Sequence[Silhouette]) -> int:
    """Return the number of silhouettes of partly transparent images."""
    return sum(s.transparent >= MIN_TRANSPARENT_SHARE for s in silhouettes)


def are_masks(silhouettes: Sequence[Silhouette], views: Sequence[View]) -> bool:
    """Return whether the alpha of nearly all ``views`` cuts out the object."""
    wanted = MIN_MASKED_SHARE * len(subsample_views(views))
    return num_transparent(silhouettes) >= max(MIN_MASKED_VIEWS, wanted)


@dataclass(frozen=True, eq=False)
class Cubes:
    """Cubes of a grid along the world's axes."""

    low: np.ndarray  # (3,) float64, world: the corner of cube (0, 0, 0)
    edge: float  # scene units
    index: np.ndarray  # (N, 3) int64

    @staticmethod
    def filling(low: np.ndarray, high: np.ndarray, edge: float) -> Cubes:
        """Return the cubes that fill the box from ``low`` to ``high``."""
        counts = np.maximum(1, np.ceil((high - low) / edge - 1e-6)).astype(np.int64)
        low = (low + high - edge * counts) / 2
        return Cubes(low, edge, np.argwhere(np.ones(counts, bool)))

    def __len__(self) -> int:
        return len(self.index)

    def centers(self) -> np.ndarray:
        """Return centres (N, 3) float64, world."""
        return self.low + self.edge * (self.index + 0.5)

    def divide(self) -> Cubes:
        """Return eight cubes in the place of each."""
        eighths = np.argwhere(np.ones((2, 2, 2), bool))
        return Cubes(self.low, self.edge / 2, (2 * self.index[:, None] + eighths).reshape(-1, 3))

    def select(self, rows: np.ndarray) -> Cubes:
        """Return some of the cubes; rows: a mask or indices."""
        return Cubes(self.low, self.edge, self.index[rows])


def hull_points(silhouettes: Sequence[Silhouette], box: Box, count: int, seed: int) -> np.ndarray:
    """Return points (M, 3) float64, world, on the surface of the visual hull within ``box``.

    At most ``count``, and about so many unless images contradict each other, evenly spread: each at
    a random place within a cube of its own.
    """
    corners = box.center - box.half_extent, box.center + box.half_extent
    coarse = Cubes.filling(*corners, 2 * box.half_extent / ROOT_CUBES_PER_SIDE)
    coarse = _surface(silhouettes, coarse, COARSE_LEVELS, COARSE_CUBES)
    points = _points_in(silhouettes, coarse, seed)
    if not len(points):
        return points
    edge = coarse.edge * math.sqrt(len(points) / (SPARE * count))
    centers = coarse.centers()
    low, high = (c + s * coarse.edge / 2 for c, s in ((centers.min(0), -1), (centers.max(0), 1)))
    levels = max(0, int(np.ceil(np.log2((high - low).max() / (ROOT_CUBES_PER_SIDE * edge)))))
    cubes = Cubes.filling(low, high, edge * 2**levels)
    cubes = _surface(silhouettes, cubes, levels, MAX_CUBES * count)
    points = _points_in(silhouettes, cubes, seed)
    points = points[(np.abs(points - box.center) <= box.half_extent).all(axis=1)]
    chosen = np.random.Generator(np.random.Philox(key=seed)).permutation(len(points))[:count]
    return points[np.sort(chosen)]


def _surface(silhouettes: Sequence[Silhouette], cubes: Cubes, levels: int, enough: int) -> Cubes:
    """Return cubes on the surface after ``levels`` divisions, or when there are ``enough``."""
    for level in range(levels + 1):
        centers, edge = cubes.centers(), MARGIN * cubes.edge
        shown = np.flatnonzero(_shown_by_all(silhouettes, centers, edge))
        cubes = cubes.select(shown[_half_empty(silhouettes, centers[shown], edge)])
        if level == levels or len(cubes) >= enough or not len(cubes):
            break
        cubes = cubes.divide()
    return cubes


def _points_in(silhouettes: Sequence[Silhouette], cubes: Cubes, seed: int) -> np.ndarray:
    """Return points (M, 3) of the hull near its surface, at most one in each eighth of a cube."""
    random, kept = np.random.Generator(np.random.Philox(key=seed)), [np.zeros((0, 3))]
    for some in _chunks(np.arange(len(cubes))):
        eighths = cubes.select(some).divide()
        points = eighths.centers() + eighths.edge * (random.random((len(eighths), 3)) - 0.5)
        kept.append(points[_shown_by_all(silhouettes, points, 0.0)])
    inside = np.concatenate(kept)
    thin = cubes
    if len(inside):
        with denormals_kept():
            distance, _ = KDTree(inside).query(cubes.centers())
        thin = cubes.select(distance > THIN * cubes.edge)
    surface = inside[_half_empty(silhouettes, inside, SHELL * cubes.edge / 2)]
    levels = 0  # of divisions of cubes without a point, of whose eighths each gets one at most
    while levels == 0 or (levels < THIN_LEVELS and len(thin) <= CUBES_PER_CHUNK):
        thin = thin.divide()
        thin = thin.select(_shown_by_all(silhouettes, thin.centers(), thin.edge))
        levels += 1
    _, first = np.unique(thin.index >> (levels - 1), axis=0, return_index=True)
    return np.concatenate([surface, thin.centers()[np.sort(first)]])


def _shown_by_all(
    silhouettes: Sequence[Silhouette], centers: np.ndarray, edge: float
) -> np.ndarray:
    """Return which (N,) cubes, points if edge is 0, no image shows empty and enough images show."""
    columns = [np.ascontiguousarray(c) for c in centers.T]
    rows, num_views = np.arange(len(centers)), np.zeros(len(centers), np.int32)
    for silhouette in silhouettes:
        kept = [rows[:0]]
        for some in _chunks(rows):
            if edge > 0:
                is_whole, opaque, area = _opaque_pixels(silhouette, columns, some, edge)
                shown, empty = area > 0, is_whole & (opaque == 0)
            else:
                shown, empty = _classify_points(silhouette, columns, some)
            num_views[some] += shown
            kept.append(some[~empty])
        rows = np.concatenate(kept)
    result = np.zeros(len(centers), bool)
    result[rows] = num_views[rows] >= MIN_SEEN_SHARE * len(silhouettes)
    return result


def _half_empty(silhouettes: Sequence[Silhouette], centers: np.ndarray, edge: float) -> np.ndarray:
    """Return which (N,) cubes some image shows with a transparent pixel; centers: (N, 3) world."""
    columns = [np.ascontiguousarray(c) for c in centers.T]
    rows, result = np.arange(len(centers)), np.zeros(len(centers), bool)
    for silhouette in silhouettes:
        for some in _chunks(rows):
            _, opaque, area = _opaque_pixels(silhouette, columns, some, edge)
            result[some] = opaque < area
        rows = rows[~result[rows]]
    return result


def _chunks(rows: np.ndarray) -> list[np.ndarray]:
    return [rows[start : start + CUBES_PER_CHUNK] for start in range(0, len(rows), CUBES_PER_CHUNK)]


def _classify_points(
    silhouette: Silhouette, points: Columns, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether points are in the image, and whether it shows them beside solid pixels."""
    view, (height, width) = silhouette.view, silhouette.solid.shape
    u, v, depth = to_film(view, to_camera(view, [c[rows] for c in points], np.float32))
    u, v = np.floor(u / silhouette.scale), np.floor(v / silhouette.scale)
    shown = (depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    pixel = np.where(shown, v * width + u, 0).astype(np.int64)
    return shown, shown & ~silhouette.solid.ravel()[pixel]


def _opaque_pixels(
    silhouette: Silhouette, centers: Columns, rows: np.ndarray, edge: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return whether all of each cube is in the image; numbers of opaque and of all pixels there.

    A pinhole shows p + d at a distance from p of at most |J d| z / (z - d_z), with J the derivative
    at p, which differences bound in the same way.
    """
    view, (height, width) = silhouette.view, silhouette.solid.shape
    position = to_camera(view, [c[rows] for c in centers], np.float32)
    u, v, depth = to_film(view, position)
    half_u, half_v = np.zeros_like(u), np.zeros_like(v)
    reach = 0.5 * math.sqrt(3) * edge
    shown = depth > 2 * reach
    for step in (0.5 * edge * view.camera_to_world[:3, :3]).tolist():
        moved = to_film(view, [p + s for p, s in zip(position, step, strict=True)])
        half_u += np.abs(moved[0] - u)
        half_v += np.abs(moved[1] - v)
        shown &= moved[2] > 0
    stretch = (depth + reach) / np.where(shown, depth - reach, 1)
    half_u *= stretch
    half_v *= stretch
    stride, flat = width + 1, silhouette.table.ravel()
    whole = shown
    bounds = []
    for place, half, size in ((u, half_u, width), (v, half_v, height)):
        first = np.floor((place - half) / silhouette.scale)
        last = np.floor((place + half) / silhouette.scale) + 1
        whole = whole & (first >= 0) & (last <= size)
        bounds += [np.where(shown, np.clip(b, 0, size), 0).astype(np.int32) for b in (first, last)]
    left, right, top, bottom = bounds
    area = (right - left) * (bottom - top)
    top *= stride
    bottom *= stride
    opaque = flat[bottom + right] - flat[top + right] - flat[bottom + left] + flat[top + left]
    return whole, opaque, area
