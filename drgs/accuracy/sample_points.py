"""Pixels evaluated at points of their own: several samples per pixel.

Imported when a scene asks for more than one sample per pixel or for a reconstruction filter. Each
pass evaluates every pixel once, at a point that the sampler has chosen; splats are put into tiles
with half a pixel to spare, so that all passes share the tiles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from drgs.core.arrays import types_of
from drgs.splatting.footprint import Positions, flat_columns, total
from drgs.splatting.grid import MICRO, Lanes, TileGrid
from drgs.splatting.lanes import load_pixels


@dataclass(frozen=True)
class SamplePoints(Positions):
    """One point in each pixel, for each of some samples.

    Equality is identity of the arrays: those of another pass are another model.
    """

    margin: ClassVar[float] = 0.5

    x: Any = None  # Float (samples * H * W,) in [0, 1): from the pixel's left border, px
    y: Any = None  # the same, from its upper border
    samples: int = 1
    bound: tuple[list[Any], list[Any]] | None = None  # the 16 of each lane

    def bind(self, lanes: Lanes, grid: TileGrid) -> SamplePoints:
        bound = tuple(load_pixels(plane, lanes, grid) for plane in (self.x, self.y))
        return SamplePoints(bound=bound)

    def points(self, lanes: Lanes, Float: type) -> list[tuple[Any, Any]]:
        x, y = Float(lanes.x), Float(lanes.y)
        return [
            (x + (pixel % MICRO) + px, y + (pixel // MICRO) + py)
            for pixel, (px, py) in enumerate(zip(*self.bound, strict=True))
        ]

    def offsets(self, lanes: Lanes, x: Any, y: Any) -> tuple[list, list]:
        Float = types_of(type(x)).Float
        first_x, first_y = Float(lanes.x) - x, Float(lanes.y) - y
        dx = [first_x + (pixel % MICRO) + in_x for pixel, in_x in enumerate(self.bound[0])]
        dy = [first_y + (pixel // MICRO) + in_y for pixel, in_y in enumerate(self.bound[1])]
        return _grid(dx), _grid(dy)

    def sum(self, values: list[Any]) -> Any:
        return total(values)

    def sum_dx(self, values: list[Any], dx: list) -> Any:
        return total(_products(values, dx))

    def sum_dy(self, values: list[Any], dy: list) -> Any:
        return total(_products(values, dy))

    def sum_dy_dy(self, values: list[Any], dy: list) -> Any:
        return total(_products(_products(values, dy), dy))


def _products(values: list[Any], grid: list[list[Any]]) -> list[Any]:
    return [a * b for a, b in zip(values, flat_columns(grid), strict=True)]


def _grid(values: list[Any]) -> list[list[Any]]:
    return [values[MICRO * j : MICRO * j + MICRO] for j in range(MICRO)]
