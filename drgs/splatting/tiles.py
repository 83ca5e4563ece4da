"""Binning: lists of the splats that touch each tile, front to back, and iteration over them.

The second stage: ``Splats2D`` -> ``SplatTable`` -> ``TileBins``. The image is divided into tiles of
16x16 pixels, each a 4x4 grid of micro-tiles of 4x4 pixels. Every (splat, tile) pair of a splat's
bounding box is one *entry*, with a mask of 16 bits for the micro-tiles that its ellipse touches. No
lane loops over a splat's tiles, so a giant splat does not delay its neighbours, and the host reads
one value, the number of entries.

1. Store each splat's numbers as a row and count the tiles of its bounding box.
2. Sort the splats by depth; a prefix sum gives each one its range of entries.
3. For each entry: its tile, and the exact ellipse-rectangle test of its micro-tiles.
4. Stable sort of the entries by tile; within a tile they remain front to back.
5. Transpose the bits: for each group of 32 entries and each micro-tile one 32-bit word, so that
   compositing finds a micro-tile's next splat as the lowest bit.

A lane of compositing iterates over the :class:`Entries` of its tile, front to back or back to
front, and visits those whose bit in its words is set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import drjit as dr
from typing_extensions import override

from drgs.cameras.lens import shortest
from drgs.core.arrays import Rows, interleave, reinterpret, types_of
from drgs.core.private import access_all_lanes, bucket_order
from drgs.core.types import Bool, Float, UInt32
from drgs.splatting.footprint import DEFAULT, ImageModel
from drgs.splatting.grid import GRID, MICRO, MICROS, TILE, Lanes, TileGrid
from drgs.splatting.projection import Splats2D

WORD = 32  # entries in a word of the transposed masks


@dataclass(frozen=True)
class TileBins:
    """Entries sorted by tile, then by depth.

    M entries of N splats are *unsorted* in the order of the Gaussians, *sorted* in that of the
    tiles. Sorted arrays are padded to a multiple of 32 with entries that touch no micro-tile.
    """

    rows: Rows  # by Gaussian: geometry, features, keys
    num_features: int
    num_keys: int
    first_entry: UInt32  # (N + 1,): Gaussian -> first of its run of unsorted entries
    order: UInt32  # (N,): Gaussians by depth
    source: UInt32  # (M padded,): sorted -> unsorted
    splats: UInt32  # (M padded,): sorted -> Gaussian
    tiles: UInt32  # (M padded,): sorted -> tile
    masks: UInt32  # (M padded,): sorted -> bit per micro-tile that the splat touches
    words: UInt32  # (M padded / 32 * 16,): (group of 32, micro-tile) -> bit per entry
    tile_start: UInt32  # (tiles + 1,): tile -> first sorted entry
    num_entries: int  # M
    grid: TileGrid
    model: ImageModel

    @property
    def num_splats(self) -> int:
        """N, number of Gaussians."""
        return dr.width(self.first_entry) - 1

    @property
    def num_sums(self) -> int:
        """Number of sums of the adjoint for each splat: moments, and derivatives of features."""
        return self.model.falloff.num_moments + self.num_features


@dataclass(frozen=True)
class SplatTable:
    """The stored inputs of binning and compositing: a row per splat.

    Concatenated rows of several objects are binned as if they had been projected together, because
    a row depends on its own splat only.
    """

    boxes: Rows  # first column and row of tiles, columns, number of tiles
    rows: Rows  # geometry, features, keys
    depths: Float  # (N,), to sort by; inf: not visible
    num_features: int
    num_keys: int


def splat_table(
    splats: Splats2D,
    grid: TileGrid,
    features: Sequence[Float] = (),
    model: ImageModel = DEFAULT,
    keys: Sequence[Float] = (),
) -> SplatTable:
    """Store ``splats`` for binning, evaluated.

    features: columns, Float (N,) each, to composite; keys: further columns, for the order. Neither
    they nor the splats need to be evaluated: the kernel that computes them stores the rows.
    """
    geometry = model.falloff.geometry(splats)
    boxes = Rows.from_columns(_tile_box(splats, geometry, grid, model))
    rows = Rows.from_columns([*geometry, *features, *keys])
    depths = dr.select(splats.visible, splats.depths, dr.inf)
    dr.eval(boxes, rows, depths)
    boxes, rows = (each.first(dr.width(depths)) for each in (boxes, rows))
    return SplatTable(boxes, rows, depths, len(features), len(keys))


def bin_splats(table: SplatTable, grid: TileGrid, model: ImageModel) -> TileBins:
    """Distribute splats over the tiles of ``grid``, front to back.

    Not differentiated. The host reads one value, the number of entries.
    """
    boxes, rows, depths = table.boxes, table.rows, table.depths
    num_features, num_keys = table.num_features, table.num_keys
    del table  # releases its arrays before the function ends
    t = types_of(type(depths))
    num_splats = dr.width(depths)
    splat = dr.arange(t.UInt32, num_splats + 1)
    counts = t.UInt32(boxes.load(splat, splat < dr.opaque(t.UInt32, num_splats))[-1])
    first_entry = dr.prefix_sum(counts)
    del counts
    num_entries = int(first_entry[num_splats])  # before sorting, which waits for the device, too
    # A stable sort: equal depths stay in the order of the Gaussians.
    order = t.UInt32(dr.argsort(depths))
    # In a separate kernel: loads without arithmetic overlap their latencies.
    ordered = boxes.load(order)
    by_depth = _ByDepth(
        order,
        dr.gather(t.UInt32, first_entry, order),
        t.UInt32(ordered[-1]),
        Rows.from_columns(ordered),
        Rows.from_columns(rows.load(order)[: model.falloff.num_geometry]),
    )
    dr.eval(by_depth)
    tiles, entries = _make_entries(by_depth, num_entries, grid, model)
    by_tile = stable_order(tiles, grid.num_tiles)
    source, splats, tiles, masks = dr.gather(t.Array4u, entries, by_tile)
    dr.eval(source, splats, tiles, masks)
    # They would wait in memory for the end of the function.
    del by_depth, entries, by_tile
    words = transpose_masks(masks)
    tile_start = lower_bounds(tiles, num_entries, grid.num_tiles)
    dr.eval(words, tile_start)
    return TileBins(
        rows=rows,
        num_features=num_features,
        num_keys=num_keys,
        first_entry=first_entry,
        order=order,
        source=source,
        splats=splats,
        tiles=tiles,
        masks=masks,
        words=words,
        tile_start=tile_start,
        num_entries=num_entries,
        grid=grid,
        model=model,
    )


def _reach(geometry: list[Float], grid: TileGrid, model: ImageModel) -> Float:
    """Return |U d|^2 (base 2) at which a splat ends, with a margin for rounding.

    For the default cut-offs, sqrt(2 ln(opacity / alpha_cut)) standard deviations: the
    opacity-aware radius, instead of 3.
    """
    t = types_of(type(geometry[0]))
    floor = model.falloff.log2_floor(geometry, model.cutoffs)
    return model.falloff.log2_opacity(geometry) - floor + dr.opaque(t.Float, grid.cull_margin)


def _tile_box(
    splats: Splats2D, geometry: list[Float], grid: TileGrid, model: ImageModel
) -> list[Float]:
    """Return first column and row, columns, and number of tiles: integers, exact up to 2^24."""
    t = types_of(type(splats.depths))
    center, radius = model.falloff.bounds(splats, geometry, _reach(geometry, grid, model))
    radius = radius + model.positions.margin
    size = t.Array2f(dr.opaque(t.Float, grid.width), dr.opaque(t.Float, grid.height))
    # The first and last pixel whose centre lies within the radius, clamped to the film while
    # still in floating point: a splat may be arbitrarily far away.
    first = dr.ceil(center - radius - 0.5)
    last = dr.floor(center + radius - 0.5)
    # Columns of tiles go on behind the last one, if the film is a whole turn.
    more: Float | float = 0
    if model.period is not None:
        first.x, last.x, more = _wrap_columns(first.x, last.x, model.period, grid)
    first = dr.select(first < 0, 0, first)
    last = dr.select(last > size - 1, size - 1, last)
    visible = splats.visible & ((first.x <= last.x) | (more > 0)) & (first.y <= last.y)

    Pixel = dr.uint32_array_t(type(first))
    first_tile = Pixel(dr.select(visible, first, 0)) // TILE
    extent = Pixel(dr.select(visible, last, 0)) // TILE - first_tile + 1
    if model.period is not None:
        extent.x = dr.minimum(extent.x + t.UInt32(more), dr.opaque(t.UInt32, grid.columns))
    count = dr.select(visible, extent.x * extent.y, 0)
    return [t.Float(number) for number in (*first_tile, extent.x, count)]


def _wrap_columns(
    first: Float, last: Float, period: Float, grid: TileGrid
) -> tuple[Float, Float, Float]:
    """Return the first and the last pixel column of a splat on a film that is a whole turn.

    And the columns of tiles to add to those between the two, if the last is left of the first: all.
    """
    width = dr.opaque(type(first), grid.width)
    length = last - first
    first = dr.fma(-period, dr.floor(first / period), first)
    last = first + length
    hidden = first >= width  # it begins beside a crop window
    first, last = dr.select(hidden, 0, first), dr.select(hidden, last - period, last)
    crosses = last >= period
    last = dr.select(crosses, last - period, last)
    everywhere = ~(length < period)
    first, last = dr.select(everywhere, 0, first), dr.select(everywhere, width, last)
    return first, last, dr.select(crosses & ~everywhere, type(first)(grid.columns), 0)


@dataclass(frozen=True)
class _ByDepth:
    """Splats sorted by depth."""

    splats: UInt32  # numbers
    first_entries: UInt32  # unsorted
    counts: UInt32  # of entries
    boxes: Rows
    geometry: Rows


def _make_entries(
    splats: _ByDepth, count: int, grid: TileGrid, model: ImageModel
) -> tuple[UInt32, UInt32]:
    """Return entries sorted by depth: their tiles, and rows (unsorted entry, splat, tile, mask).

    count: of entries. Padding entries are in the last tile and touch nothing: a stable sort leaves
    them at the end.
    """
    t = types_of(splats.geometry.Float)
    # Rank of each entry: write each rank at the start of its run, then a running maximum.
    padded = -(-max(count, 1) // WORD) * WORD
    first, runs = dr.prefix_sum(splats.counts), dr.zeros(t.UInt32, padded)
    dr.scatter(runs, dr.arange(t.UInt32, dr.width(first)), first, splats.counts > 0)
    rank = dr.prefix_reduce(dr.ReduceOp.Max, runs, exclusive=False)

    place = dr.arange(t.UInt32, padded)
    exists = place < dr.opaque(t.UInt32, count)
    with access_all_lanes(t.Float):  # there are whole vectors
        local = place - dr.gather(t.UInt32, first, rank)
        splat = dr.gather(t.UInt32, splats.splats, rank)
        entry = dr.gather(t.UInt32, splats.first_entries, rank) + local
        tile_x, tile_y, columns = (t.UInt32(number) for number in splats.boxes.load(rank)[:3])
        geometry = splats.geometry.load(rank)
    # Exact while a splat covers fewer than 2^22 tiles; an integer division by a varying number
    # has no vector instruction.
    row = t.UInt32((t.Float(local) + 0.5) / t.Float(columns))
    tile_x = tile_x + (local - row * columns)
    if model.period is not None:
        columns = dr.opaque(t.UInt32, grid.columns)
        tile_x = dr.select(tile_x >= columns, tile_x - columns, tile_x)
    tile_y = tile_y + row
    tile = dr.fma(tile_y, dr.opaque(t.UInt32, grid.columns), tile_x)
    mask = _touched_micros(geometry, tile_x, tile_y, grid, model)
    tile = dr.select(exists, tile, dr.opaque(t.UInt32, grid.num_tiles - 1))
    entry, mask = dr.select(exists, entry, place), dr.select(exists, mask, 0)
    with access_all_lanes(t.Float):
        entries = interleave([entry, splat, tile, mask])
    dr.eval(tile, entries)
    return tile, entries


def stable_order(keys: UInt32, bound: int) -> UInt32:
    """Return the stable order of ``keys`` below ``bound``, in one pass with a bucket for each key.

    ``dr.argsort`` has no bound and needs three passes for 32 bits.
    """
    return bucket_order(keys, dr.width(keys), max(1 << (bound - 1).bit_length(), 2))


def _touched_micros(
    geometry: list[Float], tile_x: UInt32, tile_y: UInt32, grid: TileGrid, model: ImageModel
) -> UInt32:
    """Return a mask: bit m is set if the ellipse alpha >= cut reaches a pixel of micro-tile m.

    |U d|^2 is convex, so its minimum over a rectangle that does not contain the mean lies on
    one of the (at most two) sides that face the mean: for such a side, one coordinate is given
    and the best other coordinate is clamped to the rectangle.
    """
    reach = _reach(geometry, grid, model)
    mean_x, mean_y, p, r, s = model.falloff.outline(geometry, reach)
    t = types_of(type(mean_x))
    margin = model.positions.margin
    dx_per_dy = -r / p
    dy_per_dx = -(p * r) / dr.fma(r, r, s * s)

    size = MICRO - 1 + 2 * margin

    def intervals(tile: UInt32, mean: Float, period: Float | None) -> list[tuple[Float, Float]]:
        first = dr.fma(t.Float(tile), TILE, 0.5 - margin) - mean
        if period is None:
            return [(first + MICRO * k, first + (MICRO * k + size)) for k in range(GRID)]
        middles = [shortest(first + (MICRO * k + size / 2), period) for k in range(GRID)]
        return [(middle - size / 2, middle + size / 2) for middle in middles]

    def exponent(dx: Float, dy: Float) -> Float:
        u = dr.fma(p, dx, r * dy)
        v = s * dy
        return dr.fma(u, u, v * v)

    columns, rows = intervals(tile_x, mean_x, model.period), intervals(tile_y, mean_y, None)
    nearest_dx = [_clamp(t.Float(0), lo, hi) for lo, hi in columns]
    nearest_dy = [_clamp(t.Float(0), lo, hi) for lo, hi in rows]
    mask = t.UInt32(0)
    for j, (y_range, dy) in enumerate(zip(rows, nearest_dy, strict=True)):
        for i, (x_range, dx) in enumerate(zip(columns, nearest_dx, strict=True)):
            facing_x = exponent(dx, _clamp(dy_per_dx * dx, *y_range))
            facing_y = exponent(_clamp(dx_per_dy * dy, *x_range), dy)
            touched = (facing_x <= reach) | (facing_y <= reach)
            if model.period is not None:  # pixels on both sides of the point opposite of the mean
                touched |= dr.maximum(dr.abs(x_range[0]), dr.abs(x_range[1])) > model.period / 2
            mask |= dr.select(touched, t.UInt32(1 << (j * GRID + i)), 0)
    return mask


def _clamp(x: Float, lo: Float, hi: Float) -> Float:
    """Clamp in two vector instructions, unlike dr.clip; a NaN becomes ``lo`` or stays NaN."""
    x = dr.select(x < lo, lo, x)
    return dr.select(x > hi, hi, x)


def transpose_masks(masks: UInt32) -> UInt32:
    """Transpose 16 bits per entry to 32 bits per (group of 32 entries, micro-tile).

    Two 16x16 bit matrices side by side in each word, transposed by exchanging ever smaller
    blocks (Warren, "Hacker's Delight", 2nd ed., section 7-3).
    """
    UInt32 = type(masks)
    Array4u = types_of(UInt32).Array4u
    group = dr.arange(UInt32, dr.width(masks) // WORD)
    packets = WORD // 4
    m = [v for k in range(packets) for v in dr.gather(Array4u, masks, group * packets + k)]
    m = [m[k] | (m[k + MICROS] << MICROS) for k in range(MICROS)]
    for step, keep in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        for k in range(MICROS):
            if not k & step:
                swap = ((m[k] >> step) ^ m[k + step]) & keep
                m[k + step] ^= swap
                m[k] ^= swap << step
    return interleave(m)


def lower_bounds(sorted_tiles: UInt32, num_entries: int, num_tiles: int) -> UInt32:
    """Return the first sorted position of each tile, (num_tiles + 1,), by binary search."""
    UInt32 = type(sorted_tiles)
    tile = dr.arange(UInt32, num_tiles + 1)

    def body(first: UInt32, last: UInt32) -> tuple[UInt32, UInt32]:
        middle = (first + last) >> 1
        smaller = dr.gather(UInt32, sorted_tiles, middle) < tile
        return dr.select(smaller, middle + 1, first), dr.select(smaller, last, middle)

    bounds = dr.zeros(UInt32, num_tiles + 1), dr.opaque(UInt32, num_entries, num_tiles + 1)
    return dr.while_loop(bounds, lambda first, last: first < last, body, ("first", "last"))[0]


@dataclass
class Cursor:
    """A place among the set bits of a micro-tile's words: the splats that touch it.

    Not frozen: Dr.Jit assigns the fields of a loop's state.
    """

    word: UInt32  # bits of the current group that are still to come
    group: UInt32  # index of the current group of 32 entries


class Entries:
    """The entries [start, end) of each lane's tile that touch its micro-tile, front to back."""

    def __init__(self, bins: TileBins, lanes: Lanes, end: UInt32) -> None:
        UInt32 = type(lanes.tile)
        self.words, self.micro, self.sample = bins.words, lanes.micro, lanes.sample
        start = dr.gather(UInt32, bins.tile_start, lanes.tile)
        occupied = start < end
        # An empty lane gets first == last and no bits: it is over before it begins.
        self.first = dr.select(occupied, start // WORD, 0)
        self.last = dr.select(occupied, (end - 1) // WORD, 0)
        ones = UInt32(0xFFFFFFFF)
        self.head = dr.select(occupied, ones << (start % WORD), 0)
        self.tail = dr.select(occupied, ones >> (WORD - 1 - (end - 1) % WORD), 0)

    def begin(self) -> Cursor:
        """The cursor at the first entry."""
        return self._open(self.first)

    def pending(self, cursor: Cursor) -> Bool:
        """Return lanes that may have entries left."""
        return (cursor.word != 0) | (cursor.group < self.last)

    @staticmethod
    def current(cursor: Cursor) -> tuple[UInt32, Bool]:
        """The current sorted entry, and whether there is one; else it is any of its group."""
        return cursor.group * WORD + find_lowest_bit(cursor.word), cursor.word != 0

    def advance(self, cursor: Cursor) -> Cursor:
        """Drop the current entry; open the next group when this one is used up."""
        word = cursor.word & (cursor.word - 1)
        return self._go_on(cursor, word, cursor.group + 1, cursor.group < self.last)

    def _go_on(self, cursor: Cursor, word: UInt32, neighbor: UInt32, has_neighbor: Bool) -> Cursor:
        used_up = (word == 0) & has_neighbor
        with access_all_lanes(type(word)):  # every lane has a group
            opened = self._open(dr.select(used_up, neighbor, cursor.group))
        return Cursor(word=dr.select(used_up, opened.word, word), group=opened.group)

    def _open(self, group: UInt32) -> Cursor:
        t = types_of(type(group))
        pair = dr.gather(t.Array2u, self.words, group * (MICROS // 2) + self.micro // 2)
        word = dr.select((self.micro & 1) != 0, pair[1], pair[0])
        word &= dr.select(group == self.first, self.head, 0xFFFFFFFF)
        word &= dr.select(group == self.last, self.tail, 0xFFFFFFFF)
        return Cursor(word=word, group=group)


class EntriesBackToFront(Entries):
    """The same entries in the opposite order."""

    @override
    def begin(self) -> Cursor:
        """The cursor at the last entry."""
        return self._open(self.last)

    @override
    def pending(self, cursor: Cursor) -> Bool:
        return (cursor.word != 0) | (cursor.group > self.first)

    @staticmethod
    @override
    def current(cursor: Cursor) -> tuple[UInt32, Bool]:
        return cursor.group * WORD + _find_highest_bit(cursor.word), cursor.word != 0

    @override
    def advance(self, cursor: Cursor) -> Cursor:
        """Drop the current entry; open the group before when this one is used up."""
        word = cursor.word & ~(type(cursor.word)(1) << _find_highest_bit(cursor.word))
        return self._go_on(cursor, word, cursor.group - 1, cursor.group > self.first)


def count_entries(entries: Entries) -> UInt32:
    """Count the entries of each lane."""

    def body(group: UInt32, count: UInt32) -> tuple[UInt32, UInt32]:
        return group + 1, count + dr.popcnt(entries._open(group).word)

    UInt32 = type(entries.first)
    state = UInt32(entries.first), dr.zeros(UInt32, dr.width(entries.first))
    return dr.while_loop(state, lambda group, count: group <= entries.last, body)[1]


def find_lowest_bit(word: UInt32) -> UInt32:
    """Return the index of the lowest bit that is set, by the exponent of a floating point number.

    AVX2 has no instruction for it. Of no bit: 1.
    """
    return _exponent(_to_float(word & (0 - word))) & (WORD - 1)


def _find_highest_bit(word: UInt32) -> UInt32:
    """Return the index of the highest bit that is set; of no bit: 0."""
    # The bit below the highest one is removed, or the conversion could round up to the next power.
    return _exponent(_to_float((word & ~(word >> 1)) >> 1) + 0.5) + 1


def _to_float(word: UInt32) -> Float:
    Float32 = cast("type[Float]", dr.float32_array_t(type(word)))
    return Float32(reinterpret(dr.int32_array_t(type(word)), word))


def _exponent(value: Float) -> UInt32:
    """Return the exponent; of negative numbers, 32 is to be divided out."""
    return (reinterpret(dr.uint32_array_t(type(value)), value) >> 23) - 127
