"""Messages of a step of several views: splats to the renderer of a view, and numbers of them back.

Each rank sends the visible splats of its rows to the rank that renders the view, and gets as many
rows of derivatives. Rows of one view and time arrive in their order. A single rank sends nothing:
its splats stay on the device.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import drjit as dr
import numpy as np

from drgs.cameras.camera import Camera
from drgs.core.arrays import Rows, block_widths, empty_on_host, types_of, wrap_numpy
from drgs.core.constants import MAX_SHUTTER_SAMPLES
from drgs.core.types import Bool, Float, UInt32
from drgs.splatting.rasterize import SplatGradients
from drgs.splatting.rendering import Pipeline
from drgs.splatting.tiles import SplatTable
from drgs.training.parallel.communicator import Communicator, wait
from drgs.training.steps import StepView

Blocks = list[np.ndarray]
"""Rows of numbers as they travel: (M, columns) for each block of :class:`drgs.core.arrays.Rows`."""

BOX_NUMBERS = 4  # numbers of a splat's box of tiles: see :class:`drgs.splatting.tiles.SplatTable`


def empty_blocks(count: int, widths: Sequence[int], float_type: type) -> Blocks:
    """Return memory for rows to receive, aligned as Dr.Jit's is."""
    return [empty_on_host(float_type, (count, width)) for width in widths]


@dataclass(frozen=True, eq=False)
class LocalSplats:
    """This rank's rows as one camera sees them at one time, without stored numbers."""

    camera: Camera
    pipeline: Pipeline  # composed for the camera
    boxes: Rows  # of tiles, of all rows of this rank
    num_stored: int  # numbers of a splat: geometry, features, keys
    num_features: int
    num_keys: int

    @property
    def num_rows(self) -> int:
        """Rows of this rank."""
        return dr.width(self.boxes.blocks[0]) // BOX_NUMBERS

    @property
    def visible(self) -> Bool:
        """Bool by row: its box has tiles of the film."""
        t = types_of(self.boxes.Float)
        return self.boxes.load(dr.arange(t.UInt32, self.num_rows))[-1] > 0

    @property
    def widths(self) -> tuple[int, ...]:
        """Columns of the blocks of a splat: its box, its stored numbers, its depth."""
        return (BOX_NUMBERS, *block_widths(self.num_stored), 1)

    def table(self, blocks: Blocks) -> SplatTable:
        """Return received splats without copying them."""
        box, *stored, depths = (wrap_numpy(self.boxes.Float, block) for block in blocks)
        rows, boxes = Rows(tuple(stored), self.num_stored), Rows((box,), BOX_NUMBERS)
        return SplatTable(boxes, rows, depths, self.num_features, self.num_keys)

    def gradients(self, columns: list[Float]) -> SplatGradients:
        """Divide columns of derivatives into those of geometry and of features."""
        num_geometry = len(columns) - self.num_features
        return SplatGradients(columns[:num_geometry], columns[num_geometry:])

    def pack(self, splats: SplatTable, rows: UInt32) -> Blocks:
        """Return the projected splats of some rows of this rank, (M,), on the host."""
        count, float_type = dr.width(rows), splats.rows.Float
        if count == 0:
            return empty_blocks(0, self.widths, float_type)
        boxes, stored = (Rows.from_columns(each.load(rows)) for each in (splats.boxes, splats.rows))
        depths = dr.gather(float_type, splats.depths, rows)
        dr.eval(boxes, stored, depths)
        boxes, stored = boxes.first(count), stored.first(count)
        return [each.numpy().reshape(count, -1) for each in [*boxes.blocks, *stored.blocks, depths]]

    def unpack(self, rows: UInt32, blocks: Blocks, width: int) -> list[Float]:
        """Return columns for all rows of this rank: the blocks' numbers of ``rows``, else 0."""
        t, count = types_of(self.boxes.Float), dr.width(rows)
        if count == 0:
            return [dr.zeros(t.Float, self.num_rows) for _ in range(width)]
        absent = 0xFFFFFFFF
        index = dr.full(t.UInt32, absent, self.num_rows)
        dr.scatter(index, dr.arange(t.UInt32, count), rows)
        dr.eval(index)
        received = Rows(tuple(wrap_numpy(t.Float, block) for block in blocks), width)
        return received.load(index, index != absent)


def concatenate(parts: Sequence[SplatTable]) -> SplatTable:
    """Return the splats of several ranks behind one another."""
    if len(parts) == 1:
        return parts[0]

    def concatenate_rows(each: Sequence[Rows]) -> Rows:
        columns = zip(*(rows.blocks for rows in each), strict=True)
        return Rows(tuple(dr.concat(list(blocks)) for blocks in columns), each[0].width)

    boxes = concatenate_rows([part.boxes for part in parts])
    rows = concatenate_rows([part.rows for part in parts])
    depths = dr.concat([part.depths for part in parts])
    return SplatTable(boxes, rows, depths, parts[0].num_features, parts[0].num_keys)


