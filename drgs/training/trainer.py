"""The training loop: photographs in, Gaussians out.

Everything between two optimizer steps is visible in :meth:`Trainer.step`. The picture and its
gradients come from ``mi.render`` with the ``splats`` integrator, the steps from ``drjit.opt.Adam``,
changes of the population from a strategy of ``drgs.training.density``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.changes import changed
from drgs.config.schema import FitConfig
from drgs.core.memory import release_unused_memory
from drgs.datasets.types import Dataset, View
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.initialization.defaults import completed
from drgs.integrator.scene import make_scene, render_views
from drgs.integrator.weights import weighted_sums_of_last
from drgs.splatting.rendering import SeenSplats, sum_of_views
from drgs.training.deferred import VIEWS_AT_ONCE, Deferred
from drgs.training.density.called_for import density_strategy
from drgs.training.density.strategy import DensityReport, DensityStrategy, Population, SeenStep
from drgs.training.effects.called_for import integrator_settings, training_effects
from drgs.training.finite_checks import GradientWatch, check_values, check_view_values
from drgs.training.losses import PhotometricLoss, Target
from drgs.training.memory import ALONE, Share, room_for_targets
from drgs.training.optimizer import (
    make_optimizer,
    optimizer_state,
    pending_gradients,
    restore_optimizer,
)
from drgs.training.rates import learning_rates, rates_over_time, revised_aims, revised_stops
from drgs.training.stages import (
    KEPT_BYTES,
    Stage,
    bytes_on_device,
    make_stages,
    step_of,
    view_of,
)
from drgs.training.state_checks import DENSITY
from drgs.training.views import TrainingView

PREFIX = "integrator."
"""What precedes a parameter's name when the scene is traversed."""


@dataclass(frozen=True)
class SeenView:
    """What an iteration found of its view."""

    loss: Any  # Float, one entry
    squared_error: Any  # Float, one entry: mean over pixels and channels
    counted: float  # share of the pixels that count


@dataclass(frozen=True)
class Waiting:
    """A view whose derivatives are to be taken from its splats to the Gaussians."""

    iteration: int
    loss: Any  # Float, one entry
    seen: Sequence[SeenSplats]  # by time; none: its derivatives have been added
    first_fault: Any  # UInt32, one entry; of a view whose derivatives have been added


@dataclass(frozen=True)
class StepReport:
    """What a step did; numbers that cost a wait for the device are read on demand."""

    iteration: int  # the last one
    num_gaussians: int
    means_lr: float
    density: DensityReport | None  # None: rows are what they were
    seen: tuple[SeenView, ...]  # by iteration

    @property
    def loss(self) -> float:
        """The mean loss of the step's views."""
        return float(np.mean([float(view.loss[0]) for view in self.seen]))

    @property
    def psnr(self) -> float:
        """dB, the mean of the step's views, before the step."""
        errors = [float(view.squared_error[0]) / view.counted for view in self.seen]
        return float(np.mean([-10 * math.log10(max(error, 1e-10)) for error in errors]))

    def passes(self, every: int) -> bool:
        """Whether an iteration of this step is a multiple of ``every``."""
        return self.iteration % every < len(self.seen)


