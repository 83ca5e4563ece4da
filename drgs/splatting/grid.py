"""Tiles of the film, their micro-tiles, and the lanes of kernels: one lane per micro-tile."""

from __future__ import annotations

from dataclasses import dataclass

from drgs.core.constants import CULL_MARGIN, CULL_MARGIN_PER_PX
from drgs.core.types import UInt32

MICRO = 4
"""Pixels on a micro-tile's side. A micro-tile is one SIMD lane of the compositing kernels."""

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
    def rows(self) -> int:
        """Tiles in a column."""
        return -(-self.height // TILE)

    @property
    def num_tiles(self) -> int:
        """Tiles on the film."""
        return self.columns * self.rows

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
