"""The training loop: photographs in, Gaussians out.

Layer 4. Everything between two optimizer steps is visible in :meth:`Trainer.step`. The picture
and its gradients come from ``mi.render`` with the ``splats`` integrator, the steps from
``drjit.opt.Adam``, changes of the population from ``drgs.densify``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs import densify
from drgs.config import FitConfig, OptimizerConfig
from drgs.data.images import smaller_view
from drgs.data.types import Dataset, View
from drgs.effects import integrator_settings, training_effects
from drgs.gaussians import PARAMETER_NAMES, Gaussians
from drgs.guards import GradientWatch, check_values, check_view_values
from drgs.losses import PhotometricLoss, Target, prepare_target
from drgs.optimizer import (
    ExponentialDecay,
    make_optimizer,
    optimizer_state,
    restore_optimizer,
)
from drgs.scene import make_scene, make_sensors
from drgs.schedule import changed
from drgs.training_effects import TrainingEffect

PREFIX = "integrator."
"""What precedes a parameter's name when the scene is traversed."""


@dataclass(eq=False)
class TrainingView:
    """A view as training needs it."""

    name: str
    index: int  # among the training views
    sensor: mi.Sensor
    photograph: Target
    target: Target  # what is compared with: the photograph, unless an effect replaces it
    width: int  # px
    height: int  # px
    counted: float  # share of the pixels that count: those that no mask leaves out
    uploads: dict[str, Any]  # what effects need, by their names


@dataclass(frozen=True, eq=False)
class Stage:
    """Iterations that train on pictures of one size."""

    until: float  # last iteration
    views: list[TrainingView]


@dataclass(frozen=True)
class StepReport:
    """What one iteration did; numbers that cost a wait for the device are read on demand."""

    iteration: int
    num_gaussians: int
    means_lr: float
    density: densify.DensityReport | None
    loss_array: Any  # Float, one entry
    squared_error: Any  # Float, one entry: mean over pixels and channels
    counted: float  # share of the pixels that count

    @property
    def loss(self) -> float:
        """The loss of this iteration's view."""
        return float(self.loss_array[0])

    @property
    def psnr(self) -> float:
        """dB, of this iteration's view before the step."""
        return -10 * math.log10(max(float(self.squared_error[0]) / self.counted, 1e-10))


