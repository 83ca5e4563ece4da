"""What one process projects and another composites.

Each process has some of the Gaussians' rows, and renders some of a step's views. It projects its
rows for the cameras of all views; what of them is on a view's film goes, as rows of numbers, to
whoever renders that view, who bins and composites them as if they were his own. The derivatives
with respect to these splats go back, and every process takes those of its rows on through the
projection. So 14 numbers of a splat travel, and 9 come back, where a Gaussian has 59; and since
rows lie one behind the other in the order of the processes, nothing depends on how many there are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np
from mpi4py import MPI

from drgs.cameras.camera import Camera
from drgs.core.arrays import Rows, block_widths, empty_on_host, types_of, wrapped
from drgs.core.constants import MAX_SHUTTER_SAMPLES
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.rasterize import SplatGradients
from drgs.splatting.rendering import (
    NO_FAULT,
    Frame,
    GaussianGradients,
    Pipeline,
    SeenSplats,
    footprints_seen_by,
)
from drgs.splatting.tiles import Footprints
from drgs.training.parallel.ranks import Ranks, wait

Blocks = list[np.ndarray]
"""Rows of numbers as they travel: (M, columns) for each block of :class:`drgs.core.arrays.Rows`."""

BOX = 4
"""Numbers of a splat's box of tiles: see :class:`drgs.splatting.tiles.Footprints`."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Which numbers of a splat travel."""

    num_stored: int  # geometry, features, keys
    num_features: int
    num_keys: int

    @property
    def num_gradients(self) -> int:
        """With respect to geometry and features."""
        return self.num_stored - self.num_keys

    @property
    def widths(self) -> tuple[int, ...]:
        """Of the blocks of a splat: its box, what is stored, its depth."""
        return (BOX, *block_widths(self.num_stored), 1)


@dataclass(frozen=True, eq=False)
class Sight:
    """What one camera sees of the rows of this process."""

    camera: Camera
    pipeline: Pipeline  # composed for the camera
    layout: Layout
    float_type: type
    num_rows: int  # of this process
    of_camera: bool  # whether derivatives with respect to the camera are asked for
    rows: Any  # UInt32 (M,): those on the film, ascending
    count: int  # M
    _blocks: Blocks  # of these rows

    def taken_blocks(self) -> Blocks:
        """The rows as they travel, which are not kept here."""
        blocks = self._blocks[:]
        self._blocks.clear()
        return blocks

    @staticmethod
    def of(gaussians: Gaussians, camera: Camera, pipeline: Pipeline, of_camera: bool) -> Sight:
        """Project, and pack what is on the film. The host reads how many there are."""
        found = footprints_seen_by(gaussians, camera, pipeline)
        layout = Layout(found.rows.width, found.num_features, found.num_keys)
        t, num_rows = types_of(type(found.depths)), dr.width(found.depths)
        tiles = found.boxes.load(dr.arange(t.UInt32, num_rows))[-1]
        rows = dr.compress(tiles > 0)
        count, blocks = dr.width(rows), empty_blocks(0, layout.widths, t.Float)
        if count > 0:
            boxes, stored = (Rows.of(each.load(rows)) for each in (found.boxes, found.rows))
            depths = dr.gather(t.Float, found.depths, rows)
            dr.eval(boxes, stored, depths)
            flat = [*boxes.blocks, *stored.blocks, depths]
            blocks = [each.numpy().reshape(count, -1) for each in flat]
        kind = layout, t.Float, num_rows, of_camera
        return Sight(camera, pipeline, *kind, rows, count, blocks)

    def of_rows(self, blocks: Blocks, width: int) -> list[Any]:
        """Columns of all rows of this process, of numbers of those on the film; else 0."""
        t = types_of(self.float_type)
        if self.count == 0:
            return [dr.zeros(t.Float, self.num_rows) for _ in range(width)]
        nowhere = 0xFFFFFFFF
        place = dr.full(t.UInt32, nowhere, self.num_rows)
        dr.scatter(place, dr.arange(t.UInt32, self.count), self.rows)
        dr.eval(place)
        rows = Rows(tuple(wrapped(t.Float, block) for block in blocks), width)
        return rows.load(place, place != nowhere)

    def seen_splats(self, blocks: Blocks) -> SeenSplats:
        """All rows of this process, with the derivatives of those that came back."""
        columns = self.of_rows(blocks, self.layout.num_gradients)
        of_geometry = len(columns) - self.layout.num_features
        gradients = SplatGradients(columns[:of_geometry], columns[of_geometry:])
        return SeenSplats(self.camera, self.pipeline, gradients)


