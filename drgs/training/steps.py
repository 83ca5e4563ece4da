"""Steps of a fit: which iterations share a change of the Gaussians, and which views they render."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drgs.config.schema import FitConfig
from drgs.training.rates import LearningRates
from drgs.training.stages import Stage
from drgs.training.views import TrainingView


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
    stage: Stage  # of the image size that is in use
    begins_stage: bool
    views: tuple[StepView, ...]  # by iteration
    num_averaged: int  # views whose mean gradient the optimizer steps along
    is_update: bool  # whether the optimizer steps at its end

    @property
    def last(self) -> int:
        """Its last iteration."""
        return self.iterations[-1]


def plan_step(
    iteration: int, config: FitConfig, rates: LearningRates, stages: Sequence[Stage]
) -> Step:
    """Return the step that an iteration is part of; iteration 0 stands for the start of a fit."""
    views_per_step = config.optimizer.views_per_step
    iterations = step_of(iteration, views_per_step, config.iterations)
    first, last = iterations[0], iterations[-1]
    stage = next(stage for stage in stages if first <= stage.until)
    late = _late_views(first, config, rates)
    return Step(
        iterations=iterations,
        stage=stage,
        begins_stage=any(first - views_per_step <= each.until < first for each in stages),
        views=tuple(
            StepView(i, i - first, stage.views[_view_of(i, len(stage.views), config)])
            for i in iterations
            if i > 0
        ),
        num_averaged=max(late, len(iterations)),
        is_update=late <= views_per_step or last % late == 0,
    )


def _late_views(first: int, config: FitConfig, rates: LearningRates) -> int:
    """Return ``optimizer.views`` late in the fit, 1 before."""
    is_late = rates.means.progress(first) > config.optimizer.views_from
    is_settled = first >= config.densify.settled_from(config.iterations)
    return config.optimizer.views if is_late and is_settled else 1


def _view_of(iteration: int, num_views: int, config: FitConfig) -> int:
    return view_of(iteration, num_views, config.seed, config.optimizer.views_per_step)


def step_of(iteration: int, views_per_step: int, iterations: int) -> range:
    """The iterations of the step that this one is part of; iterations: of the fit.

    The last step of a fit may have fewer views than others.
    """
    first = (iteration - 1) // views_per_step * views_per_step + 1
    end = first + views_per_step
    if iteration > iterations:  # somebody goes on with a fit that is done
        return range(max(first, iterations + 1), end)
    return range(first, min(end, iterations + 1))


def view_of(iteration: int, num_views: int, seed: int, views_per_step: int = 1) -> int:
    """Return the view of an iteration: every round visits all views in an order of its own.

    With B views a step, the b-th iteration of each step draws from the views b, b + B, ... alone,
    in rounds of these: who computes it needs no other photographs.

    A function of its arguments alone, so that a fit can be resumed at any iteration.
    """
    which_step, place = divmod(iteration - 1, views_per_step)
    own = range(place % num_views, num_views, views_per_step)
    which_round, position = divmod(which_step, len(own))
    key = [seed, which_round, place] if views_per_step > 1 else [seed, which_round]
    order = np.random.default_rng(key).permutation(len(own))
    return own[int(order[position])]
