"""Lanes of the compositing kernels: their micro-tiles, their pixels, and iteration over splats.

One SIMD lane is one micro-tile of 4x4 pixels. It iterates over the entries of its tile, front to
back or back to front, and visits those whose bit in its words is set.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar, cast

import drjit as dr
from typing_extensions import override

from drgs.core.arrays import divide, reinterpret, types_of, with_aligned_stack
from drgs.core.private import access_all_lanes
from drgs.core.types import Bool, Float, UInt32
from drgs.splatting.grid import GRID, MICRO, MICROS, PIXELS, TILE, Lanes, TileGrid
from drgs.splatting.tiles import WORD, TileBins

T = TypeVar("T", Float, UInt32)


def make_lanes(
    Float: type, grid: TileGrid, order: UInt32 | None = None, tiles: range | None = None
) -> Lanes:
    """Return lanes in an order that spreads the parts of the image over the launch.

    Dr.Jit splits a small launch into few blocks of consecutive lanes. Groups of neighbouring tiles,
    whose memory is close together, are visited with a stride near the golden section, so that each
    block gets a share of the image's busy centre.

    order: UInt32, a permutation of the lanes; None: unchanged. tiles: range of the tiles of all
    samples; None: all.
    """
    t = types_of(Float)
    tiles = grid.tiles_of(range(grid.samples)) if tiles is None else tiles
    num_groups = len(tiles) // _GROUP  # the tiles beyond them come last
    stride = _coprime_stride(max(num_groups, 1))
    lane = dr.arange(t.UInt32, len(tiles) * MICROS) if order is None else order
    turn, micro = lane // MICROS, lane % MICROS
    group = t.UInt64(turn // _GROUP) * dr.opaque(t.UInt64, stride)
    spread = t.UInt32(group % dr.opaque(t.UInt64, max(num_groups, 1))) * _GROUP + turn % _GROUP
    tile = dr.select(turn < dr.opaque(t.UInt32, num_groups * _GROUP), spread, turn)
    tile += dr.opaque(t.UInt32, tiles.start)
    micro_tile = tile * MICROS + micro
    sample, tile = divide(tile, grid.num_tiles, grid.samples)
    columns = dr.opaque(t.UInt32, grid.columns)
    row = tile // columns
    return Lanes(
        micro_tile=micro_tile,
        micro=micro,
        tile=tile,
        sample=sample,
        x=(tile - row * columns) * TILE + (micro % GRID) * MICRO,
        y=row * TILE + (micro // GRID) * MICRO,
    )


def group_by_work(Float: type, grid: TileGrid, work: UInt32, tiles: range | None = None) -> Lanes:
    """Return lanes sorted, within each block, by their approximate number of splats.

    work: UInt32, the number of splats of each lane of :func:`make_lanes`.
    """
    level = work // 4
    level = dr.select(level < _LEVELS, level, _LEVELS - 1)
    return make_lanes(Float, grid, with_aligned_stack(_sort_in_blocks(level)), tiles)


def _sort_in_blocks(level: UInt32) -> UInt32:
    """Return the lanes ordered by level in each block; the order of equal lanes is arbitrary.

    It only decides which lanes share a vector. (Dr.Jit's sorting functions would synchronise host
    and device.)
    """
    UInt32 = type(level)
    lane = dr.arange(UInt32, dr.width(level))
    bucket = lane // _BLOCK * _LEVELS + level
    counts = dr.zeros(UInt32, -(-dr.width(level) // _BLOCK) * _LEVELS)
    dr.scatter_add(counts, UInt32(1), bucket, mode=dr.ReduceMode.Direct)
    dr.eval(bucket)
    place = dr.scatter_inc(dr.prefix_sum(counts), bucket)
    order = dr.empty(UInt32, dr.width(level))
    dr.scatter(order, lane, place)
    dr.eval(order)
    return order


_GROUP = 8
"""Tiles that stay together in the launch: with more, its parts take longer than others; with fewer,
memory is further apart."""

_BLOCK = 32 * MICROS
"""Number of lanes that are sorted together. In larger blocks, the lanes of a tile, which read the
same records, are too far apart; in smaller ones, lengths differ more."""

_LEVELS = 256


def _coprime_stride(count: int) -> int:
    stride = max(1, round(count * (math.sqrt(5) - 1) / 2))
    while math.gcd(stride, count) != 1:
        stride += 1
    return stride


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
        """The current sorted entry, and whether there is one (a word may be empty).

        Where there is none, it is one of the entries of the cursor's group.
        """
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
    _, count = dr.while_loop(
        state=(UInt32(entries.first), dr.zeros(UInt32, dr.width(entries.first))),
        cond=lambda group, count: group <= entries.last,
        body=body,
    )
    return count


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


def load_pixels(plane: Float, lanes: Lanes, grid: TileGrid) -> list[Float]:
    """The 16 values of a row-major plane of all samples in each micro-tile; 0 off the film."""
    return [
        dr.gather(type(plane), plane, index, inside) for index, inside in pixels_of(lanes, grid)
    ]


def pixels_of(lanes: Lanes, grid: TileGrid) -> list[tuple[UInt32, Bool]]:
    """Return row-major index and on-film mask of the 16 pixels of each micro-tile.

    The index is that in a plane of all samples.
    """
    UInt32 = type(lanes.x)
    width, height = dr.opaque(UInt32, grid.width), dr.opaque(UInt32, grid.height)
    first_row, pixels = lanes.sample * height, []
    for pixel in range(PIXELS):
        row, column = divmod(pixel, MICRO)
        x, y = lanes.x + column, lanes.y + row
        pixels.append(((first_row + y) * width + x, (x < width) & (y < height)))
    return pixels


def load_lane_row(values: T, micro_tile: UInt32, planes: int) -> list[T]:
    """The first 16 values of each micro-tile's row of ``planes`` x 16."""
    first = micro_tile * (planes * PIXELS)
    return [dr.gather(type(values), values, first + k) for k in range(PIXELS)]
