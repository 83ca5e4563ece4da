"""The training loop: photographs in, Gaussians out.

:meth:`Trainer.step` reads as Mitsuba's tutorials do: ``mi.render`` with the ``splats`` integrator,
``dr.backward``, ``drjit.opt.Adam``. Changes of the population come from a strategy of
``drgs.training.density``. All processes of a fit run the same loop on their views and Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.schema import FitConfig
from drgs.core.adam import make_optimizer, optimizer_state, pending_gradients, restore_optimizer
from drgs.core.memory import release_unused_memory
from drgs.core.types import Float, TensorXf
from drgs.datasets.types import Dataset, View
from drgs.effects.base import integrator_settings, training_effects
from drgs.gaussians.morton import space_order
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.initialization.defaults import resolve_defaults
from drgs.integrator.scene import make_scene, render_views
from drgs.integrator.state import SplatsPlugin
from drgs.splatting.rendering import NO_FAULT
from drgs.training.contracts import (
    NO_PARTS,
    GivenParts,
    checked_image,
    checked_number,
    checked_report,
    checked_terms,
    wrong_return,
)
from drgs.training.density.phases import density_strategy
from drgs.training.density.strategy import DensityReport, DensityStrategy, PixelWeight, StepInfo
from drgs.training.finite_checks import GradientWatch, WatchedIteration, check_values
from drgs.training.losses import make_loss, make_loss_terms
from drgs.training.parallel.communicator import Communicator
from drgs.training.parallel.population import (
    check_shardable,
    local_gaussians,
    make_population,
    own_views,
)
from drgs.training.rates import rates_over_time
from drgs.training.steps import (
    MAX_TARGET_BYTES,
    OneView,
    ReadAhead,
    Step,
    StepView,
    ViewGradients,
    ViewLoss,
    make_phases,
    plan_step,
)
from drgs.training.views import FitState, TrainingView

DENSITY = "density/"  # precedes the names of the strategy's state


@dataclass(frozen=True)
class StepReport:
    """The results of a step; numbers that cost a wait for the device are read on demand."""

    iteration: int  # the last one
    num_gaussians: int
    means_lr: float
    density: DensityReport | None  # None: rows have not changed
    views: tuple[ViewLoss, ...]  # by iteration

    @property
    def loss(self) -> float:
        """The mean loss of the step's views."""
        return float(np.mean([float(view.loss[0]) for view in self.views]))

    @property
    def psnr(self) -> float:
        """dB, the mean of the step's views, before the step."""
        errors = [float(view.squared_error[0]) / view.counted for view in self.views]
        return float(np.mean([-10 * math.log10(max(error, 1e-10)) for error in errors]))

    def passes(self, every: int) -> bool:
        """Return whether an iteration of this step is a multiple of ``every``."""
        return self.iteration % every < len(self.views)