@dataclass(eq=False)
class SharedView:
    """A view of a step: rendered by one rank, from the splats of all; lists are by time."""

    view: StepView
    renderer: int  # rank
    local: list[LocalSplats] = field(default_factory=list)
    rows: list[UInt32] = field(default_factory=list)  # sent to another renderer, ascending
    counts: np.ndarray = field(init=False)  # (ranks, times): splats sent to the renderer


class SplatExchange:
    """The messages of the steps of a fit, between the ranks of ``comm``."""

    def __init__(self, comm: Communicator) -> None:
        self.comm = comm
        self._sending: list[tuple[Any, np.ndarray]] = []  # requests and their data

    def pack(self, shared: SharedView, splats: Sequence[SplatTable]) -> list[Blocks]:
        """Return this rank's visible splats of a view, by time; the host reads their number."""
        shared.rows = [cast(UInt32, dr.compress(local.visible)) for local in shared.local]
        by_time = zip(shared.local, splats, shared.rows, strict=True)
        return [local.pack(of_time, rows) for local, of_time, rows in by_time]

    def send_splats(
        self,
        views: Sequence[SharedView],
        num_times: Sequence[int],
        packed: Mapping[SharedView, Sequence[Blocks]],
    ) -> None:
        """Send packed splats to the ranks that render their views; num_times: of all views."""
        num_sent = [
            [dr.width(rows) for rows in shared.rows] if shared in packed else [0] * count
            for shared, count in zip(views, num_times, strict=True)
        ]
        counts = self.comm.all_gather(np.concatenate(num_sent))
        by_view = np.split(counts, np.cumsum(num_times)[:-1], axis=1)
        for shared, shared.counts in zip(views, by_view, strict=True):
            for time, blocks in enumerate(packed.get(shared, ())):
                self._send(blocks, shared.renderer, shared, time)

    def receive_splats(self, shared: SharedView, time: int, own: SplatTable) -> SplatTable:
        """Return the splats of all ranks, behind one another; own: of this rank, the renderer."""
        local, parts = shared.local[time], []
        for rank in range(self.comm.size):
            if rank == self.comm.rank:
                parts.append(own)
            elif (count := int(shared.counts[rank, time])) > 0:
                blocks = empty_blocks(count, local.widths, own.rows.Float)
                self._receive(blocks, rank, shared, time)
                parts.append(local.table(blocks))
        return concatenate(parts)

    def return_columns(self, shared: SharedView, time: int, columns: list[Float]) -> list[Float]:
        """Send numbers of a rendered view's splats to their ranks; return those of this rank."""
        if self.comm.size == 1:
            return columns
        counts = shared.counts[:, time].copy()
        counts[self.comm.rank] = shared.local[time].num_rows
        ends = np.cumsum(counts)
        starts = [0, *ends[:-1]]
        rows = Rows.from_columns(columns)
        dr.eval(rows)
        widths = block_widths(rows.width)
        blocks = [b.numpy().reshape(-1, w) for b, w in zip(rows.blocks, widths, strict=True)]
        for rank, (start, end) in enumerate(zip(starts, ends, strict=True)):
            if rank != self.comm.rank and end > start:
                self._send([block[start:end] for block in blocks], rank, shared, time)
        index_type = types_of(rows.Float).UInt32
        first = dr.opaque(index_type, int(starts[self.comm.rank]))
        return rows.load(dr.arange(index_type, shared.local[time].num_rows) + first)

    def receive_columns(self, shared: SharedView, time: int, width: int) -> list[Float]:
        """Return numbers of this rank's rows from the view's renderer, 0 where it has no splat."""
        local, rows = shared.local[time], shared.rows[time]
        blocks = empty_blocks(dr.width(rows), block_widths(width), local.boxes.Float)
        if dr.width(rows) > 0:
            self._receive(blocks, shared.renderer, shared, time)
        return local.unpack(rows, blocks, width)

    def finish(self) -> None:
        """Wait until all that was sent has arrived."""
        wait(*(request for request, _ in self._sending))
        self._sending.clear()

    def _send(self, blocks: Blocks, to: int, shared: SharedView, time: int) -> None:
        tag = shared.view.place * MAX_SHUTTER_SAMPLES + time
        self._sending += [(self.comm.send(block, to, tag), block) for block in blocks]

    def _receive(self, into: Blocks, source: int, shared: SharedView, time: int) -> None:
        tag = shared.view.place * MAX_SHUTTER_SAMPLES + time
        wait(*(self.comm.receive(block, source, tag) for block in into))
