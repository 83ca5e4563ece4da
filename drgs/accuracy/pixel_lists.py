"""Lists of what each micro-tile composites, sorted by the depths of peaks at its middle.

What the order of each pixel starts from (``drgs.accuracy.pixel_order``). The splats of a tile are
in the order of their means; those of a list are nearly in that of its pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from drgs.accuracy.peak_depths import AffineDepths
from drgs.core.arrays import types_of
from drgs.splatting.grid import GRID, MICRO, MICROS, TILE, Lanes
from drgs.splatting.rasterize import (
    Records,
)
from drgs.splatting.tiles import TileBins, lower_bounds, stable_order

FARTHEST = 4.0
"""Between this and its inverse is the depth by which a list is sorted, relative to the mean's."""


@dataclass(frozen=True)
class PixelLists:
    """Of each micro-tile, the sorted entries that touch it, front to back.

    An *item* is a pair of an entry and a micro-tile. Items are made splat by splat, so that those
    of a splat are together, and then sorted.
    """

    entries: Any  # UInt32 (items,): place in the lists -> sorted entry
    order: Any  # UInt32 (items,): place in the lists -> item as made
    first_item: Any  # UInt32 (N + 1,): rank -> first of its items as made
    start: Any  # UInt32 (tiles * 16 + 1,): micro-tile -> first place
    count: int  # items

    def range(self, lanes: Lanes) -> tuple[Any, Any]:
        """First place, and one behind the last, of each lane."""
        UInt32, number = type(self.start), lanes.tile * MICROS + lanes.micro
        return tuple(dr.gather(UInt32, self.start, number + k) for k in (0, 1))

    def places(self) -> Any:
        """UInt32 (items,): item as made -> place in the lists."""
        UInt32, size = type(self.order), dr.width(self.order)
        places = dr.empty(UInt32, size)
        dr.scatter(places, dr.arange(UInt32, size), self.order)
        return places

    @staticmethod
    def of(bins: TileBins, records: Records, depths: AffineDepths) -> PixelLists:
        """Make the lists. The host reads one value, the number of items."""
        t = types_of(bins.rows.Float)
        # Entries as they are made, and one behind the last.
        position = dr.arange(t.UInt32, bins.num_entries)
        entry = dr.zeros(t.UInt32, bins.num_entries + 1)
        dr.scatter(entry, position, dr.gather(t.UInt32, bins.source, position))
        dr.eval(entry)
        exists = dr.arange(t.UInt32, bins.num_entries + 1) < dr.opaque(t.UInt32, bins.num_entries)
        masks = dr.gather(t.UInt32, bins.masks, entry, exists)
        first = dr.prefix_sum(dr.popcnt(masks))
        count = int(first[bins.num_entries])

        items = _Items.of(bins, records, depths, entry, masks, first, max(count, 1))
        by_depth = stable_order(_levels(items.depths), _LEVELS)
        lists = dr.gather(t.UInt32, items.micro_tiles, by_depth)
        num_lists = bins.grid.num_tiles * MICROS
        order = dr.gather(t.UInt32, by_depth, stable_order(lists, num_lists))
        entries, lists = (
            dr.gather(t.UInt32, column, order) for column in (items.entries, items.micro_tiles)
        )
        dr.eval(entries, lists, order)
        return PixelLists(
            entries=entries,
            order=order,
            first_item=dr.gather(t.UInt32, first, bins.first_entry),
            start=lower_bounds(lists, count, num_lists),
            count=count,
        )


_LEVELS = 1 << 14
"""Depths that the lists distinguish: as many as one pass of a sort can. Where they do not, splats
are in the order of their means, and the window sorts what is left."""


def _levels(depths: Any) -> Any:
    """Which of ``_LEVELS`` parts of their range positive depths are in; nearly logarithmic."""
    # The bits of positive single-precision numbers are ordered as they are.
    Single = dr.float32_array_t(type(depths))
    bits = dr.reinterpret_array(dr.uint32_array_t(Single), Single(depths))
    first = dr.min(bits)
    scale = (_LEVELS - 1) / Single(dr.max(bits) - first + 1)
    level = type(bits)(Single(bits - first) * scale)
    return dr.select(level < _LEVELS, level, _LEVELS - 1)


@dataclass(frozen=True)
class _Items:
    """Columns of the items as made."""

    depths: Any  # Float: of the peak along the ray through the middle of the micro-tile
    micro_tiles: Any  # UInt32: tile * 16 + micro-tile within the tile
    entries: Any  # UInt32: sorted entry

    @staticmethod
    def of(
        bins: TileBins,
        records: Records,
        depths: AffineDepths,
        entry: Any,
        masks: Any,
        item: Any,
        count: int,
    ) -> _Items:
        """entry: sorted entries; masks: their micro-tiles; item: the first of each one's items."""
        t = types_of(bins.rows.Float)
        # A single item that is not made, if there are none.
        items = _Items(
            dr.ones(t.Float, count), dr.zeros(t.UInt32, count), dr.zeros(t.UInt32, count)
        )
        dr.eval(items)
        exists = masks != 0
        geometry, _ = records.load(entry, exists)
        keys = records.load_keys(entry, exists)
        tile = dr.gather(t.UInt32, bins.tiles, entry, exists)
        columns = dr.opaque(t.UInt32, bins.grid.columns)
        row = tile // columns
        # Middle of the first micro-tile.
        x = t.Float((tile - row * columns) * TILE) + MICRO / 2
        y = t.Float(row * TILE) + MICRO / 2

        def body(masks: Any, item: Any) -> tuple:
            micro = dr.tzcnt(masks)
            middle = x + t.Float(micro % GRID) * MICRO, y + t.Float(micro // GRID) * MICRO
            a, denominator = depths.at(bins.model.falloff, geometry, keys, *middle)
            # Where there is no peak, there may be one at a neighbour.
            along = dr.select(a > 0, a / denominator, 1)
            along = dr.select(along < 1 / FARTHEST, 1 / FARTHEST, along)
            along = dr.select(along > FARTHEST, FARTHEST, along)
            dr.scatter(items.depths, keys[-1] * along, item)
            dr.scatter(items.micro_tiles, tile * MICROS + micro, item)
            dr.scatter(items.entries, entry, item)
            return masks & (masks - 1), item + 1

        loop = dr.while_loop(
            state=(t.UInt32(masks), t.UInt32(item)),
            cond=lambda masks, item: masks != 0,
            body=body,
        )
        dr.eval(loop, items)
        return items