class Trainer:
    """Fits ``gaussians`` to the training views of ``dataset``."""

    def __init__(self, config: FitConfig, dataset: Dataset, gaussians: Gaussians) -> None:
        config = completed(config, dataset)
        self.config, self.dataset, self.extent = config, dataset, dataset.extent
        self.effects = training_effects(config, dataset)
        room = self._room(gaussians)
        settings = integrator_settings(self.effects)
        self.scene = make_scene(gaussians, config.model, dataset.background, **settings)
        self.integrator = self.scene.integrator()
        self.params = mi.traverse(self.scene)
        self.params.keep([PREFIX + name for name in PARAMETER_NAMES])
        initial = {key.removeprefix(PREFIX): value for key, value in self.params.items()}
        self.optimizer = make_optimizer(
            initial,
            learning_rates(config.optimizer, self.extent),
            prefix=PREFIX,
            beta_1=config.optimizer.beta_1**config.optimizer.views_per_step,
            beta_2=config.optimizer.beta_2**config.optimizer.views_per_step,
            epsilon=config.optimizer.epsilon,
        )
        self.rates = rates_over_time(config, self.extent)
        self.loss = PhotometricLoss(config.loss.dssim_weight)
        self.white_background = tuple(dataset.background) == (1.0, 1.0, 1.0)
        self.stages = make_stages(dataset.train, config, self.effects, room)
        self.population = self._population()
        self.density = self._density_from({})
        self._not_gathered: SeenStep | None = None
        self.watch = GradientWatch()
        self.iteration = 0

    def _room(self, gaussians: Gaussians, share: Share = ALONE) -> int:
        """Bytes of targets that may stay on the device."""
        of_pixel, most = bytes_on_device(self.effects), KEPT_BYTES
        return room_for_targets(self.config, self.dataset, gaussians, of_pixel, most, share)

    def _population(self) -> Population:
        return Population(self.optimizer, PREFIX, self.extent, self.config.seed)

    def step(self) -> StepReport:
        """An iteration for each view of a step, the step, now and then a change of the rows.

        An iteration renders one view. Of several views of a step (``views_per_step``), all see the
        same Gaussians, and the optimizer steps along their mean gradient.
        """
        iterations = self._begin()
        seen = self._differentiate(iterations)
        if self.ends_step:
            self._set_rates()
            self.optimizer.step()
        self._end_views(iterations)
        self._gather()
        report = self._control_density()
        for iteration in self._own(iterations):
            self.stage.seen(self.view_at(iteration))
        return StepReport(
            iteration=self.iteration,
            num_gaussians=self.num_gaussians,
            means_lr=self.means_lr,
            density=report,
            seen=tuple(seen),
        )

    def _begin(self) -> range:
        """Prepare a step, and return its iterations."""
        former, iterations = self.stage, self._step_of(self.iteration + 1)
        self.iteration = iterations[0]
        if self.stage is not former:
            former.end()
        self.integrator.sh_degree = self.sh_degree
        self.params.update(self.optimizer)
        for effect in self.effects:
            effect.begin(self)
        return iterations

    def _own(self, iterations: range) -> Sequence[int]:
        """Those whose views are rendered here: all of them, unless there are other processes."""
        return iterations

    def _differentiate(self, iterations: range) -> list[SeenView]:
        """Add up the derivatives of the mean loss of a step's views; ends at the last iteration."""
        seen, waiting = [], []
        penalties = self._go_back_penalties(len(iterations))
        for iteration in iterations:
            self._gather()  # of the view before, whose frames make room
            self.iteration, view = iteration, self.view_at(iteration)
            for effect in self.effects:
                effect.before(self, view)
            self.integrator.source = source = Deferred()
            image, loss, error = self.compared(self._rendered(view), view)
            self._backward(loss)
            self.integrator.source = None
            image, loss = dr.detach(image), dr.detach(sum(penalties, loss))
            if self.density.gathers(iteration):
                self._not_gathered = self._seen_step(image, view.target)
            seen.append(SeenView(loss, error, view.counted))
            last = self.integrator.last
            waiting.append(Waiting(iteration, loss, source.taken(), last.first_fault))
            if len(waiting) == VIEWS_AT_ONCE or iteration == iterations[-1]:
                self._add(waiting)
                waiting.clear()
        return seen

    def _go_back_penalties(self, count: int) -> list[Any]:
        """Terms of the strategy of density; their derivatives are added for so many views."""
        terms = list(self.density.penalties(self.parameters, self.num_gaussians))
        if terms:
            weight = self.num_averaged / count
            total = sum(terms[1:], terms[0])
            dr.backward(total / weight if weight > 1 else total)
        return [dr.detach(term) for term in terms]

    def _add(self, waiting: Sequence[Waiting]) -> None:
        """Add the derivatives of some views to those of the step."""
        deferred = [view for view in waiting if view.seen]
        faults = {view.iteration: view.first_fault for view in waiting}
        if deferred:
            with dr.suspend_grad():
                gaussians = dr.detach(self.integrator.gaussians)
                total, found = sum_of_views(gaussians, [view.seen for view in deferred])
                with dr.resume_grad():
                    self.integrator.accumulate(self.scene, total)
            faults |= {view.iteration: f for view, f in zip(deferred, found, strict=True)}
        for view in waiting:
            self._watch(view.iteration, view.loss, faults[view.iteration])

    def _rendered(self, view: TrainingView) -> Any:
        """The Gaussians as the view's sensor sees them, with derivatives."""
        return mi.render(self.scene, self.params, sensor=view.sensor, spp=1)

    def compared(self, image: Any, view: TrainingView) -> tuple[Any, Any, Any]:
        """What a rendering is as a photograph of the view would be, its loss and squared error."""
        for effect in self.effects:
            image = effect.adjust(image, view)
        loss, error = self.loss.with_squared_error(image, view.target)
        for effect in self.effects:
            for penalty in effect.penalties(view):
                loss = loss + penalty
        return image, loss, error

    def _gather(self) -> None:
        """Tell the strategy of density what was seen last, if it asks and was not told."""
        step, self._not_gathered = self._not_gathered, None
        if step is not None:
            self.density.gather(step)

    def _end_views(self, iterations: range) -> None:
        """Let effects take the steps of their own."""
        for view in map(self.view_at, iterations):
            for effect in self.effects:
                derivatives = {name: dr.grad(v) for name, v in effect.leaves(view).items()}
                effect.after(self, view, derivatives)

    def _backward(self, loss: Any) -> None:
        """Add the derivatives of a view's part of the mean."""
        dr.backward(loss / self.num_averaged if self.num_averaged > 1 else loss)

    def _watch(self, iteration: int, loss: Any, first_fault: Any) -> None:
        """Write down what may not be finite; see :class:`GradientWatch`."""
        view = self.view_at(iteration)
        numbers = {f"{e.name}.{k}": v for e in self.effects for k, v in e.numbers_of(view).items()}
        self.watch.add(iteration, view.name, loss, first_fault, numbers)

    def _seen_step(self, image: Any, target: Target) -> SeenStep:
        """For the strategy of density; image: (H, W, 3), as compared."""
        last, (height, width, _) = self.integrator.last, image.shape
        # Of the view alone: what was averaged is a part of it.
        count, of_mean = self.num_averaged, last.means2d_grad
        gradients = of_mean * count if count > 1 else of_mean, last.visible
        weigh = partial(weighted_sums_of_last, self.integrator)
        return SeenStep(self.iteration, width, height, *gradients, image, target.image, weigh)

    @property
    def stage(self) -> Stage:
        """Pictures of the size in use, which is that of the first iteration of a step."""
        return next(stage for stage in self.stages if self._first <= stage.until)

    @property
    def views(self) -> list[TrainingView]:
        """The training views, at the size in use."""
        return self.stage.views

    @property
    def begins_stage(self) -> bool:
        """Whether the pictures have other sizes than in the step before."""
        before = self._first - self.config.optimizer.views_per_step
        return any(before <= stage.until < self._first for stage in self.stages)

    @property
    def rate_decay(self) -> float:
        """What the means' learning rate has fallen to, relative to where it began."""
        return self.means_lr / self.rates.means.initial

    @property
    def means_lr(self) -> float:
        """The means' learning rate of this iteration, world units."""
        return self.rates.means(self.iteration)

    @property
    def num_averaged(self) -> int:
        """How many iterations' gradients are averaged for a step of the optimizer."""
        return max(self._late_views, len(self.iterations_of_step))

    @property
    def ends_step(self) -> bool:
        """Whether the gradient is that of all iterations of a step of the optimizer."""
        late = self._late_views
        is_whole = late <= self.config.optimizer.views_per_step
        return is_whole or self.iteration % late == 0

    @property
    def _late_views(self) -> int:
        """Iterations of a step late in the fit, see ``optimizer.views``; 1: it is not late."""
        config = self.config
        is_late = self.rates.means.progress(self._first) > config.optimizer.views_from
        is_settled = self._first >= config.densify.settled_from(config.iterations)
        return config.optimizer.views if is_late and is_settled else 1

    @property
    def iterations_of_step(self) -> range:
        """Those of the step that is under way, or was the last."""
        return self._step_of(self.iteration)

    @property
    def _first(self) -> int:
        return self.iterations_of_step.start

    def _step_of(self, iteration: int) -> range:
        """The iterations of its step."""
        return step_of(iteration, self.config.optimizer.views_per_step, self.config.iterations)

    def place_all(self) -> None:
        """Put all sensors where effects have them now, without derivatives."""
        for effect in self.effects:
            for view in self.views:
                effect.place(view)

    @property
    def view(self) -> TrainingView:
        """What this iteration trains on."""
        return self.view_at(self.iteration)

    def view_at(self, iteration: int) -> TrainingView:
        """What an iteration of the stage in use trains on."""
        config, count = self.config, len(self.views)
        views_per_step = config.optimizer.views_per_step
        return self.views[view_of(iteration, count, config.seed, views_per_step)]

    @property
    def parameters(self) -> dict[str, Any]:
        """Raw values by name, as the optimizer has them."""
        return {key.removeprefix(PREFIX): value for key, value in self.optimizer.items()}

    @property
    def means(self) -> Any:
        """The means at the moment, (N, 3)."""
        return self.optimizer[PREFIX + "means"]

    @property
    def sh_degree(self) -> int:
        """The degree in use: one more every ``model.sh_increase_every`` iterations."""
        model = self.config.model
        return min(model.sh_degree, self.iteration // model.sh_increase_every)

    @property
    def num_gaussians(self) -> int:
        """N at the moment."""
        return self.means.shape[0]

    def replan(self, iterations: int, densify_stop: int) -> None:
        """End the fit, and changes of the population, at another iteration; only what is ahead.

        What was done is what a fit does whose configuration is, from the start, as this one is now.

        Raises ValueError where it would not be.
        """
        config, now = self.config, self.iteration
        if densify_stop != config.densify.stop and now >= min(densify_stop, config.densify.stop):
            raise ValueError(
                f"Trainer.replan(): densify.stop cannot change from {config.densify.stop} to "
                f"{densify_stop} after iteration {now}"
            )
        aims = revised_aims(config, now, iterations)
        changes = {
            "iterations": iterations,
            "densify.stop": densify_stop,
            **_prune_window(config, now, iterations, densify_stop),
            "densify.stop_aims": revised_stops(config, now, densify_stop),
            "optimizer.means_lr_aims": [{"after": after, "end": end} for after, end in aims],
        }
        self.config = changed(config, changes)
        self.rates = rates_over_time(self.config, self.extent)
        self.density = self._density_from(self.density.state())

    @property
    def first_row(self) -> int:
        """The number of the first Gaussian in the optimizer here."""
        return 0

    def check_iterations(self) -> None:
        """Raise ``NonFiniteError`` if a loss or a gradient of an iteration so far is not finite.

        Waits for the device.
        """
        self.watch.check()

    def check(self) -> None:
        """Raise ``NonFiniteError`` if a loss, a gradient or a value is not; waits for the device.

        Called before anything that saves, returns or edits the state.
        """
        self.watch.check()
        check_values(self.iteration, self.parameters, self.first_row)
        check_values(self.iteration, self.density.state(), self.first_row)
        of_views = {f"{e.name}.{k}": v for e in self.effects for k, v in e.values().items()}
        check_view_values(self.iteration, of_views, [view.name for view in self.views])

    def gaussians(self) -> Gaussians:
        """The Gaussians as numpy arrays."""
        self.check()
        self.show()
        return replace(dr.detach(self.integrator.gaussians).numpy(), origin=self.dataset.origin)

    def show(self) -> None:
        """Bring the scene to where the fit is; the coming iterations do not depend on it."""
        self.params.update(self.optimizer)
        for effect in self.effects:
            effect.finish(self)

    def another(self, config: FitConfig, gaussians: Gaussians) -> Trainer:
        """A trainer with the same photographs; config: that of another fit."""
        return Trainer(config, self.dataset, gaussians)

    def take_over(self, former: Trainer) -> None:
        """Begin behind the iterations of another trainer, with what its effects have found."""
        before, views_per_step = former.config.iterations, former.config.optimizer.views_per_step
        self.iteration = -(-before // views_per_step) * views_per_step  # a step begins behind it
        found = {effect.name: effect.state() for effect in former.effects}
        for effect in self.effects:
            effect.repopulated(self)
            effect.restore(found[effect.name])

    def retire(self) -> None:
        """Free what only further iterations need, of which there will be none: targets, moments.

        Its scene still renders what was fitted last.
        """
        self.stage.end()
        self.optimizer.state.clear()
        release_unused_memory()

    def pictures(self, views: tuple[View, ...]) -> Iterator[np.ndarray]:
        """Pictures (H, W, 3) of views that were not trained on, display space, in [0, 1]."""
        for effect in self.effects:
            views = effect.measured(views)
        return render_views(self.scene_of_all(), views)

    def scene_of_all(self) -> mi.Scene:
        """A scene of all Gaussians, as they were shown last: see :meth:`show`."""
        return self.scene

    def state(self) -> dict[str, np.ndarray]:
        """Everything that the coming iterations depend on, as numpy arrays.

        Random numbers are functions of seed and iteration: they have no state.
        """
        self.check()
        return {
            "iteration": np.array(self.iteration),
            **{f"{DENSITY}{name}": values for name, values in self.density.state().items()},
            **optimizer_state(self.optimizer, PREFIX),
            **({} if self.ends_step else pending_gradients(self.optimizer, PREFIX)),
            **{f"{e.name}/{k}": v for e in self.effects for k, v in e.state().items()},
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue where :meth:`state` was taken, to the same bytes."""
        self.iteration = int(state["iteration"])
        self.integrator.sh_degree = self.sh_degree
        restore_optimizer(self.optimizer, state, PREFIX)
        self.density = self._density_from(_part(state, DENSITY))
        for effect in self.effects:
            effect.repopulated(self)
            effect.restore(_part(state, f"{effect.name}/"))
        self.watch = GradientWatch()
        self.params.update(self.optimizer)

    def _density_from(self, state: dict[str, np.ndarray]) -> DensityStrategy:
        """The strategy of the configuration, with its state; empty: at the beginning."""
        density = density_strategy(self.config, self.white_background)
        density.begin(self.population)
        if state:
            density.restore(state)
        return density

    def _set_rates(self) -> None:
        """Those of this iteration, and what the strategy does to them."""
        rates = self.rates(self.iteration)
        at_first = self.rates.others
        for name, factor in self.density.rate_factors(self.iteration).items():
            rates[name] = factor * (rates[name] if name in rates else at_first[name])
        there = self.optimizer.state  # shN is not, where the degree is 0
        rates = {PREFIX + name: rate for name, rate in rates.items() if PREFIX + name in there}
        self.optimizer.set_learning_rate(rates)

    def _control_density(self) -> DensityReport | None:
        """Let the strategy act; of several reports of a step, the last."""
        density, report = self.density, None
        if self.ends_step:
            density.perturb(self.population, self.iteration, self.means_lr)
        for iteration in filter(density.acts, self.iterations_of_step):
            self.check()
            found = density.act(self.population, iteration)
            if found is not None:
                report = found
                for effect in self.effects:
                    effect.repopulated(self)
                # Freed arrays of sizes that will not come again would stay with Dr.Jit's allocator.
                dr.flush_malloc_cache()
        return report


def _prune_window(
    config: FitConfig, now: int, iterations: int, densify_stop: int
) -> dict[str, int | None]:
    """Where a last phase of pruning is in a fit of other iterations: where it was, if it has begun.

    Else what is given of it keeps its share of the iterations, of those that are ahead.
    """
    prune, names = config.densify.prune, ("densify.prune.start", "densify.prune.stop")
    window = config.densify.prune_window(config.iterations)
    if prune.to is None or now > window[0]:
        return {} if prune.to is None else dict(zip(names, window, strict=True))
    start, stop = (
        None if given is None else round(given * iterations / config.iterations)
        for given in (prune.start, prune.stop)
    )
    if start is not None:
        start = max(1, start, now)
    if stop is not None:
        stop = max(stop, densify_stop + 1, (start or 0) + 1)
    return dict(zip(names, (start, stop), strict=True))


def _part(state: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """What of a state belongs to somebody whose names begin so, without that beginning."""
    return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
