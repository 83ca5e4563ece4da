"""Tiles of the film, their micro-tiles, and the lanes of kernels: one lane per micro-tile."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import count
from typing import TypeVar

import drjit as dr

from drgs.core.arrays import divide, types_of, with_aligned_stack
from drgs.core.constants import CULL_MARGIN, CULL_MARGIN_PER_PX
from drgs.core.types import Bool, Float, UInt32

T = TypeVar("T", Float, UInt32)

MICRO = 4  # pixels on the side of a micro-tile, one SIMD lane of the compositing kernels
PIXELS = MICRO * MICRO  # pixels of a micro-tile
GRID = 4  # micro-tiles on a tile's side
TILE = MICRO * GRID  # pixels on a tile's side
MICROS = GRID * GRID  # micro-tiles in a tile: the bits of an entry's mask


@dataclass(frozen=True)
class TileGrid:
    """The tiles of a film of ``width`` x ``height`` px, in rows from the upper left corner.

    With several samples per pixel, compositing sees the film as many times: its planes hold the
    pixels of the first sample, then those of the second one, and its tiles are numbered alike.
    """

    width: int
    height: int
    samples: int = 1

    @property
    def columns(self) -> int:
        """Tiles in a row."""
        return -(-self.width // TILE)

    @property
    def num_tiles(self) -> int:
        """Tiles on the film."""
        return self.columns * -(-self.height // TILE)

    @property
    def num_pixels(self) -> int:
        """Pixels of a plane: those of all samples."""
        return self.samples * self.width * self.height

    def tiles_of(self, samples: range) -> range:
        """The tiles of some samples, among those of all."""
        return range(samples.start * self.num_tiles, samples.stop * self.num_tiles)

    @property
    def cull_margin(self) -> float:
        """Largest rounding error of an exponent (base 2) on this film."""
        return CULL_MARGIN + CULL_MARGIN_PER_PX * max(self.width, self.height)


@dataclass(frozen=True)
class Lanes:
    """Lanes, each a micro-tile, in the order in which Dr.Jit starts them."""

    micro_tile: UInt32  # tile among those of all samples * 16 + micro-tile within the tile
    micro: UInt32  # micro-tile within the tile
    tile: UInt32  # on the film
    sample: UInt32
    x: UInt32  # first pixel column
    y: UInt32  # first pixel row


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
    golden = max(1, round(num_groups * (math.sqrt(5) - 1) / 2))
    stride = next(n for n in count(golden) if math.gcd(n, max(num_groups, 1)) == 1)
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
    x = (tile - row * columns) * TILE + (micro % GRID) * MICRO
    y = row * TILE + (micro // GRID) * MICRO
    return Lanes(micro_tile, micro, tile, sample, x, y)


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


def load_pixels(plane: Float, lanes: Lanes, grid: TileGrid) -> list[Float]:
    """The 16 values of a row-major plane of all samples in each micro-tile; 0 off the film."""
    pixels = pixels_of(lanes, grid)
    return [dr.gather(type(plane), plane, index, inside) for index, inside in pixels]


def pixels_of(lanes: Lanes, grid: TileGrid) -> list[tuple[UInt32, Bool]]:
    """Return index (in a plane of all samples) and on-film mask of each micro-tile's 16 pixels."""
    UInt32 = type(lanes.x)
    width, height = dr.opaque(UInt32, grid.width), dr.opaque(UInt32, grid.height)
    first_row = lanes.sample * height
    places = ((lanes.x + k % MICRO, lanes.y + k // MICRO) for k in range(PIXELS))
    return [((first_row + y) * width + x, (x < width) & (y < height)) for x, y in places]


def load_lane_row(values: T, micro_tile: UInt32, planes: int) -> list[T]:
    """The first 16 values of each micro-tile's row of ``planes`` x 16."""
    first = micro_tile * (planes * PIXELS)
    return [dr.gather(type(values), values, first + k) for k in range(PIXELS)]