class Trainer:
    """Fits ``gaussians`` to the training views of ``dataset``."""

    def __init__(self, config: FitConfig, dataset: Dataset, gaussians: Gaussians) -> None:
        self.config, self.extent = config, dataset.extent
        self.effects = training_effects(config, dataset)
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
            beta_1=config.optimizer.beta_1,
            beta_2=config.optimizer.beta_2,
            epsilon=config.optimizer.epsilon,
        )
        self.means_lr = means_rate(config, self.extent)
        self.loss = PhotometricLoss(config.loss.dssim_weight)
        self.white_background = tuple(dataset.background) == (1.0, 1.0, 1.0)
        self.stages = make_stages(dataset.train, config, self.effects)
        self.statistics = self._no_statistics()
        self.watch = GradientWatch()
        self.iteration = 0

    def step(self) -> StepReport:
        """One iteration: one view, one optimizer step, now and then a change of the population."""
        self.iteration += 1
        view = self.view
        self.integrator.sh_degree = self.sh_degree
        self.optimizer.set_learning_rate({PREFIX + "means": self.means_lr(self.iteration)})
        self.params.update(self.optimizer)
        for effect in self.effects:
            effect.before(self, view)

        image = mi.render(self.scene, self.params, sensor=view.sensor, spp=1)
        image, loss = self.compared(image, view)
        dr.backward(loss)
        image, loss = dr.detach(image), dr.detach(loss)
        error = dr.mean(dr.square(image.array - view.target.image.array))
        numbers = {f"{e.name}.{k}": v for e in self.effects for k, v in e.numbers_of(view).items()}
        self.watch.add(self.iteration, view.name, loss, self.integrator.last.first_fault, numbers)
        self.optimizer.step()
        for effect in self.effects:
            effect.after(self, view)

        report = self._control_density(view)
        return StepReport(
            iteration=self.iteration,
            num_gaussians=self.num_gaussians,
            means_lr=self.means_lr(self.iteration),
            density=report,
            loss_array=loss,
            squared_error=error,
            counted=view.counted,
        )

    def compared(self, image: Any, view: TrainingView) -> tuple[Any, Any]:
        """What a rendering is as a photograph of the view would be, and its loss."""
        for effect in self.effects:
            image = effect.adjust(image, view)
        loss = self.loss(image, view.target)
        for effect in self.effects:
            for penalty in effect.penalties(view):
                loss = loss + penalty
        return image, loss

    @property
    def views(self) -> list[TrainingView]:
        """The training views, at the size in use."""
        return next(stage.views for stage in self.stages if self.iteration <= stage.until)

    @property
    def view(self) -> TrainingView:
        """What this iteration trains on."""
        return self.views[view_of(self.iteration, len(self.views), self.config.seed)]

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
        aims = [(after, end) for after, end in rate_aims(config) if after < now or after == 0]
        if 0 < now < iterations:
            aims.append((now, iterations))
        changes = {
            "iterations": iterations,
            "densify.stop": densify_stop,
            "optimizer.means_lr_aims": [{"after": after, "end": end} for after, end in aims],
        }
        self.config = changed(config, changes)
        self.means_lr = means_rate(self.config, self.extent)

    def check(self) -> None:
        """Raise ``NonFiniteError`` if a loss, a gradient or a value is not; waits for the device.

        Called before anything that saves, returns or edits the state.
        """
        self.watch.check()
        values = {key.removeprefix(PREFIX): value for key, value in self.optimizer.items()}
        check_values(self.iteration, {**values, "gradient_norms": self.statistics.gradient_norms})
        of_views = {f"{e.name}.{k}": v for e in self.effects for k, v in e.values().items()}
        check_view_values(self.iteration, of_views, [view.name for view in self.views])

    def gaussians(self) -> Gaussians:
        """The Gaussians as numpy arrays."""
        self.check()
        self.params.update(self.optimizer)
        for effect in self.effects:
            effect.finish(self)
        return dr.detach(self.integrator.gaussians).numpy()

    def pictures(self, views: tuple[View, ...]) -> Iterator[np.ndarray]:
        """Pictures (H, W, 3) of views that were not trained on, display space, in [0, 1]."""
        for effect in self.effects:
            views = effect.measured(views)
        return render_views(self.scene, views)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that the coming iterations depend on, as numpy arrays.

        Random numbers are functions of seed and iteration: they have no state.
        """
        self.check()
        return {
            "iteration": np.array(self.iteration),
            "gradient_norms": np.array(self.statistics.gradient_norms),
            "views": np.array(self.statistics.views),
            **optimizer_state(self.optimizer, PREFIX),
            **{f"{e.name}/{k}": v for e in self.effects for k, v in e.state().items()},
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue where :meth:`state` was taken, to the same bytes."""
        self.iteration = int(state["iteration"])
        restore_optimizer(self.optimizer, state, PREFIX)
        self.statistics = densify.DensityStatistics(
            mi.Float(state["gradient_norms"]), mi.Float(state["views"])
        )
        for effect in self.effects:
            start = f"{effect.name}/"
            own = {k.removeprefix(start): v for k, v in state.items() if k.startswith(start)}
            effect.repopulated(self)
            effect.restore(own)
        self.watch = GradientWatch()
        self.params.update(self.optimizer)

    def _control_density(self, view: TrainingView) -> densify.DensityReport | None:
        config, i = self.config.densify, self.iteration
        if densify.gathers_statistics(config, i):
            last = self.integrator.last
            self.statistics = densify.accumulate(
                self.statistics, last.means2d_grad, last.visible, view.width, view.height
            )
        densifies = densify.should_densify(config, i)
        resets = densify.should_reset(config, i, self.white_background)
        if densifies or resets:
            self.check()
        report = None
        if densifies:
            report = densify.densify_and_prune(
                self.optimizer, self.statistics, config, self.extent, i, self.config.seed, PREFIX
            )
            self.statistics = self._no_statistics()
            for effect in self.effects:
                effect.repopulated(self)
            # Freed arrays of sizes that will not come again would stay with Dr.Jit's allocator.
            dr.flush_malloc_cache()
        if resets:
            densify.reset_opacities(self.optimizer, config, PREFIX)
        return report

    def _no_statistics(self) -> densify.DensityStatistics:
        return densify.DensityStatistics.zeros(mi.Float, self.num_gaussians)


