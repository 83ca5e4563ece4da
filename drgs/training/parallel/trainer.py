"""The training loop of several processes; the same bytes as one process gives.

A step of B views is taken in three parts: every process projects its rows for the cameras of all
views, and sends what they see (``drgs.training.parallel.exchange``); renders the views that are its
own, and sends derivatives back; and takes those of its rows, view by view in the order of the step,
through the projection into the gradients that its optimizer steps along. Sums over views are
therefore added up by the owner of a row, in the same order for any number of processes.

What a strategy of density takes note of stays with the rows. When it acts, it is told everywhere
what all have found, which is a number or two of each row, and decides everywhere alike.
"""

from __future__ import annotations

import json
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.cameras.camera import cameras_in_time
from drgs.config.schema import FitConfig
from drgs.core.arrays import block_widths, from_host
from drgs.core.errors import UserError
from drgs.datasets.types import Dataset
from drgs.effects.compose import composed, ignoring
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.integrator.view import accumulate_in_sensor
from drgs.splatting.rendering import (
    NO_FAULT,
    Frame,
    SeenSplats,
    gradients_by_row,
    sum_of_gradients,
    weighted_sums,
)
from drgs.training.deferred import VIEWS_AT_ONCE
from drgs.training.density.strategy import DensityReport, SeenStep
from drgs.training.finite_checks import NonFiniteError
from drgs.training.memory import ALONE, Share
from drgs.training.parallel.exchange import (
    Blocks,
    Post,
    Received,
    Sight,
    empty_blocks,
    joined,
)
from drgs.training.parallel.ranks import Ranks
from drgs.training.parallel.shards import (
    AgreedError,
    Shard,
    SpreadPopulation,
    renderer_of,
    too_few,
)
from drgs.training.trainer import DENSITY, PREFIX, SeenView, Trainer, Waiting

NEVER = 2**62
"""The iteration of no fault."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A view that this process has rendered."""

    frames: list[Frame]  # by time
    image: Any  # as compared, (H, W, 3)
    photograph: Any


