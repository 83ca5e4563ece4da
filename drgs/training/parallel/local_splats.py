"""The rows of this rank as a camera sees them, and their way to the host and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import numpy as np

from drgs.cameras.camera import Camera
from drgs.core.arrays import Rows, block_widths, empty_on_host, types_of, wrap_numpy
from drgs.core.types import Bool, Float, UInt32
from drgs.splatting.rasterize import SplatGradients
from drgs.splatting.rendering import Pipeline
from drgs.splatting.tiles import SplatTable

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

    @staticmethod
    def from_splats(splats: SplatTable, camera: Camera, pipeline: Pipeline) -> LocalSplats:
        """Return what is kept of this rank's projected rows."""
        counts = splats.rows.width, splats.num_features, splats.num_keys
        return LocalSplats(camera, pipeline, splats.boxes, *counts)

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
