"""Points on the visual hull: what no picture shows empty, from how opaque the pictures are.

The visual hull (Laurentini 1994) is the largest body with the pictures' silhouettes. An octree
finds its surface as in Szeliski, "Rapid octree construction from image sequences" (1993): a cube is
outside if some picture shows only transparent pixels at its place, and inside if no picture shows
one; what is neither is on the surface, and divided.

A cube's place in a picture is a box of pixels that holds all of it, so that no part of the hull is
lost however thin it is. What is opaque in such a box is counted by a summed-area table (Crow 1984).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from drgs.core.environment import denormals_kept
from drgs.datasets.types import View
from drgs.initialization.film import Columns, is_projectable, to_camera, to_film
from drgs.initialization.start_box import Box

TRANSPARENT = 4 / 255
"""Alpha: what is no more opaque than this is empty. Mattes have noise."""

SOLID = 0.5
"""Alpha: what is less opaque is mostly beside what there is. A point in there would be too far out;
parts that are nowhere more opaque are found as those are that are too thin to be hit."""

LEAST_TRANSPARENT = 0.02
"""Of a picture whose alpha is a mask. Corners that are empty since distortion was removed are less
of most."""

NEARLY_ALL = 0.95
"""Of the pictures, those that must have a mask."""

LEAST_VIEWS = 3
"""With fewer, a hull is mostly the cones that they see."""

MOST_VIEWS = 120
"""Whose silhouettes are looked at: more say little more about a hull, and take as long again."""

MOST_PIXELS = 512
"""Width and height of a silhouette: of a larger picture, pixels are taken together."""

LEAST_SEEN = 0.5
"""Of the views, those that must see a cube: what the others do not see, they cannot show empty."""

ROOTS = 16
"""Cubes along the longest side of the box that is divided first."""

COARSE = 4000
"""Cubes on the surface that are enough to know the hull's box, and its area to a few per cent."""

COARSE_LEVELS = 7
"""Divisions, at most, to find so many: of a box 2,048 times as wide as what is in it."""

SPARE = 1.25
"""Of the wanted number of points: what the first division promises, as some are left out."""

MOST_CUBES = 3
"""Of the wanted number of points: cubes that are divided into eight, at most. Silhouettes of noise
have a surface everywhere."""

SHELL = 1.2
"""Of the points' distance to each other: edge of a cube around a point on the surface, which some
picture shows half empty."""

MARGIN = 1.6
"""Times the edge of a cube: all of the shell is in cubes that are half empty when they are widened
by this."""

THIN = 1.5
"""Edges of a cube: one so far from all points of the hull is a part of it too thin to be hit."""

THIN_LEVELS = 3
"""Divisions of such a cube, after which it is known well enough whether there is one; fewer where
there are many, which are noise."""

CHUNK = 1 << 15
"""Cubes that are projected at once: their numbers stay in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """Which pixels of a view show something; the pixels are ``scale`` px of the view's wide."""

    view: View
    scale: int
    solid: np.ndarray  # (rows, columns) bool: opaque to a half at least
    table: np.ndarray  # (rows + 1, columns + 1) int32: opaque pixels above and to the left
    transparent: float  # part of the picture


def silhouettes_of(views: Sequence[View]) -> list[Silhouette]:
    """Those of the views that are looked at and have alpha, and whose camera stands still.

    A pixel that a mask leaves out is not known to be empty, and so is part of the silhouette.
    """
    views = [v for v in looked_at(views) if v.alpha is not None and is_projectable(v)]
    return [_silhouette(view) for view in views]


