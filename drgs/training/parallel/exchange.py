"""Gradients of a step of several views, on one process or several.

Every rank holds some rows of the Gaussians, and renders some views of a step. It projects its rows
for the cameras of all views, and sends the visible splats to the rank that renders the view, which
concatenates, bins and composites them. The derivatives of these splats are sent back, and every
rank propagates those of its rows through the projection. Rows are ordered by rank, and each rank
adds the views in their order, so the bytes do not depend on the number of ranks. A single rank
sends nothing: its splats stay on the device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import add, or_
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from typing_extensions import override

from drgs.cameras.camera import Camera, cameras_in_time
from drgs.core.arrays import (
    Array,
    Rows,
    block_widths,
    empty_on_host,
    from_host,
    types_of,
    wrap_numpy,
)
from drgs.core.constants import MAX_SHUTTER_SAMPLES
from drgs.core.types import Array2f, Bool, Float, UInt32
from drgs.effects.compose import with_effects, without_effects
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.sensors import (
    accumulate_in_sensor,
    attached_cameras,
    camera_from_sensor,
    read_sensor,
)
from drgs.integrator.state import SplatsPlugin
from drgs.splatting.rasterize import SplatGradients
from drgs.splatting.rendering import (
    NO_FAULT,
    CameraGradients,
    Frame,
    GaussianGradients,
    Pipeline,
    ProjectionStage,
    gradients_by_row,
    sum_of_gradients,
    sum_of_views,
    weighted_sums,
)
from drgs.splatting.tiles import SplatTable
from drgs.training.parallel.communicator import Communicator, wait
from drgs.training.parallel.population import renderer_of
from drgs.training.steps import StepView, ViewGradients, ViewLoss

VIEWS_AT_ONCE = 4
"""Number of views whose derivatives one kernel adds; each makes it longer to compile.
"""

Blocks = list[np.ndarray]
"""Rows of numbers as they travel: (M, columns) for each block of :class:`drgs.core.arrays.Rows`."""

BOX_NUMBERS = 4  # numbers of a splat's box of tiles: see :class:`drgs.splatting.tiles.SplatTable`


@dataclass(frozen=True, eq=False)
class LocalProjection:
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
            return _empty_blocks(0, self.widths, float_type)
        boxes, stored = (Rows.from_columns(each.load(rows)) for each in (splats.boxes, splats.rows))
        depths = dr.gather(float_type, splats.depths, rows)
        dr.eval(boxes, stored, depths)
        flat = [*boxes.blocks, *stored.blocks, depths]
        return [each.numpy().reshape(count, -1) for each in flat]

    def unpack(self, rows: UInt32, blocks: Blocks, width: int) -> list[Float]:
        """Return columns for all rows of this rank: the blocks' numbers of ``rows``, else 0."""
        t, count = types_of(self.boxes.Float), dr.width(rows)
        if count == 0:
            return [dr.zeros(t.Float, self.num_rows) for _ in range(width)]
        nowhere = 0xFFFFFFFF
        place = dr.full(t.UInt32, nowhere, self.num_rows)
        dr.scatter(place, dr.arange(t.UInt32, count), rows)
        dr.eval(place)
        received = Rows(tuple(wrap_numpy(t.Float, block) for block in blocks), width)
        return received.load(place, place != nowhere)


def _empty_blocks(count: int, widths: Sequence[int], float_type: type) -> Blocks:
    """Return memory for rows to receive, aligned as Dr.Jit's is."""
    return [empty_on_host(float_type, (count, width)) for width in widths]


def _concatenate(parts: Sequence[SplatTable]) -> SplatTable:
    """Return the splats of several ranks behind one another."""
    if len(parts) == 1:
        return parts[0]

    def concatenate(each: Sequence[Rows]) -> Rows:
        columns = zip(*(rows.blocks for rows in each), strict=True)
        return Rows(tuple(dr.concat(list(blocks)) for blocks in columns), each[0].width)

    boxes, rows = (concatenate([getattr(p, name) for p in parts]) for name in ("boxes", "rows"))
    depths = dr.concat([part.depths for part in parts])
    return SplatTable(boxes, rows, depths, parts[0].num_features, parts[0].num_keys)