class Trainer:
    """Fits ``gaussians`` to the training views of ``dataset``."""

    def __init__(
        self,
        config: FitConfig,
        dataset: Dataset,
        gaussians: Gaussians,
        comm: Communicator | None = None,
        parts: GivenParts = NO_PARTS,
        *,
        room: int = MAX_TARGET_BYTES,
    ) -> None:
        """gaussians: all, on each process; comm: None: this process alone.

        room: bytes of targets and uploads that may stay on the device.
        """
        config = resolve_defaults(config, dataset)
        views_per_step = config.optimizer.views_per_step
        self.config, self.dataset, self.extent = config, dataset, dataset.extent
        self.comm = comm = comm or Communicator()
        gaussians, total = gaussians[space_order(gaussians.means)], gaussians.num_gaussians
        check_shardable(config, comm.size, total)
        self.effects = training_effects(config, dataset, parts.effects)
        self._parts, self._room = parts, room
        self.scene = make_scene(
            local_gaussians(gaussians, comm),
            config.model,
            dataset.background,
            **integrator_settings(self.effects),
        )
        self.integrator = cast(SplatsPlugin, self.scene.integrator())
        self.params = mi.traverse(self.integrator)
        self.params.keep(list(PARAMETER_NAMES))
        self.rates = rates_over_time(config, self.extent)
        self.optimizer = make_optimizer(
            dict(self.params.items()),
            self.rates(0),
            beta_1=config.optimizer.beta_1**views_per_step,
            beta_2=config.optimizer.beta_2**views_per_step,
        )
        self.loss = parts.loss or make_loss(config)
        self.terms = [*make_loss_terms(config), *parts.terms]
        self.phases = make_phases(dataset.train, config, self.effects, room)
        own = own_views(len(dataset.train), views_per_step, comm.rank, comm.size)
        self.read_ahead = ReadAhead(dataset.train, own)
        self.gradients: OneView | SeveralViews = OneView(self.integrator)
        if views_per_step > 1:
            from drgs.training.parallel.several_views import SeveralViews

            self.gradients = SeveralViews(comm, self.integrator, self.params, views_per_step)
        self.population = make_population(self.optimizer, self.extent, config.seed, comm, total)
        self.density = self._density_from({})
        self.watch = GradientWatch()
        self.iteration = 0  # the last one that is done
        self._full_scene: tuple[int, mi.Scene | None] | None = None  # with its iteration

    def step(self) -> StepReport:
        """Render the views of a step, one per iteration, and step along their mean gradient."""
        step = self._begin_step()
        self.params.update(self.optimizer)
        self._begin_effects(step)
        penalties = self._differentiate_penalties(step)
        losses: dict[int, ViewLoss] = {}
        for view in self.gradients.own_views():
            self._begin_view(step, view)
            rendered = mi.render(self.scene, self.params, sensor=view.view.sensor, spp=1)
            image, loss, error = self.compare(cast(TensorXf, rendered), view.view)
            dr.backward(loss / step.num_averaged if step.num_averaged > 1 else loss)
            self._end_view(view, dr.detach(image))
            losses[view.place] = ViewLoss(dr.detach(loss), error, view.view.counted_share)
        gradients = self.gradients.finish([tuple(self._pixel_weights(i)) for i in step.iterations])
        views = self._total_losses(step, gradients, losses, penalties)
        if step.is_update:
            self._set_learning_rates(step)
            self.optimizer.step()
        self._update_effects(step)
        report = self._control_density(step, gradients)
        for place in losses:
            step.phase.keep_or_free(step.views[place].view)
        means_lr = self.rates.means(step.last_iteration)
        return StepReport(step.last_iteration, self.num_gaussians, means_lr, report, tuple(views))

    def _begin_step(self) -> Step:
        before, step = self.last_step, self.plan(self.iteration + 1)
        if step.phase is not before.phase:
            before.phase.end()
        self.iteration = step.last_iteration
        self.integrator.sh_degree = self.sh_degree_at(step.iterations[0])
        return step

    def _begin_effects(self, step: Step) -> None:
        """Bring effects, and the sensors of views of other ranks, to where they are now."""
        fit = self.fit_state(step, step.iterations[0])
        for effect in self.effects:
            effect.begin(fit)

        def move_sensor(view: StepView) -> None:
            for effect in self.effects:
                if effect.moves_sensors:
                    effect.before_render(fit, view.view)

        self.gradients.begin(step.views, move_sensor)

    def _begin_view(self, step: Step, view: StepView) -> None:
        """Let effects prepare a view's sensor and background, and a thread read the next ones."""
        self.read_ahead(self._coming_views(step, view.iteration))
        fit = self.fit_state(step, view.iteration)
        for effect in self.effects:
            effect.before_render(fit, view.view)
        self.gradients.begin_view(view)

    def _end_view(self, view: StepView, image: TensorXf) -> None:
        """Compute what the strategy sums over the pixels of each Gaussian."""
        photograph, weights = view.view.target.image, self._pixel_weights(view.iteration)
        planes = {name: weigh(image, photograph) for name, weigh in weights.items()}
        for plane in planes.values():
            if dr.width(plane) != image.shape[0] * image.shape[1]:
                raise wrong_return(
                    self.density, "pixel_weights", "planes of the image's size", plane
                )
        self.gradients.end_view(view, planes)

    def _coming_views(self, step: Step, iteration: int) -> Iterator[TrainingView]:
        """Yield the views of the fit from an iteration of ``step`` on."""
        while True:
            yield from (each.view for each in step.views if each.iteration >= iteration)
            if step.last_iteration >= self.config.last_iteration:
                break
            step = self.plan(step.last_iteration + 1)

    def _differentiate_penalties(self, step: Step) -> Sequence[Float | np.ndarray]:
        """Add the derivatives of the strategy's terms of the loss; return the terms."""

        def penalties(parameters: Mapping[str, dr.ArrayBase]) -> list[Float]:
            count = self.num_gaussians
            own = self.density.penalties(parameters, count)
            found = checked_terms(self.density, "penalties", own)
            for term in self.terms:
                found += checked_terms(term, "of_gaussians", [term.of_gaussians(parameters, count)])
            return found

        terms = penalties(self.parameters)
        if terms:
            weight = step.num_averaged / len(step.iterations)
            total = sum(terms[1:], terms[0])
            flags = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad  # a term of weight 0 has none
            dr.backward(total / weight if weight > 1 else total, flags=flags)
        return self.population.gather_terms(terms, penalties)

    def compare(self, image: TensorXf, view: TrainingView) -> tuple[TensorXf, Float, Float]:
        """Return the image as a photograph of the view would be, its loss and squared error."""
        for effect in self.effects:
            image = checked_image(effect, "adjust", effect.adjust(image, view), image)
        loss, error = self.loss.with_squared_error(image, view.target)
        loss = checked_number(self.loss, "__call__", loss, dr.grad_enabled(image))
        for term in self.terms:
            loss = sum(checked_terms(term, "of_image", [term.of_image(image, view.target)]), loss)
        for effect in self.effects:
            loss = sum(checked_terms(effect, "penalties", effect.penalties(view)), loss)
        return image, loss, error

    def _pixel_weights(self, iteration: int) -> Mapping[str, PixelWeight]:
        needs_statistics = self.density.needs_statistics(iteration)
        return self.density.pixel_weights(iteration) if needs_statistics else {}

    def _total_losses(
        self,
        step: Step,
        gradients: Sequence[ViewGradients],
        losses: Mapping[int, ViewLoss],
        penalties: Sequence[Float | np.ndarray],
    ) -> list[ViewLoss]:
        """Return the losses of all views with the strategy's terms, and remember to check them."""
        shared, results = self.gradients.share_losses(losses), []
        first_row = self.population.first_row * len(PARAMETER_NAMES)
        for view, own, loss in zip(step.views, gradients, shared, strict=True):
            total = cast(Float, sum(penalties, loss.loss))
            fault = own.first_nonfinite
            if first_row:
                shifted = fault + dr.opaque(type(fault), first_row)
                fault = dr.select(fault == NO_FAULT, fault, shifted)
            numbers = {
                f"{effect.name}.{name}": values
                for effect in self.effects
                for name, values in effect.numbers_of(view.view).items()
            }
            watched = WatchedIteration(view.iteration, view.view.name, total, fault, numbers)
            self.watch.append(watched)
            results.append(replace(loss, loss=total))
        return results

    def _set_learning_rates(self, step: Step) -> None:
        """Set the rates of a step, times the factors of the strategy."""
        rates = self.rates(step.last_iteration)
        for name, factor in self.density.rate_factors(step.last_iteration).items():
            rates[name] *= factor
        state = self.optimizer.state  # shN is not in it, where the degree is 0
        self.optimizer.set_learning_rate({n: rate for n, rate in rates.items() if n in state})

    def _update_effects(self, step: Step) -> None:
        """Let effects take their own steps."""
        fit = self.fit_state(step, step.last_iteration)
        for view in step.views:
            for effect in self.effects:
                derivatives = {
                    name: self.gradients.share(view, dr.grad(leaf))
                    for name, leaf in effect.leaves(view.view).items()
                }
                effect.after_backward(fit, view.view, derivatives)

    def _control_density(
        self, step: Step, gradients: Sequence[ViewGradients]
    ) -> DensityReport | None:
        """Update the strategy's statistics, and let it change the rows; return the last report."""
        density, report, last = self.density, None, step.last_iteration
        for view, own in zip(step.views, gradients, strict=True):
            if density.needs_statistics(view.iteration):
                means2d_grad = own.means2d_grad
                if step.num_averaged > 1:  # it is a part of a mean
                    means2d_grad = means2d_grad * step.num_averaged
                size = view.view.width, view.view.height
                sums = own.visible, own.weighted_sums
                density.update_statistics(StepInfo(view.iteration, *size, means2d_grad, *sums))
        if step.is_update:
            density.perturb(self.population, last, self.rates.means(last))
        for iteration in filter(density.is_due, step.iterations):
            self.check()
            change = density.refine(self.population, iteration)
            if checked_report(density, change, self.num_gaussians) is not None:
                report = change
                self._sort_rows()
                for effect in self.effects:
                    effect.on_population_change(self.fit_state(step, iteration))
                # Freed arrays of sizes that will not come again would stay with Dr.Jit's allocator.
                dr.flush_malloc_cache()
        return report

    def plan(self, iteration: int) -> Step:
        """Return the step that an iteration is part of."""
        return plan_step(iteration, self.config, self.rates, self.phases)

    def fit_state(self, step: Step | None = None, iteration: int | None = None) -> FitState:
        """Return the state for effects, by default after the last step."""
        step = step or self.last_step
        iteration = self.iteration if iteration is None else iteration
        return FitState(
            iteration=iteration,
            iterations_of_step=step.iterations,
            begins_phase=step.begins_phase,
            rate_decay=self.rates.means(iteration) / self.rates.means.initial,
            integrator=self.integrator,
            # The scene's, once the optimizer is released.
            means=cast(TensorXf, self.parameters.get("means", self.params["means"])),
            views=step.phase.views,
            effects=self.effects,
        )

    @property
    def parameters(self) -> dict[str, dr.ArrayBase]:
        """Raw values by name, as the optimizer has them: the rows of this process."""
        return dict(self.optimizer.items())

    @property
    def num_gaussians(self) -> int:
        """N at the moment."""
        return self.population.num_rows

    @property
    def last_step(self) -> Step:
        """The last step that is done."""
        return self.plan(self.iteration)

    @property
    def views(self) -> list[TrainingView]:
        """The training views, at the image size that is in use."""
        return self.last_step.phase.views

    @property
    def sh_degree(self) -> int:
        """The degree of the spherical harmonics in use."""
        return self.sh_degree_at(self.iteration)

    def sh_degree_at(self, iteration: int) -> int:
        """Return the degree of an iteration: one more every ``model.sh_increase_every``."""
        model = self.config.model
        return min(model.sh_degree, iteration // model.sh_increase_every)

    def gaussians(self) -> Gaussians:
        """Return all Gaussians as numpy arrays; on other ranks than 0, the rank's own."""
        self.check()
        self.sync_scene()
        own = replace(dr.detach(self.integrator.gaussians).numpy(), origin=self.dataset.origin)
        return self.population.gather_gaussians(own)

    def sync_scene(self) -> None:
        """Bring the scene to where the fit is; the coming iterations do not depend on it."""
        self.params.update(self.optimizer)
        fit = self.fit_state()
        for effect in self.effects:
            effect.finish(fit)

    def full_scene(self) -> mi.Scene | None:
        """Return a scene of all Gaussians, as synchronised last; None on other ranks than 0."""
        if self.comm.size == 1:
            return self.scene
        if self._full_scene is None or self._full_scene[0] != self.iteration:
            gaussians, scene = self.gaussians(), None
            if self.comm.is_root:
                scene = make_scene(gaussians, self.config.model, self.dataset.background)
                cast(SplatsPlugin, scene.integrator()).sh_degree = self.integrator.sh_degree
            self._full_scene = self.iteration, scene
        return self._full_scene[1]

    def images(self, views: tuple[View, ...]) -> Iterator[np.ndarray]:
        """Yield images (H, W, 3) of views that were not trained on, display space, in [0, 1].

        All ranks call it; rank 0 alone gets images.
        """
        for effect in self.effects:
            views = effect.correct_views(views)
        scene = self.full_scene()
        return iter(()) if scene is None else render_views(scene, views)

    def check_iterations(self) -> None:
        """Raise ``NonFiniteError`` if a loss or a gradient of an iteration so far is not finite.

        Waits for the device; all processes raise the same.
        """
        self.comm.collective(self.watch.check)

    def check(self) -> None:
        """Raise ``NonFiniteError`` if a loss, a gradient or a value is not; waits for it."""

        def check_own() -> None:
            self.watch.check()
            first_row = self.population.first_row
            check_values(self.iteration, self.parameters, first_row)
            check_values(self.iteration, self.density.state(), first_row)
            of_views = {f"{e.name}.{k}": v for e in self.effects for k, v in e.values().items()}
            check_values(self.iteration, of_views, views=[view.name for view in self.views])

        self.comm.collective(check_own)

    def spawn(self, config: FitConfig, gaussians: Gaussians) -> Trainer:
        """Return a trainer with the same photographs, and copies of the given parts.

        config: of another fit, which decides about its population.
        """
        parts = replace(deepcopy(self._parts), strategy=None)
        return Trainer(config, self.dataset, gaussians, self.comm, parts, room=self._room)

    def warm_start(self, former: Trainer) -> None:
        """Begin after the iterations of another trainer, with the state of its effects."""
        before, views_per_step = former.iteration, former.config.optimizer.views_per_step
        self.iteration = -(-before // views_per_step) * views_per_step  # a step begins after it
        self._restore_effects({effect.name: effect.state() for effect in former.effects})

    def release(self) -> None:
        """Free memory that only iterations need; the scene still renders the fit's Gaussians."""
        self.last_step.phase.end()
        self.optimizer.state.clear()
        release_unused_memory()

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that the coming iterations depend on, as numpy arrays.

        Random numbers are functions of seed and iteration: they have no state. Arrays of rows are
        whole on rank 0 alone.
        """
        self.check()
        is_update = self.last_step.is_update
        state = {
            "iteration": np.array(self.iteration),
            **{f"{DENSITY}{name}": values for name, values in self.density.state().items()},
            **optimizer_state(self.optimizer),
            **({} if is_update else pending_gradients(self.optimizer)),
            **{f"{e.name}/{k}": v for e in self.effects for k, v in e.state().items()},
        }
        return self.population.gather_state(state, self._is_by_row)

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue where :meth:`state` was called, to the same bytes, on any number of processes.

        state: of rank 0; other ranks may give an empty one.
        """
        state = self.population.scatter_state(state, self._is_by_row)
        self.iteration = int(state["iteration"])
        self.integrator.sh_degree = self.sh_degree
        restore_optimizer(self.optimizer, state)
        self.density = self._density_from(_part(state, DENSITY))
        self._restore_effects({e.name: _part(state, f"{e.name}/") for e in self.effects})
        self.watch = GradientWatch()
        self.params.update(self.optimizer)

    def _sort_rows(self) -> None:
        """Sort the rows, with the strategy's statistics: see :func:`.space_order`."""
        population, state = self.population, self.density.state()
        order = space_order(population.host("means"))
        population.edit(population.to_device_indices(order))
        for name in self.density.by_row:
            state[name] = population.local(population.gather(state[name])[order])
        self.density.restore(state)

    def _restore_effects(self, states: Mapping[str, Mapping[str, np.ndarray]]) -> None:
        fit = self.fit_state()
        for effect in self.effects:
            effect.on_population_change(fit)
            effect.restore(states[effect.name])

    def _is_by_row(self, name: str) -> bool:
        """Return whether an array of the state has a row for each Gaussian."""
        others = {f"{effect.name}/{key}" for effect in self.effects for key in effect.by_row}
        others |= {f"{DENSITY}{key}" for key in self.density.by_row}
        parameter, _, kind = name.partition(".")
        return name in others or (parameter in PARAMETER_NAMES and kind != "t")

    def _density_from(self, state: Mapping[str, np.ndarray]) -> DensityStrategy:
        """Return the strategy of the configuration with its state; empty: at the beginning."""
        density = density_strategy(self.config, self.dataset, self._parts.strategy)
        density.begin(self.population)
        if state:
            density.restore(state)
        return density


def _part(state: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """Return the entries whose names begin with ``prefix``, without it."""
    return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
