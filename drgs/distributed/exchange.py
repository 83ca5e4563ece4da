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
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np

from drgs.cameras.camera import Camera
from drgs.core.arrays import Rows, from_host, interleave, types_of
from drgs.distributed.ranks import Ranks, wait
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.rasterize import SplatGradients
from drgs.splatting.rendering import (
    NO_FAULT,
    Frame,
    GaussianGradients,
    Pipeline,
    footprints_seen_by,
)
from drgs.splatting.tiles import Footprints

MOST_TIMES = 4096
"""Of an open shutter; see ``drgs.integrator.limits``."""

BOX = 4
"""Numbers of a splat's box of tiles: see :class:`drgs.splatting.tiles.Footprints`."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Which numbers of a splat travel."""

    num_stored: int  # geometry, features, keys
    num_features: int
    num_keys: int
    num_gradients: int  # with respect to geometry and features

    @property
    def width(self) -> int:
        """Numbers of a splat: box, what is stored, depth."""
        return BOX + self.num_stored + 1


@dataclass(frozen=True, eq=False)
class Sight:
    """What one camera sees of the rows of this process."""

    camera: Camera
    pipeline: Pipeline  # composed for the camera
    layout: Layout
    num_rows: int  # of this process
    rows: Any  # UInt32 (M,): those on the film, ascending
    numbers: np.ndarray  # (M, width), as they travel

    @property
    def count(self) -> int:
        """M: how many rows are on the film."""
        return len(self.numbers)

    def empty(self, count: int, width: int | None = None) -> np.ndarray:
        """Rows to put others into that are received; width: None: of a splat as it travels."""
        shape = int(count), self.layout.width if width is None else width
        return np.empty(shape, self.numbers.dtype)

    @staticmethod
    def of(gaussians: Gaussians, camera: Camera, pipeline: Pipeline) -> Sight:
        """Project, and pack what is on the film. The host reads how many there are."""
        found = footprints_seen_by(gaussians, camera, pipeline)
        stored = found.rows.width
        layout = Layout(
            num_stored=stored,
            num_features=found.num_features,
            num_keys=found.num_keys,
            num_gradients=stored - found.num_keys,
        )
        t, num_rows = types_of(type(found.depths)), dr.width(found.depths)
        tiles = found.boxes.load(dr.arange(t.UInt32, num_rows))[-1]
        rows = dr.compress(tiles > 0)
        numbers = np.empty((0, layout.width), _dtype(t.Float))
        if dr.width(rows) > 0:
            depths = dr.gather(t.Float, found.depths, rows)
            flat = interleave([*found.boxes.load(rows), *found.rows.load(rows), depths])
            numbers = np.array(flat).reshape(-1, layout.width)
        return Sight(camera, pipeline, layout, num_rows, rows, numbers)

    def of_rows(self, numbers: np.ndarray) -> list[Any]:
        """Columns of all rows of this process, of numbers (M, C) of those on the film; else 0."""
        t = types_of(type(self.rows))
        count = numbers.shape[1]
        if self.count == 0:
            return [dr.zeros(t.Float, self.num_rows) for _ in range(count)]
        flat = from_host(t.Float, numbers)
        nowhere = 0xFFFFFFFF
        place = dr.full(t.UInt32, nowhere, self.num_rows)
        dr.scatter(place, dr.arange(t.UInt32, self.count), self.rows)
        dr.eval(place)
        is_there = place != nowhere
        return [dr.gather(t.Float, flat, place * count + k, is_there) for k in range(count)]

    def splat_gradients(self, numbers: np.ndarray) -> SplatGradients:
        """Of all rows of this process, from those (M, C) that came back."""
        columns = self.of_rows(numbers)
        of_geometry = len(columns) - self.layout.num_features
        return SplatGradients(geometry=columns[:of_geometry], features=columns[of_geometry:])


def joined(parts: Sequence[np.ndarray], layout: Layout, float_type: type) -> Footprints:
    """The splats of several processes behind one another, evaluated."""
    numbers = np.concatenate(parts)
    if len(numbers) == 0:  # Dr.Jit does not compute with empty arrays: one that is not visible
        numbers = np.zeros((1, layout.width), _dtype(float_type))
        numbers[:, -1] = np.inf
    t, width = types_of(float_type), layout.width
    flat, row = from_host(t.Float, numbers), dr.arange(t.UInt32, len(numbers))
    columns = [dr.gather(t.Float, flat, row * width + k) for k in range(width)]
    boxes, rows = Rows.of(columns[:BOX]), Rows.of(columns[BOX:-1])
    dr.eval(boxes, rows, columns[-1])
    return Footprints(boxes, rows, columns[-1], layout.num_features, layout.num_keys)


class Post:
    """Messages about the views of a step, told apart by place in the step and time."""

    def __init__(self, ranks: Ranks) -> None:
        self.ranks = ranks
        self._sending: list[Any] = []
        self._staying: dict[tuple[int, int], deque[np.ndarray]] = {}  # from this process to itself

    def send(self, rows: np.ndarray, to: int, place: int, time: int) -> None:
        """Begin to send rows to a process."""
        if to == self.ranks.rank:
            self._staying.setdefault((place, time), deque()).append(rows)
        else:
            rows = np.ascontiguousarray(rows)
            self._sending.append(self.ranks.send(rows, to, place * MOST_TIMES + time))

    def receive(self, into: np.ndarray, of: int, place: int, time: int) -> np.ndarray:
        """The next rows that a process sends."""
        if of == self.ranks.rank:
            return self._staying[place, time].popleft()
        with self.ranks.exchanging():
            wait(self.ranks.receive(into, of, place * MOST_TIMES + time))
        return into

    def finish(self) -> None:
        """Wait until all has been sent."""
        with self.ranks.exchanging():
            wait(*self._sending)
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
        """Keep them, for those who have projected the splats."""
        del gaussians, frame
        if of_camera:
            raise NotImplementedError("Received: derivatives with respect to cameras")
        self.gradients_in_time.append(of_splats)
        t = types_of(type(of_splats.geometry[0]))
        visible = dr.full(t.Bool, True, dr.width(of_splats.geometry[0]))
        nothing = t.UInt32(NO_FAULT)
        return GaussianGradients(None, of_splats.means2d, visible, nothing)

    def numbers(self, counts: np.ndarray) -> list[np.ndarray]:
        """Of each time the derivatives of its splats, (count, C); waits for the device."""
        columns = [[*g.geometry, *g.features] for g in self.gradients_in_time]
        flat = [interleave(each) for each in columns]
        dr.eval(flat)
        return [
            np.array(values).reshape(-1, len(each))[:count]
            for values, each, count in zip(flat, columns, counts, strict=True)
        ]


def _dtype(float_type: type) -> Any:
    return np.float64 if dr.type_v(float_type) == dr.VarType.Float64 else np.float32
