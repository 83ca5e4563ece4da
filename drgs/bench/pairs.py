"""How much work a frame is: entries, and (pixel, Gaussian) pairs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from drgs.core.arrays import types_of
from drgs.splatting.grid import PIXELS
from drgs.splatting.lanes import Entries, load_lane_row, make_lanes
from drgs.splatting.rendering import Frame


@dataclass(frozen=True)
class Work:
    """What the compositing kernels visit, and what of it shows."""

    entries: int  # (Gaussian, tile)
    micro_entries: int  # (Gaussian, micro-tile)
    evaluated: int  # (pixel, Gaussian) pairs whose alpha compositing computes
    useful: int  # pairs with alpha >= 1/255 at a pixel that is not finished


def count_work(frame: Frame) -> Work:
    """Count by walking the entries once more."""
    bins, layers = frame.bins, frame.layers
    t = types_of(bins.rows.Float)
    lanes = make_lanes(t.Float, bins.grid)
    stop = dr.gather(t.UInt32, layers.stop, lanes.micro_tile)
    entries = Entries(bins, lanes, stop)
    ends = load_lane_row(layers.ends, lanes.micro_tile, 1)
    model = bins.model.bind(lanes, bins.grid)

    def body(cursor: Any, visited: Any, useful: Any) -> tuple:
        entry, active = entries.current(cursor)
        geometry, _ = frame.records.load(entry, active)
        footprint = model.footprint(geometry, lanes, active)
        for pixel, alpha in enumerate(model.alphas(geometry, footprint)):
            useful = useful + dr.select((alpha.value > 0) & (entry < ends[pixel]), t.UInt32(1), 0)
        return entries.advance(cursor), visited + dr.select(active, t.UInt32(1), 0), useful

    zero = dr.zeros(t.UInt32, dr.width(lanes.tile))
    _, visited, useful = dr.while_loop(
        state=(entries.begin(), zero, t.UInt32(zero)),
        cond=lambda cursor, visited, useful: entries.pending(cursor),
        body=body,
    )
    dr.eval(visited, useful)
    return Work(
        entries=bins.num_entries,
        micro_entries=int(dr.sum(dr.popcnt(bins.masks))[0]),
        evaluated=int(dr.sum(visited)[0]) * PIXELS,
        useful=int(dr.sum(useful)[0]),
    )