def learning_rates(config: OptimizerConfig, extent: float) -> dict[str, float]:
    """Rate per step of each parameter; extent: world units."""
    return {
        "means": config.means_lr * extent,
        "quats": config.quats_lr,
        "log_scales": config.scales_lr,
        "logit_opacities": config.opacities_lr,
        "sh0": config.sh0_lr,
        "shN": config.shN_lr,
    }


def rate_aims(config: FitConfig) -> list[tuple[int, int]]:
    """(after, end) of the means' rate: see :class:`drgs.optimizer.ExponentialDecay`."""
    aims = [(aim.after, aim.end) for aim in config.optimizer.means_lr_aims]
    return aims or [(0, config.iterations)]


def means_rate(config: FitConfig, extent: float) -> ExponentialDecay:
    """The rate of the means over the iterations; extent: world units."""
    rates = config.optimizer
    aims = tuple(rate_aims(config))
    return ExponentialDecay(rates.means_lr * extent, rates.means_lr_final * extent, aims)


def make_stages(
    views: tuple[View, ...], config: FitConfig, effects: Sequence[TrainingEffect]
) -> list[Stage]:
    """The configuration's coarse stages, and the last one, of pictures as they are."""
    sizes = [(s.until, [smaller_view(v, s.factor) for v in views]) for s in config.coarse]
    return [
        Stage(until, make_training_views(resized, config, effects))
        for until, resized in [*sizes, (math.inf, views)]
    ]


def make_training_views(
    views: Sequence[View], config: FitConfig, effects: Sequence[TrainingEffect]
) -> list[TrainingView]:
    """Sensors, loss targets, and what effects need, for ``views``."""
    sensors = make_sensors(views, calibrated=any(e.moves_sensors for e in effects))
    result = []
    for index, (view, sensor) in enumerate(zip(views, sensors, strict=True)):
        image = view.image
        for effect in effects:
            image = effect.target_image(view, image)
        target = prepare_target(mi.TensorXf(image), config.loss.window, config.loss.sigma)
        result.append(
            TrainingView(
                name=view.name,
                index=index,
                sensor=sensor,
                photograph=target,
                target=target,
                width=view.width,
                height=view.height,
                counted=1.0 if view.mask is None else max(float(view.mask.mean()), 1e-10),
                uploads={effect.name: effect.upload(view) for effect in effects},
            )
        )
    return result


def view_of(iteration: int, num_views: int, seed: int) -> int:
    """Which view an iteration trains on: every round visits all views in an order of its own.

    A function of its arguments alone, so that a fit can be resumed at any iteration.
    """
    which_round, position = divmod(iteration - 1, num_views)
    order = np.random.default_rng([seed, which_round]).permutation(num_views)
    return int(order[position])


def render_views(scene: mi.Scene, views: tuple[View, ...]) -> Iterator[np.ndarray]:
    """Pictures (H, W, 3) of ``views``, display space, clamped to [0, 1]."""
    for sensor in make_sensors(views):
        with dr.suspend_grad():
            image = np.array(mi.render(scene, sensor=sensor, spp=1))
            yield np.clip(image[:, :, :3], 0, 1)  # what else is put out comes behind the colours