class DistributedTrainer(Trainer):
    """A process's part of a fit: an interval of the rows, and some of the views of each step."""

    def __init__(
        self, config: FitConfig, dataset: Dataset, gaussians: Gaussians, ranks: Ranks
    ) -> None:
        """gaussians: all of them, on each process."""
        check_can_be_shared(config, ranks.size, gaussians.num_gaussians)
        self.ranks, self.post = ranks, Post(ranks)
        self.shard = Shard(gaussians.num_gaussians, ranks.rank, ranks.size)
        self._at_start: Gaussians | None = gaussians
        super().__init__(config, dataset, self.shard.of(gaussians))
        self._at_start = None

    def _room(self, gaussians: Gaussians, share: Share = ALONE) -> int:
        """See :meth:`Trainer._room`: pictures show the Gaussians of all processes."""
        del gaussians, share
        room, refusal = 0, ""
        try:
            room = super()._room(self._at_start, Share(self.ranks.size, self.ranks.on_machine))
        except UserError as error:
            refusal = str(error)
        self._agree_on(refusal)
        return room

    def _agree_on(self, refusal: str) -> None:
        """Raise what a process has found, if any has, on all of them; refusal: empty, or that."""
        refused = self.ranks.told(np.array(bool(refusal)))
        if refused.any():
            raise AgreedError(self.ranks.text_of(int(refused.argmax()), refusal))

    def _population(self) -> SpreadPopulation:
        common = {"optimizer": self.optimizer, "prefix": PREFIX, "extent": self.extent}
        return SpreadPopulation(**common, seed=self.config.seed, ranks=self.ranks, shard=self.shard)

    @property
    def num_gaussians(self) -> int:
        """N at the moment, of all processes."""
        return self.shard.total

    def renderer_of(self, iteration: int) -> int:
        """Which process renders its view."""
        views_per_step = self.config.optimizer.views_per_step
        return renderer_of((iteration - 1) % views_per_step, views_per_step, self.ranks.size)

    def _own(self, iterations: range) -> Sequence[int]:
        return [i for i in iterations if self.renderer_of(i) == self.ranks.rank]

    # ------------------------------------------------------------------------------------------
    # A step
    # ------------------------------------------------------------------------------------------

    def _differentiate(self, iterations: range) -> list[SeenView]:
        """See :meth:`Trainer._differentiate`."""
        sights = [self._sights(iteration) for iteration in iterations]
        counts = self._counts(sights)
        for place, iteration in enumerate(iterations):
            for time, sight in enumerate(sights[place]):
                self.post.send(sight.taken_blocks(), self.renderer_of(iteration), place, time)
        found, pictures = np.zeros((len(iterations), 3)), {}
        for iteration in self._own(iterations):
            place = iterations.index(iteration)
            self.iteration = iteration
            found[place], pictures[place] = self._render(place, sights[place], counts[place])
        found = self.ranks.told(found).sum(axis=0)  # of a view, those of all but one are 0
        self.post.forget_received()
        penalties = self._go_back_penalties(len(iterations))
        losses = self._regularised_losses(found[:, 0]) if penalties else found[:, 0]
        self._add_gradients(sights, counts, pictures, losses)
        self.post.finish()
        numbers = zip(losses, found[:, 1], found[:, 2], strict=True)
        return [SeenView([loss], [error], counted) for loss, error, counted in numbers]

    def _counts(self, sights: Sequence[Sequence[Sight]]) -> list[np.ndarray]:
        """Of each view, how many splats each process sends at each time: (K, times)."""
        own = np.array([sight.count for of_view in sights for sight in of_view])
        ends = np.cumsum([len(of_view) for of_view in sights])
        return np.split(self.ranks.told(own), ends[:-1], axis=1)

    def _regularised_losses(self, losses: np.ndarray) -> np.ndarray:
        """Losses with the terms of the strategy of density.

        These are sums over all Gaussians: the sum of what processes have would be rounded
        otherwise.
        """
        losses = losses.astype(np.float32)
        for penalty in self.density.penalties(_OfAll(self.population), self.num_gaussians):
            losses = losses + np.float32(penalty[0])
        return losses

    def _end_views(self, iterations: range) -> None:
        """See :meth:`Trainer._end_views`: every process takes the steps of all views."""
        for iteration in iterations:
            view, renderer = self.view_at(iteration), self.renderer_of(iteration)
            for effect in self.effects:
                derivatives = {}
                for name, leaf in effect.leaves(view).items():
                    found = np.array(dr.grad(leaf), np.float32)
                    derivatives[name] = type(leaf)(self.ranks.from_rank(renderer, found))
                effect.after(self, view, derivatives)

    def _control_density(self) -> DensityReport | None:
        """See :meth:`Trainer._control_density`; where it refuses, all processes do alike."""
        try:
            return super()._control_density()
        except NonFiniteError:
            raise
        except UserError as error:
            raise AgreedError(str(error)) from None

    def _sights(self, iteration: int) -> list[Sight]:
        """What the view's camera sees of the rows of this process, at each time."""
        view = self.view_at(iteration)
        for effect in self.effects:
            if effect.moves_sensors:
                effect.before(self, view)
        state = read_sensor(view.sensor, self.integrator.near)
        of_camera = state.is_attached
        with dr.suspend_grad():
            camera = ignoring(camera_from_sensor(state.detached()), self.integrator.ignore)
            gaussians, pipeline = dr.detach(self.integrator.gaussians), self.integrator.pipeline
            return [
                Sight.of(gaussians, of_time, composed(pipeline, gaussians, of_time), of_camera)
                for of_time in cameras_in_time(camera)
            ]

    def _render(
        self, place: int, sights: Sequence[Sight], counts: np.ndarray
    ) -> tuple[list[float], Picture | None]:
        """Render a view of this process, and send derivatives back: loss, error, counted; picture.

        counts: splats by process and time. The picture is there if the strategy of density asks.
        """
        iteration, view = self.iteration, self.view
        received = self._received(place, sights, counts)
        for effect in self.effects:
            effect.before(self, view)
        self.integrator.source = received
        image, loss, error = self.compared(self._rendered(view), view)
        self._backward(loss)
        self.integrator.source = None
        image, loss = dr.detach(image), dr.detach(loss)
        for time, blocks in enumerate(received.blocks()):
            self.send_to_owners(blocks, counts[:, time], place, time)
        picture = None
        if self.density.gathers(iteration) and self.density.looks_at_pictures:
            frames = [of_time[0] for of_time in self.integrator.memory.rendered[0].frames]
            picture = Picture(frames, image, view.target.image)
        return [float(loss[0]), float(error[0]), view.counted], picture

    def _received(self, place: int, sights: Sequence[Sight], counts: np.ndarray) -> Received:
        """The splats of all processes."""
        in_time, float_type = [], type(self.means.array)
        for time, sight in enumerate(sights):
            ends = np.cumsum(counts[:, time])
            blocks = empty_blocks(int(ends[-1]), sight.layout.widths, float_type)
            for rank, end in enumerate(ends):
                rows = slice(end - counts[rank, time], end)
                self.post.receive([block[rows] for block in blocks], rank, place, time)
            in_time.append(joined(blocks, sight.layout, float_type))
        return Received(in_time)

    def send_to_owners(self, blocks: Blocks, counts: np.ndarray, place: int, time: int) -> None:
        """Rows for the splats of a view, to those who projected them."""
        for rank, end in enumerate(np.cumsum(counts)):
            rows = slice(end - counts[rank], end)
            self.post.send([block[rows] for block in blocks], rank, place, time)

    def receive_of_rows(
        self, sights: Sequence[Sight], place: int, width: int
    ) -> list[tuple[Sight, Blocks]]:
        """What :meth:`send_to_owners` has sent of the rows of this process, ``width`` numbers."""
        renderer, found = self.renderer_of(self.iteration), []
        for time, sight in enumerate(sights):
            blocks = empty_blocks(sight.count, block_widths(width), sight.float_type)
            self.post.receive(blocks, renderer, place, time)
            found.append((sight, blocks))
        return found

    def _add_gradients(
        self,
        sights: Sequence[Sequence[Sight]],
        counts: Sequence[np.ndarray],
        pictures: dict[int, Picture],
        losses: np.ndarray,
    ) -> None:
        """Of the rows of this process, from what has come back of all views, in their order.

        counts: splats of each view, by process and time.
        """
        iterations = self.iterations_of_step
        for first in range(0, len(iterations), VIEWS_AT_ONCE):
            places, waiting = range(len(iterations))[first : first + VIEWS_AT_ONCE], []
            means2d = {}
            for place in places:
                width = sights[place][0].layout.num_gradients
                self.iteration = iterations[place]
                arrived = self.receive_of_rows(sights[place], place, width)
                seen, fault = [sight.seen_splats(blocks) for sight, blocks in arrived], None
                means2d[place] = reduce(operator.add, (each.gradients.means2d for each in seen))
                if sights[place][0].of_camera:
                    fault, seen = self._add_with_camera(seen), []
                waiting.append(Waiting(self.iteration, [losses[place]], seen, fault))
            self._add(waiting)
            for place, view in zip(places, waiting, strict=True):
                self.iteration = view.iteration
                if self.density.gathers(view.iteration):
                    own = counts[place], means2d[place], pictures.pop(place, None)
                    self.density.gather(SharedStep(self, place, sights[place], *own))

    def _add_with_camera(self, seen: Sequence[SeenSplats]) -> Any:
        """Of the rows of this process, from one view; returns its first fault.

        What rows add to the derivatives of its camera is summed by the process that renders it, as
        if it had them all.
        """
        renderer = self.renderer_of(self.iteration)
        with dr.suspend_grad():
            gaussians, found, of_cameras = dr.detach(self.integrator.gaussians), [], []
            for each in seen:
                of_view, of_rows = gradients_by_row(
                    gaussians, each.camera, each.pipeline, each.gradients, of_camera=True
                )
                found.append(of_view)
                of_all = self.ranks.rows_on(renderer, np.stack([*map(np.array, of_rows)], axis=1))
                if of_all is not None:
                    sums = [dr.sum(from_host(type(of_rows[0]), column)) for column in of_all.T]
                    of_cameras.append(sums)
            total = reduce(sum_of_gradients, found)
            with dr.resume_grad():
                self.integrator.accumulate(self.scene, total.parameters)
        if of_cameras:
            state = read_sensor(self.view.sensor, self.integrator.near)
            accumulate_in_sensor(self.integrator, state, of_cameras)
        return total.first_fault

    def _watch(self, iteration: int, loss: Any, first_fault: Any) -> None:
        """See :meth:`Trainer._watch`; rows are counted over all processes."""
        first = dr.opaque(mi.UInt32, self.first_row * len(PARAMETER_NAMES))
        fault = dr.select(first_fault == NO_FAULT, first_fault, first_fault + first)
        super()._watch(iteration, loss, fault)

    # ------------------------------------------------------------------------------------------
    # All of it, on the first process
    # ------------------------------------------------------------------------------------------

    def gaussians(self) -> Gaussians:
        """All Gaussians as numpy arrays, on the first process; on others, their own."""
        own = super().gaussians()
        columns = {name: getattr(own, name) for name in (*PARAMETER_NAMES, "smoothing")}
        found = {}
        for name, rows in columns.items():
            of_all = None if rows is None else self.ranks.rows_on(0, rows)
            found[name] = rows if of_all is None else of_all
        return Gaussians(**found)

    @property
    def first_row(self) -> int:
        """The number of this process's first Gaussian."""
        return self.shard.own.start

    def check_iterations(self) -> None:
        """See :meth:`Trainer.check_iterations`; all processes raise the same."""
        self._agree(super().check_iterations)

    def check(self) -> None:
        """See :meth:`Trainer.check`; all processes raise the same."""
        self._agree(super().check)

    def _agree(self, check: Callable[[], None]) -> None:
        """Raise what the process has found that has found the earliest fault."""
        message, iteration = "", NEVER
        try:
            check()
        except NonFiniteError as error:
            message, iteration = str(error), error.iteration
        found = self.ranks.told(np.array(iteration))
        if found.min() < NEVER:
            message = self.ranks.text_of(int(found.argmin()), message)
            raise NonFiniteError(message, int(found.min()))

    def state(self) -> dict[str, np.ndarray]:
        """See :meth:`Trainer.state`; what concerns rows is whole on the first process alone."""
        state = super().state()
        for name in filter(self._is_by_row, state):
            array = state[name]
            rows = self.ranks.rows_on(0, array.reshape(self.population.num_own, -1))
            if rows is not None:
                shape = (-1,) if array.ndim == 1 else (self.num_gaussians, *array.shape[1:])
                state[name] = rows.reshape(shape)
        return state

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue where :meth:`state` was taken, by any number of processes.

        state: of the first process; others may give an empty one.
        """
        described = [[name, array.dtype.str, array.shape] for name, array in state.items()]
        described = json.loads(self.ranks.text_of(0, json.dumps(described)))
        (total,) = (shape[0] for name, _, shape in described if name == "means.value")
        self._agree_on(too_few(total, self.ranks.size))
        self.shard.total = total
        own, count = {}, self.shard.own.stop - self.shard.own.start
        for name, dtype, shape in described:
            array = state.get(name)
            if self._is_by_row(name):
                width = math.prod(shape) // total
                rows = None if array is None else array.reshape(total, width)
                rows = self.ranks.rows_from_first(rows, np.empty((count, width), dtype))
                own[name] = rows.reshape((-1,) if len(shape) == 1 else (count, *shape[1:]))
            else:
                array = np.empty(shape, dtype) if array is None else array
                own[name] = self.ranks.from_rank(0, array).reshape(shape)
        super().restore(own)

    def _is_by_row(self, name: str) -> bool:
        """Whether an array of the state has a row for each Gaussian, in one place each."""
        others = {f"{effect.name}/{key}" for effect in self.effects for key in effect.by_row}
        others |= {f"{DENSITY}{key}" for key in self.density.by_row}
        parameter, _, kind = name.partition(".")
        return name in others or (parameter in PARAMETER_NAMES and kind != "t")


class _OfAll(dict[str, Any]):
    """Parameters of the Gaussians of all processes, by name; fetched when they are asked for."""

    def __init__(self, population: SpreadPopulation) -> None:
        super().__init__()
        self._population = population

    def __missing__(self, name: str) -> Any:
        """A tensor of all rows."""
        value = self._population.value(name)
        self[name] = type(value)(self._population.ranks.rows_of_all(np.array(value)))
        return self[name]


class SharedStep:
    """What a strategy of density is told of a view that one process has rendered.

    It answers as :class:`drgs.training.density.strategy.SeenStep`, about the rows of this process.
    Every process asks for the same, in the same order: some answers take all of them.
    """

    def __init__(
        self,
        trainer: DistributedTrainer,
        place: int,
        sights: Sequence[Sight],
        counts: np.ndarray,
        means2d: Any,
        picture: Picture | None,
    ) -> None:
        """means2d: derivatives with respect to them, of this process's rows.

        For the others see :class:`DistributedTrainer`.
        """
        view = trainer.view
        self.iteration, self.width, self.height = trainer.iteration, view.width, view.height
        self._trainer, self._place, self._sights, self._counts = trainer, place, sights, counts
        self._means2d, self._picture = means2d, picture

    @cached_property
    def means2d_grad(self) -> Any:
        """Tensor (N, 2): see :class:`SeenStep`."""
        count, own = self._trainer.num_averaged, self._means2d
        found = mi.TensorXf(dr.ravel(own), (dr.width(own), 2))
        return found * count if count > 1 else found

    @cached_property
    def visible(self) -> Any:
        """Bool (N,): see :class:`SeenStep`."""
        ones = [np.ones((sight.count, 1), np.float32) for sight in self._sights]
        columns = [s.of_rows([each], 1)[0] for s, each in zip(self._sights, ones, strict=True)]
        return sum(columns[1:], columns[0]) > 0

    def errors_seen(self) -> Any:
        """Float (N,): see :class:`SeenStep`."""
        errors = None
        if self._picture is not None:
            image, photograph = self._picture.image, self._picture.photograph
            seen = SeenStep(
                self.iteration, *image.shape[1::-1], None, None, image, photograph, None
            )
            errors = seen.errors()
        return self.weighted_sums(errors)

    def weighted_sums(self, plane: Any) -> Any:
        """Of each Gaussian, the sum over pixels of its weight times ``plane``: Float (N,).

        plane: Float (H * W,), on the process that has rendered the view.
        """
        if self._picture is not None:
            for time, frame in enumerate(self._picture.frames):
                sums = np.array(weighted_sums(frame, plane))[:, None]
                self._trainer.send_to_owners([sums], self._counts[:, time], self._place, time)
        arrived = self._trainer.receive_of_rows(self._sights, self._place, 1)
        columns = [sight.of_rows(blocks, 1)[0] for sight, blocks in arrived]
        return sum(columns[1:], columns[0]) / len(columns)


def check_can_be_shared(config: FitConfig, size: int, num_gaussians: int) -> None:
    """Raise ``UserError`` for a fit that so many processes cannot share."""
    views = config.optimizer.views_per_step
    if views < size:
        raise UserError(
            f"optimizer.views_per_step must be at least the number of processes ({size}), which "
            f"share the views of a step, got {views}; give it with --set"
        )
    to = config.densify.prune.to
    if refusal := too_few(min(num_gaussians, to or num_gaussians), size):
        raise UserError(refusal)
