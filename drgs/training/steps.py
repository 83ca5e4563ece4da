"""Steps of a fit: the views of an iteration, their size, and their gradients.

A phase trains on images of one size. A step ends with one change of the Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import chain, islice

import numpy as np

from drgs.config.schema import FitConfig
from drgs.core.arrays import Array
from drgs.core.types import Array2f, Bool, Float, TensorXf, UInt32
from drgs.datasets.images import is_on_disk, shift_pixels, smaller_view
from drgs.datasets.types import View
from drgs.effects.base import TrainingEffect
from drgs.integrator.scene import make_sensors
from drgs.integrator.state import SplatsPlugin
from drgs.training.losses import target_bytes
from drgs.training.rates import LearningRates
from drgs.training.views import TrainingView

MAX_TARGET_BYTES = 2 << 30
"""Most memory of targets and effects' uploads that stay on the device until their view is drawn
again: 350 images of 400 x 400 px. Recomputing one takes a tenth of an iteration, or a fifth where
the file has four times the pixels."""


@dataclass(eq=False)
class ResolutionPhase:
    """Iterations that train on images of one size."""

    until: float  # last iteration
    shifted: list[list[TrainingView]]  # of each view, itself first: see images.shift_pixels
    upload_bytes: int  # memory of a pixel in effects' uploads
    room: int  # bytes left for targets and uploads that stay on the device
    kept: set[TrainingView] = field(default_factory=set)  # their views

    @property
    def views(self) -> list[TrainingView]:
        """The training views, not shifted."""
        return [views[0] for views in self.shifted]

    def view(self, index: int, iteration: int) -> TrainingView:
        """Return the view of an index for an iteration: its shifted ones take turns by round."""
        views = self.shifted[index]
        return views[(iteration - 1) // len(self.shifted) % len(views)]

    def keep_or_free(self, view: TrainingView) -> None:
        """Keep targets and uploads of a rendered view while there is room, else free them.

        Recent views are no more likely to be drawn next than the first ones.
        """
        if view in self.kept:
            return
        size = target_bytes(view.height, view.width)
        size += view.width * view.height * self.upload_bytes
        if size > self.room:
            view.free()
        else:
            self.room -= size
            self.kept.add(view)

    def end(self) -> None:
        """Free kept targets and uploads: the phase is over."""
        for view in self.kept:
            view.free()
        self.kept.clear()


def make_phases(
    views: tuple[View, ...], config: FitConfig, effects: Sequence[TrainingEffect], room: int
) -> list[ResolutionPhase]:
    """Return the phases of the configuration: coarse ones, and the last one with full images.

    room: bytes of targets and uploads that may stay on the device. None do where photographs are
    on disk: what is read ahead costs no time.
    """
    room = 0 if any(map(is_on_disk, views)) else min(room, MAX_TARGET_BYTES)
    sizes = [(s.until, [smaller_view(v, s.factor) for v in views]) for s in config.coarse]
    upload_bytes = sum(effect.upload_bytes for effect in effects)
    is_refined = any(effect.moves_sensors for effect in effects)
    phases = []
    for until, resized in [*sizes, (math.inf, views)]:
        shifted = [(view,) if is_refined else shift_pixels(view) for view in resized]
        sensors = iter(make_sensors(list(chain(*shifted)), calibrated=is_refined))
        training_views = [
            [TrainingView(view, index, next(sensors), effects) for view in views_of_one]
            for index, views_of_one in enumerate(shifted)
        ]
        phases.append(ResolutionPhase(until, training_views, upload_bytes, room))
    return phases


NUM_AHEAD = 2  # views that are read besides that of the iteration


class ReadAhead:
    """Reads the next photographs that a process renders, if they are on disk, in a thread."""

    def __init__(self, views: Sequence[View], own: Collection[int]) -> None:
        """views: the training views; own: indices of those that this process renders."""
        self._own = {index for index in own if is_on_disk(views[index])}
        self._thread = ThreadPoolExecutor(1, "read-ahead")  # starts with its first task

    def __call__(self, coming: Iterable[TrainingView]) -> None:
        """Start to read the first of the coming views; an error is raised where one is used."""
        if self._own:
            own = (view for view in coming if view.index in self._own)
            for view in islice(own, 1 + NUM_AHEAD):
                view.read_ahead(self._thread)


@dataclass(frozen=True)
class StepView:
    """A view that a step renders: one iteration."""

    iteration: int
    place: int  # in the step, from 0
    view: TrainingView


@dataclass(frozen=True)
class Step:
    """The iterations between two changes of the Gaussians, one for each view."""

    iterations: range
    phase: ResolutionPhase  # of the image size that is in use
    begins_phase: bool
    views: tuple[StepView, ...]  # by iteration
    num_averaged: int  # batch size
    is_update: bool  # whether the optimizer steps at its end

    @property
    def last_iteration(self) -> int:
        """The last iteration."""
        return self.iterations[-1]


def plan_step(
    iteration: int, config: FitConfig, rates: LearningRates, phases: Sequence[ResolutionPhase]
) -> Step:
    """Return the step that an iteration is part of; iteration 0 is the start of a fit."""
    views_per_step = config.optimizer.views_per_step
    iterations = step_of(iteration, views_per_step, config.iterations)
    first, last = iterations[0], iterations[-1]
    phase = next(phase for phase in phases if first <= phase.until)
    is_late = rates.means.progress(first) > config.optimizer.views_from
    is_settled = first >= config.densify.first_fixed_iteration(config.iterations)
    late_views = config.optimizer.views if is_late and is_settled else 1
    order = len(phase.shifted), config.seed, views_per_step
    places = ((i, phase.view(view_of(i, *order), i)) for i in iterations if i > 0)
    views = [StepView(i, i - first, view) for i, view in places]
    return Step(
        iterations=iterations,
        phase=phase,
        begins_phase=any(first - views_per_step <= each.until < first for each in phases),
        views=tuple(views),
        num_averaged=max(late_views, len(iterations)),
        is_update=late_views <= views_per_step or last % late_views == 0,
    )


def step_of(iteration: int, views_per_step: int, iterations: int) -> range:
    """Return the iterations of the step that this one is part of; iterations: of the fit.

    The last step of a fit may have fewer views than others.
    """
    first = (iteration - 1) // views_per_step * views_per_step + 1
    end = first + views_per_step
    if iteration > iterations:  # a caller continues a finished fit
        return range(max(first, iterations + 1), end)
    return range(first, min(end, iterations + 1))


def view_of(iteration: int, num_views: int, seed: int, views_per_step: int = 1) -> int:
    """Return the view of an iteration: each round visits all views in a random order.

    With B views a step, the b-th iteration of each step draws from the views b, b + B, ... alone,
    in rounds of these: its process needs no other photographs.
    """
    which_step, place = divmod(iteration - 1, views_per_step)
    own = range(place % num_views, num_views, views_per_step)
    which_round, position = divmod(which_step, len(own))
    key = [seed, which_round, place] if views_per_step > 1 else [seed, which_round]
    order = np.random.default_rng(key).permutation(len(own))
    return own[int(order[position])]


@dataclass(frozen=True)
class ViewGradients:
    """The backward pass of one view; N are the rows that this process has."""

    means2d_grad: Array2f | TensorXf  # (N, 2): derivative of the step's loss, per px
    visible: Bool  # (N,): the splat's extent touches the film
    weighted_sums: Mapping[str, Float]  # (N,), by name: see DensityStrategy.pixel_weights
    first_nonfinite: UInt32  # (1,): see drgs.splatting.rendering.decode_nonfinite


@dataclass(frozen=True)
class ViewLoss:
    """Loss and error of the view of an iteration."""

    loss: Float  # one entry
    squared_error: Float  # one entry: mean over pixels and channels
    counted: float  # share of the pixels that count


class OneView:
    """The gradients of steps of one view, which ``dr.backward`` leaves in the parameters.

    :class:`drgs.training.parallel.several_views.SeveralViews` has those of longer steps.
    """

    def __init__(self, integrator: SplatsPlugin) -> None:
        self.integrator = integrator
        self._views: Sequence[StepView] = ()
        self._sums: Mapping[str, Float] = {}

    def begin(self, views: Sequence[StepView], move_sensor: Callable[[StepView], None]) -> None:
        """Start a step of one view."""
        self._views = views

    def own_views(self) -> Sequence[StepView]:
        """Return the step's view."""
        return self._views

    def begin_view(self, view: StepView) -> None:
        """Do nothing: the integrator renders its own Gaussians."""

    def end_view(self, view: StepView, weights: Mapping[str, Float]) -> None:
        """Keep the weighted sums of the view."""
        last = self.integrator.last
        self._sums = {name: last.weighted_sums(plane) for name, plane in weights.items()}

    def finish(self, names: Sequence[Sequence[str]]) -> list[ViewGradients]:
        """Return the view's gradients."""
        last = self.integrator.last
        return [ViewGradients(last.means2d_grad, last.visible, self._sums, last.first_nonfinite)]

    def share_losses(self, losses: Mapping[int, ViewLoss]) -> list[ViewLoss]:
        """Return the losses of all views."""
        return list(losses.values())

    def share(self, view: StepView, value: Array) -> Array:
        """Return the value."""
        return value
