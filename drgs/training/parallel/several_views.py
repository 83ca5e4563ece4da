"""Gradients of a step of several views, on one process or several.

Every rank holds some rows of the Gaussians, and renders some views of a step. It projects its rows
for the cameras of all views; the integrator renders a view from the projected splats of all ranks,
and returns their derivatives, which each rank propagates through the projection of its rows. Rows
are ordered by rank, and each rank adds the views in their order, so the bytes do not depend on the
number of ranks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import add, or_

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.cameras.camera import Camera, cameras_in_time
from drgs.core.arrays import Array, from_host
from drgs.core.types import Array2f, Float, UInt32
from drgs.effects.compose import with_effects, without_effects
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.sensors import (
    accumulate_in_sensor,
    attached_cameras,
    camera_from_sensor,
    read_sensor,
)
from drgs.integrator.state import ProjectedView, SplatsPlugin
from drgs.splatting.rasterize import SplatGradients
from drgs.splatting.rendering import (
    CameraGradients,
    gradients_by_row,
    project_splats,
    sum_of_gradients,
    sum_of_views,
    weighted_sums,
)
from drgs.splatting.tiles import SplatTable
from drgs.training.parallel.communicator import Communicator
from drgs.training.parallel.exchange import Blocks, LocalSplats, SharedView, SplatExchange
from drgs.training.parallel.population import renderer_of
from drgs.training.steps import StepView, ViewGradients, ViewLoss

VIEWS_AT_ONCE = 4
"""Number of views whose derivatives one kernel adds; each makes it longer to compile."""


@dataclass(eq=False)
class _View(SharedView):
    gradients: list[SplatGradients] = field(default_factory=list)  # by time, until they are added
    means2d: Array2f = field(init=False)  # derivatives with respect to own rows' places on the film
    sums: dict[str, Float] = field(default_factory=dict)  # see DensityStrategy.pixel_weights
    needs_camera: bool = False
    first_nonfinite: UInt32 = field(init=False)


class SeveralViews:
    """The gradients of steps of several views: see :class:`drgs.training.steps.OneView`."""

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
        self._exchange = SplatExchange(comm)
        self._views: list[_View] = []

    def begin(self, views: Sequence[StepView], move_sensor: Callable[[StepView], None]) -> None:
        """Project own rows for other ranks' views; move_sensor: brings a view's sensor in place."""
        size, num = self.comm.size, self.views_per_step
        self._views = [_View(view, renderer_of(view.place, num, size)) for view in views]
        if size == 1:
            return
        sent = [each for each in self._views if each.renderer != self.comm.rank]
        for each in sent:
            move_sensor(each.view)
        num_times = [len(self._cameras(each.view)) for each in self._views]
        packed: dict[SharedView, list[Blocks]] = {}
        for each in sent:
            packed[each] = self._exchange.pack(each, self._project(each))
        self._exchange.send_splats(self._views, num_times, packed)

    def own_views(self) -> list[StepView]:
        """Return the views that this rank renders, between :meth:`begin_view`, :meth:`end_view`."""
        return [each.view for each in self._views if each.renderer == self.comm.rank]

    def begin_view(self, view: StepView) -> None:
        """Let the integrator render a view's splats, of all ranks."""
        each = self._views[view.place]
        splats = [
            self._exchange.receive_splats(each, time, own)
            for time, own in enumerate(self._project(each))
        ]
        self.integrator.projected_view = ProjectedView(splats)

    def end_view(self, view: StepView, weights: Mapping[str, Float]) -> None:
        """End the backward pass of a view; weights: planes for weighted sums, by name."""
        each, rendered = self._views[view.place], self.integrator.projected_view
        assert rendered is not None, "it was rendered"
        self.integrator.projected_view = None
        for time, gradients in enumerate(rendered.gradients):
            columns = [*gradients.geometry, *gradients.features]
            columns = self._exchange.return_columns(each, time, columns)
            each.gradients.append(each.local[time].gradients(columns))
        for name, plane in weights.items():
            sums = [
                self._exchange.return_columns(each, time, weighted_sums(frame, plane))[0]
                for time, frame in enumerate(rendered.frames)
            ]
            each.sums[name] = sum(sums[1:], sums[0]) / len(sums)

    def finish(self, names: Sequence[Sequence[str]]) -> list[ViewGradients]:
        """Return all views' gradients, whose sum the parameters have; names: planes by view."""
        for each, weights in zip(self._views, names, strict=True):
            if each.renderer == self.comm.rank:
                continue
            times = range(len(each.local))
            for time, local in enumerate(each.local):
                width = local.num_stored - local.num_keys
                columns = self._exchange.receive_columns(each, time, width)
                each.gradients.append(local.gradients(columns))
            for name in weights:
                sums = [self._exchange.receive_columns(each, time, 1)[0] for time in times]
                each.sums[name] = sum(sums[1:], sums[0]) / len(sums)
        self._add_all()
        self._exchange.finish()
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
        for place, one in losses.items():
            numbers[place] = float(one.loss[0]), float(one.squared_error[0]), one.counted
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

    def _cameras(self, view: StepView) -> list[Camera]:
        """Return the view's cameras by time, detached."""
        state = read_sensor(view.view.sensor, self.integrator.near)
        return cameras_in_time(without_effects(camera_from_sensor(state), self.integrator.ignore))

    def _project(self, each: _View) -> list[SplatTable]:
        each.needs_camera = read_sensor(each.view.view.sensor, self.integrator.near).is_attached
        splats = []
        with dr.suspend_grad():
            gaussians = dr.detach(self.integrator.gaussians)
            for camera in self._cameras(each.view):
                pipeline = with_effects(self.integrator.pipeline, gaussians, camera)
                table = project_splats(gaussians, camera, pipeline)
                counts = table.rows.width, table.num_features, table.num_keys
                each.local.append(LocalSplats(camera, pipeline, table.boxes, *counts))
                splats.append(table)
        return splats

    def _add_all(self) -> None:
        """Add the derivatives of all views to the parameters', a group at a time."""
        for first in range(0, len(self._views), VIEWS_AT_ONCE):
            group = self._views[first : first + VIEWS_AT_ONCE]
            if any(each.needs_camera for each in group):
                for each in group:
                    self._add_with_camera(each)
            else:
                self._add(group)
            for each in group:
                each.means2d = reduce(add, (gradients.means2d for gradients in each.gradients))
                dr.eval(each.means2d)  # or it would hold all that came with it
                each.gradients.clear()

    def _add(self, group: Sequence[_View]) -> None:
        """Add the derivatives of some views to the step's."""
        with dr.suspend_grad():
            gaussians = dr.detach(self.integrator.gaussians)
            by_view = [
                [CameraGradients(p.camera, p.pipeline, g) for p, g in zip(*pairs, strict=True)]
                for pairs in ((each.local, each.gradients) for each in group)
            ]
            total, faults = sum_of_views(gaussians, by_view)
        self._accumulate(total)
        for each, fault in zip(group, faults, strict=True):
            each.first_nonfinite = fault

    def _add_with_camera(self, each: _View) -> None:
        """Add a view's derivatives, and its camera's, which its renderer sums over all rows."""
        with dr.suspend_grad():
            gaussians, by_time, of_cameras = dr.detach(self.integrator.gaussians), [], []
            for local, gradients in zip(each.local, each.gradients, strict=True):
                given = CameraGradients(local.camera, local.pipeline, gradients)
                of_time, of_rows = gradients_by_row(gaussians, given, with_camera=True)
                by_time.append(of_time)
                rows = np.stack([np.array(column) for column in of_rows], axis=1)
                rows = self.comm.gather_rows(rows, each.renderer)
                if rows is not None:
                    sums = [dr.sum(from_host(type(of_rows[0]), column)) for column in rows.T]
                    of_cameras.append(sums)
            total = reduce(sum_of_gradients, by_time)
        self._accumulate(total.parameters)
        each.first_nonfinite = total.first_nonfinite
        if of_cameras:
            state = read_sensor(each.view.view.sensor, self.integrator.near)
            accumulate_in_sensor(attached_cameras(state, self.integrator.ignore), of_cameras)

    def _accumulate(self, gradients: Gaussians) -> None:
        for name, parameter in self.params.items():
            dr.accum_grad(parameter, getattr(gradients, name))
