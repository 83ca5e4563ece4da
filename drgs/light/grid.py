"""Nested grids of cells with lists of Gaussians, for the peaks along a ray.

A cube around most of the Gaussians is cut into R^3 cells, as are cubes of twice the width around
it, until all Gaussians are inside. A point belongs to the cell of the smallest cube that it is in.
Each cell has a list of the Gaussians that reach into it. A ray meets a Gaussian at one point, the
peak, and finds it once, in the list of that point's cell; Gaussians of later cells are behind it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import drjit as dr
import numpy as np

from drgs.core.arrays import from_host, reinterpret, types_of
from drgs.core.types import Array3f, Array3u, Bool, Float, UInt32
from drgs.splatting.tiles import lower_bounds

CELLS_PER_GAUSSIAN = 2.0  # of the innermost cube; more shorten lists and lengthen the walk
RESOLUTION_RANGE = (8, 128)  # cells along an edge, multiples of 4: the middle half is finer
INNER_CUBE_SHARE = 0.9  # share of the means in the innermost cube
MAX_LEVELS = 24  # most cubes; Gaussians beyond 2^23 times the innermost one's size are in no list
MAX_ENTRIES_PER_GAUSSIAN = 32  # besides FREE_ENTRIES; cells grow until there are no more

FREE_ENTRIES = 1 << 20

CELL_MARGIN = 1 / 64  # cells by which Gaussians are extended: far more than rounding and CELL_STEP
CELL_STEP = 1 / 1024  # step in cells after which a ray looks up its cell


@dataclass(frozen=True)
class Ellipsoids:
    """The ellipsoids at which N Gaussians end."""

    centers: Array3f  # world
    axes: list[Array3f]  # three, world: principal half axes
    exist: Bool

    def half_sizes(self) -> Array3f:
        """Return half the sizes of the boxes around them."""
        return dr.sqrt(sum((dr.square(axis) for axis in self.axes[1:]), dr.square(self.axes[0])))


@dataclass(frozen=True)
class SplatGrid:
    """Lists of Gaussians by cell."""

    center: Array3f  # (1,), world
    size: Float  # (1,): half the innermost cube's edge, world units
    num_levels: UInt32  # (1,)
    resolution: UInt32  # (1,): R
    cells: UInt32  # (2 cells,): number of entries, the first one; if empty, 0, cells to skip
    rows: UInt32  # (entries,): Gaussians

    def span(self, origin: Array3f, direction: Array3f) -> tuple[Float, Float]:
        """Return where rays enter and leave the outermost cube; for misses, enter > leave."""
        Float = type(self.size)
        reach = self.size * dr.exp2(Float(self.num_levels) - 1)  # half the outermost cube's edge
        first, last = Float(-dr.inf), Float(dr.inf)
        for o, d, c in zip(origin, direction, self.center, strict=True):
            inverse = 1 / d
            a, b = (c - reach - o) * inverse, (c + reach - o) * inverse
            # Parallel to a side and on it: 0 / 0 is NaN, and no bound.
            low, high = dr.select(a < b, a, b), dr.select(a < b, b, a)
            first = dr.select(low > first, low, first)
            last = dr.select(high < last, high, last)
        return first, last

    def cell(self, origin: Array3f, direction: Array3f, t: Float) -> tuple[UInt32, UInt32, Float]:
        """Return the first entry and the end of the list of the cell that rays enter at t.

        Also return where they leave it, and empty cells around it; at least a step ahead.
        """
        t_ = types_of(type(self.size))
        count = t_.Float(self.resolution)
        distance = self._distance(origin + direction * t)
        step = CELL_STEP * (self.size * dr.select(distance > 1, distance, 1) * 2 / count)
        rounding = 4 * dr.epsilon(t) * t  # for rays from far away
        ahead = t + dr.select(step > rounding, step, rounding)
        point = origin + direction * ahead
        level, edges = self._cube(self._distance(point))
        half = self.size * edges
        index, places = level, []
        for k in (2, 1, 0):
            place = dr.floor((point[k] - self.center[k] + half) / half * (0.5 * count))
            place = dr.select(place > 0, place, 0)
            place = dr.select(place < count, place, count - 1)
            index = index * self.resolution + t_.UInt32(place)
            places.insert(0, place)
        number, first = dr.gather(t_.Array2u, self.cells, index)
        # An empty cell: the number of cells to the next list, in any direction.
        free = t_.Float(dr.select(number == 0, first, 1))
        leaves = t_.Float(dr.inf)
        for k, place in enumerate(places):
            side = dr.select(direction[k] > 0, place + free, place + 1 - free)
            side = dr.select(side > 0, dr.select(side < count, side, count), 0)
            until = ((side * (2 / count) - 1) * half + (self.center[k] - origin[k])) / direction[k]
            leaves = dr.select(until < leaves, until, leaves)
        return first, first + number, dr.select(leaves > ahead, leaves, ahead)

    def _cube(self, distance: Float) -> tuple[UInt32, Float]:
        """Return the number of the smallest cube around a point, and its size in innermost ones."""
        Single = cast(type[Float], dr.float32_array_t(type(distance)))
        UInt32 = types_of(Single).UInt32
        # A number from 2^k to 2^(k + 1) has k + 127 above its 23 bits of mantissa.
        exponent = reinterpret(UInt32, Single(distance)) >> 23
        level = dr.select(exponent > 126, exponent - 126, 0)
        level = dr.select(level < self.num_levels, level, self.num_levels - 1)
        return level, type(distance)(reinterpret(Single, (level + 127) << 23))

    def _distance(self, point: Array3f) -> Float:
        """Return the maximum-norm distance from the centre, in half edges of the innermost cube."""
        return dr.max(dr.abs(point - self.center)) / self.size


def build_grid(ellipsoids: Ellipsoids) -> SplatGrid:
    """Build the lists of all cells. The host waits for the device."""
    shown = np.array(ellipsoids.exist)
    centers = np.array(ellipsoids.centers, np.float64)[:, shown]
    sizes = np.array(ellipsoids.half_sizes(), np.float64)[:, shown]
    center = np.median(centers, axis=1) if shown.any() else np.zeros(3)
    distances = np.abs(centers - center[:, None]).max(axis=0)
    # Equal or few centres: no cell is much smaller than its Gaussians.
    spreads = np.stack([distances, sizes.max(axis=0)])
    size = np.quantile(spreads, INNER_CUBE_SHARE, axis=1).max() if shown.any() else 1.0
    farthest = (np.abs(centers - center[:, None]) + sizes).max(initial=0.0)
    size = max(size, farthest / 2 ** (MAX_LEVELS - 1), np.finfo(np.float32).tiny)
    # Two cells on either side of a cube with all Gaussians are empty.
    levels = max(1, 1 + int(np.ceil(np.log2(max(1.05 * farthest / size, 1)))))
    least, most = RESOLUTION_RANGE
    wanted = (CELLS_PER_GAUSSIAN * max(1, shown.sum())) ** (1 / 3)
    resolution = 4 * int(np.clip(round(wanted / 4), least // 4, most // 4))
    affordable = MAX_ENTRIES_PER_GAUSSIAN * len(shown) + FREE_ENTRIES
    boxes = _Boxes(ellipsoids, center, size)
    while (
        resolution > least
        and sum(boxes.count(level, resolution) for level in range(levels)) > affordable
    ):
        resolution -= 4
    return boxes.grid(levels, resolution)


@dataclass(frozen=True)
class _Boxes:
    """Boxes around ellipsoids, and their entries in cells."""

    ellipsoids: Ellipsoids
    center: np.ndarray
    size: float

    def count(self, level: int, resolution: int) -> int:
        """Count the cells of a level in boxes around the ellipsoids."""
        return int(np.array(dr.prod(self._ranges(level, resolution)[1])).sum(dtype=np.int64))

    def grid(self, levels: int, resolution: int) -> SplatGrid:
        """Sort the entries by cell, and within a cell by Gaussian."""
        t = types_of(type(self.ellipsoids.centers.x))
        Float = t.Float
        # Dr.Jit does not compute with empty arrays, and a level may have no entries.
        made = [self._entries(level, resolution) for level in range(levels)]
        made = [each for each in made if dr.width(each[0]) > 0]
        num_cells = levels * resolution**3
        if made:
            rows, cells = (dr.concat([each[k] for each in made]) for k in (0, 1))
            order = dr.argsort(cells)
            rows, cells = (dr.gather(t.UInt32, column, order) for column in (rows, cells))
            starts = np.array(lower_bounds(cells, dr.width(rows), num_cells)).astype(np.int64)
        else:
            rows, starts = dr.zeros(t.UInt32, 1), np.zeros(num_cells + 1, np.int64)
        center = t.Array3f(*(dr.opaque(Float, float(c)) for c in self.center))
        size = dr.opaque(Float, float(self.size))
        num_levels, edge = (dr.opaque(t.UInt32, number) for number in (levels, resolution))
        lists = from_host(t.UInt32, _cells(starts, levels, resolution))
        grid = SplatGrid(center, size, num_levels, edge, lists, rows)
        dr.eval(grid)
        return grid

    def _ranges(self, level: int, resolution: int) -> tuple[Array3u, Array3u]:
        """Return first cell and number of cells along each axis, of boxes around the ellipsoids."""
        Float = type(self.ellipsoids.centers.x)
        t = types_of(Float)
        half = dr.opaque(Float, float(self.size * 2.0**level))
        count = dr.opaque(Float, resolution)
        sizes = self.ellipsoids.half_sizes()
        first, number = [], []
        for k in range(3):
            offset = self.ellipsoids.centers[k] - dr.opaque(Float, float(self.center[k]))
            low, high = (
                dr.floor(
                    (offset + sign * sizes[k] + half) / half * (0.5 * count) + sign * CELL_MARGIN
                )
                for sign in (-1, 1)
            )
            misses = ~((high >= 0) & (low < count)) | ~self.ellipsoids.exist
            low = dr.select(low > 0, low, 0)
            high = dr.select(high < count - 1, high, count - 1)
            first.append(t.UInt32(dr.select(misses, 0, low)))
            number.append(t.UInt32(dr.select(misses, 0, high - low + 1)))
        triple = cast(type[Array3u], dr.uint32_array_t(t.Array3f))
        return triple(first), triple(number)

    def _entries(self, level: int, resolution: int) -> tuple[UInt32, UInt32]:
        """Return rows and cells of a level's entries, in the order of the rows."""
        t = types_of(type(self.ellipsoids.centers.x))
        first, number = self._ranges(level, resolution)
        row, local = _expand(dr.prod(number))
        if dr.width(row) == 0:
            return t.UInt32(), t.UInt32()
        nx, ny = (dr.gather(t.UInt32, number[k], row) for k in (0, 1))
        # Exact in double precision; an integer division has no vector instruction.
        double = cast(type[Float], dr.float64_array_t(t.UInt32))
        line = t.UInt32((double(local) + 0.5) / nx)
        layer = t.UInt32((double(line) + 0.5) / ny)
        place = (local - line * nx, line - layer * ny, layer)
        place = [dr.gather(t.UInt32, first[k], row) + p for k, p in enumerate(place)]
        keep = self._touches(place, row, level, resolution)
        if level > 0:
            within = [(p >= resolution // 4) & (p < 3 * resolution // 4) for p in place]
            keep &= ~(within[0] & within[1] & within[2])
        cell = t.UInt32(level)
        for p in reversed(place):
            cell = cell * resolution + p
        kept = t.UInt32(dr.compress(keep))
        return dr.gather(t.UInt32, row, kept), dr.gather(t.UInt32, cell, kept)

    def _touches(self, place: list[UInt32], row: UInt32, level: int, resolution: int) -> Bool:
        """Return whether no principal axis of an ellipsoid separates it from a cell."""
        Float = type(self.ellipsoids.centers.x)
        t = types_of(Float)
        cell = dr.opaque(Float, float(self.size * 2.0 ** (level + 1) / resolution))
        middle = t.Array3f([t.Float(p) + 0.5 - resolution / 2 for p in place]) * cell
        middle += t.Array3f(*(dr.opaque(Float, float(c)) for c in self.center))
        offset = middle - dr.gather(t.Array3f, self.ellipsoids.centers, row)
        touches = t.Bool(True)
        for axis in self.ellipsoids.axes:
            direction = dr.gather(t.Array3f, axis, row)
            # Extents of the cell and the ellipsoid along the axis, times its length.
            of_cell = dr.sum(dr.abs(direction)) * cell * (0.5 + CELL_MARGIN)
            distance = dr.abs(dr.dot(direction, offset))
            touches &= distance <= of_cell + dr.squared_norm(direction)
        return touches


def _expand(counts: UInt32) -> tuple[UInt32, UInt32]:
    """Return the row of each of ``counts[row]`` items, and the item's number in it."""
    UInt32 = type(counts)
    size = dr.width(counts)
    row = dr.arange(UInt32, size)
    ends = dr.cumsum(counts)
    total = int(ends[size - 1])
    if total == 0:
        return UInt32(), UInt32()
    starts = ends - counts
    marks = dr.zeros(UInt32, total)
    dr.scatter(marks, row, starts, counts > 0)
    rows = dr.prefix_reduce(dr.ReduceOp.Max, marks, exclusive=False)
    return rows, dr.arange(UInt32, total) - dr.gather(UInt32, starts, rows)


def _cells(starts: np.ndarray, levels: int, resolution: int) -> np.ndarray:
    """Return :attr:`SplatGrid.cells`; starts: (cells + 1,) first entries."""
    from scipy.ndimage import distance_transform_cdt

    shape = (levels, *(resolution,) * 3)
    number, first = np.diff(starts).reshape(shape), starts[:-1].reshape(shape).copy()
    middle = slice(resolution // 4, 3 * resolution // 4)
    for level in range(levels):
        occupied = number[level] > 0
        if level > 0:
            occupied[middle, middle, middle] = True  # by finer cells
        distance = np.asarray(distance_transform_cdt(~occupied, metric="chessboard"))
        distance[distance < 0] = resolution  # there is nothing at all
        empty = number[level] == 0
        first[level][empty] = np.maximum(distance[empty], 1)
    return np.stack([number.ravel(), first.ravel()], axis=1)