@dataclass(eq=False)
class _View:
    """A view of the step, with this rank's results; lists are by time."""

    view: StepView
    renderer: int  # the rank that renders it
    counts: np.ndarray = field(init=False)  # (ranks, times): splats sent to the renderer
    local: list[LocalProjection] = field(default_factory=list)
    rows: list[UInt32] = field(default_factory=list)  # sent to another renderer, ascending
    frames: list[Frame] = field(default_factory=list)  # until the backward pass has ended
    gradients: list[SplatGradients] = field(default_factory=list)  # own rows, until they are added
    means2d: Array2f = field(init=False)  # derivatives with respect to own rows' places on the film
    sums: dict[str, Float] = field(default_factory=dict)  # see DensityStrategy.pixel_weights
    needs_camera: bool = False
    first_nonfinite: UInt32 = field(init=False)


class ViewExchange(ProjectionStage):
    """The projection of a step's views, and the way back of their derivatives."""

    def __init__(
        self,
        comm: Communicator,
        integrator: SplatsPlugin,
        params: mi.SceneParameters,
        views_per_step: int,
    ) -> None:
        """params: the parameters of the Gaussians."""
        self.comm, self.integrator, self.params = comm, integrator, params
        self.views_per_step = views_per_step
        self._sending: list[tuple[Any, np.ndarray]] = []  # requests and their data
        self._views: list[_View] = []
        self._current: _View | None = None  # is rendered now; None: between two steps
        self._num_added = 0  # views whose derivatives have been added
        integrator.use_projection(self)

    def begin(self, views: Sequence[StepView], place: Callable[[StepView], None]) -> None:
        """Project the rows of this rank for the views of other ranks.

        place: puts the sensor of such a view where it is now.
        """
        size, num = self.comm.size, self.views_per_step
        self._views = [_View(view, renderer_of(view.place, num, size)) for view in views]
        self._num_added = 0
        if size == 1:
            return
        for each in self._views:
            if each.renderer != self.comm.rank:
                place(each.view)
        cameras = [self._cameras(each.view) for each in self._views]
        packed, own = [], []
        for each, in_time in zip(self._views, cameras, strict=True):
            is_sent = each.renderer != self.comm.rank
            packed.append(self._project(each, in_time) if is_sent else [])
            own.append([dr.width(rows) for rows in each.rows] if is_sent else [0] * len(in_time))
        counts = self.comm.all_gather(np.concatenate(own))
        ends = np.cumsum([len(of_view) for of_view in own])
        split = np.split(counts, ends[:-1], axis=1)
        for each, of_view, blocks_in_time in zip(self._views, split, packed, strict=True):
            each.counts = of_view
            for time, blocks in enumerate(blocks_in_time):
                self._send(blocks, each.renderer, each, time)

    def own_views(self) -> Iterator[StepView]:
        """Yield the views that this rank renders; each is rendered before the next is requested."""
        for each in self._views:
            if each.renderer == self.comm.rank:
                self._current = each
                self.integrator.forget_frames()  # splats of other ranks arrive anew
                yield each.view
        self._current = None

    def end_view(self, weights: Mapping[str, Float]) -> None:
        """End the backward pass of a view; weights: planes for weighted sums, by name."""
        each = self._current
        assert each is not None, "a view is rendered"
        for name, plane in weights.items():
            sums = []
            for time, frame in enumerate(each.frames):
                own = self._divide(each, time, weighted_sums(frame, plane))
                sums.append(own[0])
            each.sums[name] = sum(sums[1:], sums[0]) / len(sums)
        each.frames.clear()
        self._add_ready_views(is_end=False)

    def finish(self, names: Sequence[Sequence[str]]) -> list[ViewGradients]:
        """Return the gradients of all views; their sum is in the parameters now.

        names: of each view's planes for weighted sums.
        """
        for each, weights in zip(self._views, names, strict=True):
            if each.renderer != self.comm.rank:
                self._receive_results(each, weights)
        self._add_ready_views(is_end=True)
        wait(*(request for request, _ in self._sending))
        self._sending.clear()
        results = []
        for each in self._views:
            visible = reduce(or_, (local.visible for local in each.local))
            results.append(ViewGradients(each.means2d, visible, each.sums, each.first_nonfinite))
        return results

    def share_losses(self, losses: Mapping[int, ViewLoss]) -> list[ViewLoss]:
        """Return the losses of all views, by place in the step; losses: of views rendered here."""
        if self.comm.size == 1:
            return list(losses.values())
        numbers = np.zeros((len(self._views), 3))
        for place, found in losses.items():
            numbers[place] = float(found.loss[0]), float(found.squared_error[0]), found.counted
        numbers = self.comm.all_gather(numbers).sum(axis=0)  # 0 for other ranks
        loss, error = numbers[:, :2].astype(np.float32).T
        rows = zip(loss[:, None], error[:, None], numbers[:, 2], strict=True)
        return [ViewLoss(*row) for row in rows]

    def share(self, view: StepView, value: Array) -> Array:
        """Return an array of the rank that renders a view; others give one of the same size."""
        if self.comm.size == 1:
            return value
        renderer = self._views[view.place].renderer
        return type(value)(self.comm.broadcast(np.array(value, np.float32), renderer))

    @override
    def project(self, gaussians: Gaussians, camera: Camera, pipeline: Pipeline) -> SplatTable:
        """Return the splats of all ranks, behind one another, as ``camera`` sees them.

        Between two steps, of this rank only.
        """
        if (each := self._current) is None:
            return super().project(gaussians, camera, pipeline)
        time = len(each.local)
        own = super().project(gaussians, camera, pipeline)
        counts = own.rows.width, own.num_features, own.num_keys
        local = LocalProjection(camera, pipeline, own.boxes, *counts)
        each.local.append(local)
        parts = []
        for rank in range(self.comm.size):
            if rank == self.comm.rank:
                parts.append(own)
            elif (count := int(each.counts[rank, time])) > 0:
                blocks = _empty_blocks(count, local.widths, own.rows.Float)
                self._receive(blocks, rank, each, time)
                parts.append(local.table(blocks))
        return _concatenate(parts)

    @override
    def gradients(
        self, gaussians: Gaussians, frame: Frame, of_splats: SplatGradients, with_camera: bool
    ) -> GaussianGradients:
        """Return derivatives with respect to splats to the ranks that have projected them."""
        if (each := self._current) is None:
            return super().gradients(gaussians, frame, of_splats, with_camera)
        time = len(each.gradients)
        columns = self._divide(each, time, [*of_splats.geometry, *of_splats.features])
        each.gradients.append(each.local[time].gradients(columns))
        each.frames.append(frame)
        each.needs_camera = with_camera
        t = types_of(type(of_splats.opacities))
        return GaussianGradients(None, dr.zeros(t.Array2f), t.Bool(False), t.UInt32(NO_FAULT))

    def _cameras(self, view: StepView) -> list[Camera]:
        """Return the view's cameras by time, detached."""
        state = read_sensor(view.view.sensor, self.integrator.near)
        camera = without_effects(camera_from_sensor(state.detach()), self.integrator.ignore)
        return cameras_in_time(camera)

    def _project(self, each: _View, cameras: Sequence[Camera]) -> list[Blocks]:
        """Project the rows of this rank for a view that another renders.

        Returns those on its film, by time. The host reads their number.
        """
        packed = []
        each.needs_camera = read_sensor(each.view.view.sensor, self.integrator.near).is_attached
        with dr.suspend_grad():
            gaussians, pipeline = dr.detach(self.integrator.gaussians), self.integrator.pipeline
            for camera in cameras:
                composed = with_effects(pipeline, gaussians, camera)
                splats = super().project(gaussians, camera, composed)
                counts = splats.rows.width, splats.num_features, splats.num_keys
                local = LocalProjection(camera, composed, splats.boxes, *counts)
                rows = cast(UInt32, dr.compress(local.visible))
                each.local.append(local)
                each.rows.append(rows)
                packed.append(local.pack(splats, rows))
        return packed

    def _divide(self, each: _View, time: int, columns: list[Float]) -> list[Float]:
        """Send numbers of a rendered view's splats to their ranks; return those of this rank."""
        if self.comm.size == 1:
            return columns
        ranks = range(self.comm.size)
        counts = each.counts[:, time].copy()
        counts[self.comm.rank] = each.local[time].num_rows
        ends = np.cumsum(counts)
        rows = Rows.from_columns(columns)
        dr.eval(rows)
        widths = block_widths(rows.width)
        blocks = [b.numpy().reshape(-1, w) for b, w in zip(rows.blocks, widths, strict=True)]
        starts = [0, *ends[:-1]]
        for rank, start, end in zip(ranks, starts, ends, strict=True):
            if rank != self.comm.rank and end > start:
                part = [block[start:end] for block in blocks]
                self._send(part, rank, each, time)
        index_type = types_of(rows.Float).UInt32
        first = dr.opaque(index_type, int(starts[self.comm.rank]))
        return rows.load(dr.arange(index_type, each.local[time].num_rows) + first)

    def _receive_results(self, each: _View, weights: Sequence[str]) -> None:
        """Receive derivatives and weighted sums of this rank's rows from the view's renderer."""

        def receive_columns(time: int, width: int) -> list[Float]:
            local, rows = each.local[time], each.rows[time]
            count = dr.width(rows)
            blocks = _empty_blocks(count, block_widths(width), local.boxes.Float)
            if count > 0:
                self._receive(blocks, each.renderer, each, time)
            return local.unpack(rows, blocks, width)

        times = range(len(each.local))
        for time, local in enumerate(each.local):
            columns = receive_columns(time, local.num_stored - local.num_keys)
            each.gradients.append(local.gradients(columns))
        for name in weights:
            sums = [receive_columns(time, 1)[0] for time in times]
            each.sums[name] = sum(sums[1:], sums[0]) / len(sums)

    def _send(self, blocks: Blocks, to: int, each: _View, time: int) -> None:
        """Start to send rows of a view; rows of one view and time arrive in their order."""
        tag = each.view.place * MAX_SHUTTER_SAMPLES + time
        self._sending += [(self.comm.send(block, to, tag), block) for block in blocks]

    def _receive(self, into: Blocks, source: int, each: _View, time: int) -> None:
        tag = each.view.place * MAX_SHUTTER_SAMPLES + time
        wait(*(self.comm.receive(block, source, tag) for block in into))

    def _add_ready_views(self, is_end: bool) -> None:
        """Add the derivatives of the next groups of views that have arrived completely.

        Derivatives of cameras need all ranks, and wait for the end of the step.
        """
        while self._num_added < len(self._views):
            group = self._views[self._num_added :][:VIEWS_AT_ONCE]
            is_whole = len(group) == VIEWS_AT_ONCE or is_end
            if not (is_whole and all(each.gradients for each in group)):
                return
            if any(each.needs_camera for each in group):
                if not is_end:
                    return
                for each in group:
                    self._add_with_camera(each)
            else:
                self._add(group)
            for each in group:
                each.means2d = reduce(add, (gradients.means2d for gradients in each.gradients))
                dr.eval(each.means2d)  # or it would hold all that came with it
                each.gradients.clear()
            self._num_added += len(group)

    def _add(self, group: Sequence[_View]) -> None:
        """Add the derivatives of some views to the step's."""
        with dr.suspend_grad():
            gaussians = dr.detach(self.integrator.gaussians)
            seen = [
                [CameraGradients(p.camera, p.pipeline, g) for p, g in zip(*pairs, strict=True)]
                for pairs in ((each.local, each.gradients) for each in group)
            ]
            total, faults = sum_of_views(gaussians, seen)
        self._accumulate(total)
        for each, fault in zip(group, faults, strict=True):
            each.first_nonfinite = fault

    def _add_with_camera(self, each: _View) -> None:
        """Add the derivatives of a view, and those of its camera, which its renderer sums.

        Each rank adds the terms of its rows, which are summed as if one rank had them all.
        """
        with dr.suspend_grad():
            gaussians, found, of_cameras = dr.detach(self.integrator.gaussians), [], []
            for local, gradients in zip(each.local, each.gradients, strict=True):
                seen = CameraGradients(local.camera, local.pipeline, gradients)
                of_view, of_rows = gradients_by_row(gaussians, seen, with_camera=True)
                found.append(of_view)
                rows = np.stack([np.array(column) for column in of_rows], axis=1)
                rows = self.comm.gather_rows(rows, each.renderer)
                if rows is not None:
                    sums = [dr.sum(from_host(type(of_rows[0]), column)) for column in rows.T]
                    of_cameras.append(sums)
            total = reduce(sum_of_gradients, found)
        assert total.parameters is not None, "they are requested"
        self._accumulate(total.parameters)
        each.first_nonfinite = total.first_nonfinite
        if of_cameras:
            state = read_sensor(each.view.view.sensor, self.integrator.near)
            cameras = attached_cameras(state, self.integrator.ignore)
            accumulate_in_sensor(cameras, of_cameras)

    def _accumulate(self, gradients: Gaussians) -> None:
        for name, parameter in self.params.items():
            dr.accum_grad(parameter, getattr(gradients, name))