def looked_at(views: Sequence[View]) -> Sequence[View]:
    """All of them, or every n-th of many."""
    return views[:: -(-len(views) // MOST_VIEWS) or 1]


def _silhouette(view: View) -> Silhouette:
    alpha = np.asarray(view.alpha)
    opaque, solid = alpha > TRANSPARENT, alpha >= SOLID
    transparent = 1 - float(opaque.mean())
    if view.mask is not None:
        unknown = np.asarray(view.mask) == 0
        opaque |= unknown
        solid |= unknown
    scale = -(-max(opaque.shape) // MOST_PIXELS)
    opaque, solid = (_any_of(pixels, scale) for pixels in (opaque, solid))
    table = np.zeros((opaque.shape[0] + 1, opaque.shape[1] + 1), np.int32)
    np.cumsum(opaque, axis=0, dtype=np.int32, out=table[1:, 1:])
    np.cumsum(table[1:, 1:], axis=1, out=table[1:, 1:])
    return Silhouette(view, scale, solid, table, transparent)


def _any_of(pixels: np.ndarray, scale: int) -> np.ndarray:
    """Whether any pixel is set in squares of ``scale``; the last ones may be smaller."""
    for axis in (0, 1):
        pixels = np.logical_or.reduceat(pixels, np.arange(0, pixels.shape[axis], scale), axis)
    return pixels


def num_transparent(silhouettes: Sequence[Silhouette]) -> int:
    """How many are those of a picture that is partly transparent."""
    return sum(s.transparent >= LEAST_TRANSPARENT for s in silhouettes)


def are_masks(silhouettes: Sequence[Silhouette], views: Sequence[View]) -> bool:
    """Whether the alpha of the pictures, whose views are ``views``, says what is to be fitted."""
    wanted = NEARLY_ALL * len(looked_at(views))
    return num_transparent(silhouettes) >= max(LEAST_VIEWS, wanted)


@dataclass(frozen=True, eq=False)
class Cubes:
    """Some cubes of a grid along the world's axes."""

    low: np.ndarray  # (3,) float64, world: the corner of cube (0, 0, 0)
    edge: float  # scene units
    index: np.ndarray  # (N, 3) int64

    @staticmethod
    def filling(low: np.ndarray, high: np.ndarray, edge: float) -> Cubes:
        """All that are needed to fill the box from ``low`` to ``high``."""
        counts = np.maximum(1, np.ceil((high - low) / edge - 1e-6)).astype(np.int64)
        low = (low + high - edge * counts) / 2
        return Cubes(low, edge, np.argwhere(np.ones(counts, bool)))

    def __len__(self) -> int:
        return len(self.index)

    def centers(self) -> np.ndarray:
        """(N, 3) float64, world."""
        return self.low + self.edge * (self.index + 0.5)

    def divided(self) -> Cubes:
        """Eight in the place of each."""
        eighths = np.argwhere(np.ones((2, 2, 2), bool))
        index = (2 * self.index[:, None] + eighths).reshape(-1, 3)
        return Cubes(self.low, self.edge / 2, index)

    def chosen(self, rows: np.ndarray) -> Cubes:
        """Some of them; rows: a mask or indices."""
        return Cubes(self.low, self.edge, self.index[rows])


def hull_points(silhouettes: Sequence[Silhouette], box: Box, count: int, seed: int) -> np.ndarray:
    """(M, 3) float64, world: points on the surface of the visual hull within ``box``.

    At most ``count``, about evenly spread, each at a random place within a cube of its own: M is
    about ``count``, unless pictures contradict each other and there is no hull, which is M = 0.
    The same seed gives the same points.
    """
    corners = box.center - box.half_extent, box.center + box.half_extent
    coarse = Cubes.filling(*corners, 2 * box.half_extent / ROOTS)
    coarse = _surface(silhouettes, coarse, COARSE_LEVELS, COARSE)
    points = _points_in(silhouettes, coarse, seed)
    if not len(points):
        return points
    edge = coarse.edge * math.sqrt(len(points) / (SPARE * count))
    centers = coarse.centers()
    low, high = (c + s * coarse.edge / 2 for c, s in ((centers.min(0), -1), (centers.max(0), 1)))
    levels = max(0, int(np.ceil(np.log2((high - low).max() / (ROOTS * edge)))))
    cubes = Cubes.filling(low, high, edge * 2**levels)
    cubes = _surface(silhouettes, cubes, levels, MOST_CUBES * count)
    points = _points_in(silhouettes, cubes, seed)
    points = points[(np.abs(points - box.center) <= box.half_extent).all(axis=1)]
    chosen = np.random.Generator(np.random.Philox(key=seed)).permutation(len(points))[:count]
    return points[np.sort(chosen)]


def _surface(silhouettes: Sequence[Silhouette], cubes: Cubes, levels: int, enough: int) -> Cubes:
    """Those on the surface, after ``levels`` divisions, or as soon as there are ``enough``."""
    for level in range(levels + 1):
        centers, edge = cubes.centers(), MARGIN * cubes.edge
        shown = np.flatnonzero(_shown_by_all(silhouettes, centers, edge))
        cubes = cubes.chosen(shown[_half_empty(silhouettes, centers[shown], edge)])
        if level == levels or len(cubes) >= enough or not len(cubes):
            break
        cubes = cubes.divided()
    return cubes


def _points_in(silhouettes: Sequence[Silhouette], cubes: Cubes, seed: int) -> np.ndarray:
    """(M, 3): points of the hull near its surface, at most one in each eighth of a cube."""
    random, found = np.random.Generator(np.random.Philox(key=seed)), [np.zeros((0, 3))]
    for some in _chunks(np.arange(len(cubes))):
        eighths = cubes.chosen(some).divided()
        points = eighths.centers() + eighths.edge * (random.random((len(eighths), 3)) - 0.5)
        found.append(points[_shown_by_all(silhouettes, points, 0.0)])
    inside = np.concatenate(found)
    thin = cubes
    if len(inside):
        with denormals_kept():
            distance, _ = cKDTree(inside).query(cubes.centers())
        thin = cubes.chosen(distance > THIN * cubes.edge)
    surface = inside[_half_empty(silhouettes, inside, SHELL * cubes.edge / 2)]
    return np.concatenate([surface, _thin_points(silhouettes, thin)])


def _thin_points(silhouettes: Sequence[Silhouette], cubes: Cubes) -> np.ndarray:
    """(M, 3): where cubes without a point have parts of the hull, at most one in each eighth."""
    levels = 0
    while levels == 0 or (levels < THIN_LEVELS and len(cubes) <= CHUNK):
        cubes = cubes.divided()
        cubes = cubes.chosen(_shown_by_all(silhouettes, cubes.centers(), cubes.edge))
        levels += 1
    _, first = np.unique(cubes.index >> (levels - 1), axis=0, return_index=True)
    return cubes.centers()[np.sort(first)]


def _shown_by_all(
    silhouettes: Sequence[Silhouette], centers: np.ndarray, edge: float
) -> np.ndarray:
    """Which cubes (N,) no picture shows empty, of those that enough of the pictures show.

    centers: (N, 3) world; edge 0: points.
    """
    columns = [np.ascontiguousarray(c) for c in centers.T]
    rows, seen = np.arange(len(centers)), np.zeros(len(centers), np.int32)
    look = _look_at_cubes if edge > 0 else _look_at_points
    for silhouette in silhouettes:
        kept = [rows[:0]]
        for some in _chunks(rows):
            shown, empty = look(silhouette, columns, some, edge)
            seen[some] += shown
            kept.append(some[~empty])
        rows = np.concatenate(kept)
    result = np.zeros(len(centers), bool)
    result[rows] = seen[rows] >= LEAST_SEEN * len(silhouettes)
    return result


def _half_empty(silhouettes: Sequence[Silhouette], centers: np.ndarray, edge: float) -> np.ndarray:
    """Which cubes (N,) some picture shows with a transparent pixel; centers: (N, 3) world."""
    columns = [np.ascontiguousarray(c) for c in centers.T]
    rows, result = np.arange(len(centers)), np.zeros(len(centers), bool)
    for silhouette in silhouettes:
        for some in _chunks(rows):
            _, opaque, area = _opaque_pixels(silhouette, columns, some, edge)
            result[some] = opaque < area
        rows = rows[~result[rows]]
    return result


def _chunks(rows: np.ndarray) -> list[np.ndarray]:
    return [rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK)]


def _look_at_points(
    silhouette: Silhouette, centers: Columns, rows: np.ndarray, _edge: float
) -> tuple[np.ndarray, np.ndarray]:
    """Whether points are in the picture; whether it shows them beside what is solid."""
    view, (height, width) = silhouette.view, silhouette.solid.shape
    u, v, depth = to_film(view, to_camera(view, [c[rows] for c in centers], np.float32))
    u, v = np.floor(u / silhouette.scale), np.floor(v / silhouette.scale)
    shown = (depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    place = np.where(shown, v * width + u, 0).astype(np.int64)
    return shown, shown & ~silhouette.solid.ravel()[place]


def _look_at_cubes(
    silhouette: Silhouette, centers: Columns, rows: np.ndarray, edge: float
) -> tuple[np.ndarray, np.ndarray]:
    """Whether some of each cube is in the picture; whether it shows that there is nothing."""
    whole, opaque, area = _opaque_pixels(silhouette, centers, rows, edge)
    return area > 0, whole & (opaque == 0)


def _opaque_pixels(
    silhouette: Silhouette, centers: Columns, rows: np.ndarray, edge: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of cubes: whether all of one is in the picture; opaque pixels at its place; all pixels there.

    centers: (N,) each; rows: which of them are asked for.

    A pinhole shows p + d at a distance from p of at most |J d| z / (z - d_z), with J the derivative
    at p, which differences bound in the same way.
    """
    view, (height, width) = silhouette.view, silhouette.solid.shape
    position = to_camera(view, [c[rows] for c in centers], np.float32)
    u, v, depth = to_film(view, position)
    half_u, half_v = np.zeros_like(u), np.zeros_like(v)
    reach = 0.5 * math.sqrt(3) * edge
    seen = depth > 2 * reach
    for step in (0.5 * edge * view.camera_to_world[:3, :3]).tolist():
        moved = to_film(view, [p + s for p, s in zip(position, step, strict=True)])
        half_u += np.abs(moved[0] - u)
        half_v += np.abs(moved[1] - v)
        seen &= moved[2] > 0
    stretch = (depth + reach) / np.where(seen, depth - reach, 1)
    half_u *= stretch
    half_v *= stretch
    stride, flat = width + 1, silhouette.table.ravel()
    whole = seen
    bounds = []
    for place, half, size in ((u, half_u, width), (v, half_v, height)):
        first = np.floor((place - half) / silhouette.scale)
        last = np.floor((place + half) / silhouette.scale) + 1
        whole = whole & (first >= 0) & (last <= size)
        bounds += [np.where(seen, np.clip(b, 0, size), 0).astype(np.int32) for b in (first, last)]
    left, right, top, bottom = bounds
    area = (right - left) * (bottom - top)
    top *= stride
    bottom *= stride
    opaque = flat[bottom + right] - flat[top + right] - flat[bottom + left] + flat[top + left]
    return whole, opaque, area