def joined(blocks: Blocks, layout: Layout, float_type: type) -> Footprints:
    """The splats of several processes, behind one another in each block."""
    if len(blocks[0]) == 0:  # Dr.Jit does not compute with empty arrays: one that is not visible
        blocks = empty_blocks(1, layout.widths, float_type)
        for block in blocks:
            block[:] = 0
        blocks[-1][:] = np.inf
    box, *stored, depths = (wrapped(float_type, block) for block in blocks)
    rows = Rows(tuple(stored), layout.num_stored)
    return Footprints(Rows((box,), BOX), rows, depths, layout.num_features, layout.num_keys)


def empty_blocks(count: int, widths: Sequence[int], float_type: type) -> Blocks:
    """Memory for rows that are received, aligned as Dr.Jit's is."""
    return [empty_on_host(float_type, (count, width)) for width in widths]


class Post:
    """Messages about the views of a step, told apart by place in the step and time."""

    def __init__(self, ranks: Ranks) -> None:
        self.ranks = ranks
        self._sending: list[tuple[list[MPI.Request], Blocks]] = []  # and what is on its way
        self._staying: dict[tuple[int, int], deque[Blocks]] = {}  # from this process to itself

    def send(self, blocks: Blocks, to: int, place: int, time: int) -> None:
        """Begin to send rows to a process."""
        if to == self.ranks.rank:
            self._staying.setdefault((place, time), deque()).append(blocks)
            return
        tag = place * MAX_SHUTTER_SAMPLES + time
        self._sending.append(([self.ranks.send(block, to, tag) for block in blocks], blocks))

    def receive(self, into: Blocks, of: int, place: int, time: int) -> None:
        """Wait for the next rows that a process sends."""
        if of == self.ranks.rank:
            own = self._staying[place, time].popleft()
            for block, rows in zip(into, own, strict=True):
                block[:] = rows
            return
        tag = place * MAX_SHUTTER_SAMPLES + time
        with self.ranks.exchanging():
            wait(*(self.ranks.receive(block, of, tag) for block in into))

    def forget_received(self) -> None:
        """Free what has arrived."""
        arrived = [MPI.Request.Testall(requests) for requests, _ in self._sending]
        self._sending = [s for s, done in zip(self._sending, arrived, strict=True) if not done]

    def finish(self) -> None:
        """Wait until all has been sent."""
        with self.ranks.exchanging():
            wait(*(request for requests, _ in self._sending for request in requests))
        self._sending.clear()


@dataclass(eq=False)
class Received:
    """Splats that others have projected, as a source of frames; one for each time of a view."""

    footprints_in_time: list[Footprints]
    gradients_in_time: list[SplatGradients] = field(default_factory=list)

    def footprints(self, gaussians: Gaussians, camera: Camera, pipeline: Pipeline) -> Footprints:
        """Those of the next time."""
        del gaussians, camera, pipeline
        return self.footprints_in_time.pop(0)

    def gradients(
        self, gaussians: Gaussians, frame: Frame, of_splats: SplatGradients, of_camera: bool
    ) -> GaussianGradients:
        """Keep them, for those who have projected the splats, and find those of the camera."""
        del gaussians, frame, of_camera
        self.gradients_in_time.append(of_splats)
        t = types_of(type(of_splats.geometry[0]))
        nothing = dr.zeros(t.Array2f), t.Bool(False), t.UInt32(NO_FAULT)  # here; at any time
        return GaussianGradients(None, *nothing)

    def blocks(self) -> list[Blocks]:
        """Of each time the derivatives of its splats; waits for the device."""
        rows = [Rows.of([*g.geometry, *g.features]) for g in self.gradients_in_time]
        dr.eval(rows)
        return [[b.numpy().reshape(-1, w) for b, w in _by_width(each)] for each in rows]


def _by_width(rows: Rows) -> Iterator[tuple[Any, int]]:
    return zip(rows.blocks, block_widths(rows.width), strict=True)
