"""Gaussians for other viewers: ``point_cloud.ply``, if the fit renders otherwise, and a small file.

Viewers render with the defaults of ``drgs.config.approximations``. A copy of Gaussians that were
fitted with other settings is changed in closed form (``drgs.effects.smoothing``) and then fitted
for a few more iterations with the viewers' settings, a fixed number of Gaussians, and the fit's
cameras and colours. The fit's own Gaussians do not depend on it.

A small file (``output.small_file``) has further iterations of its own, whose images are of rounded
numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.approximations import DECLARED, Approximations
from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig, ModelConfig
from drgs.core.errors import UserError, note_user
from drgs.core.memory import release_unused_memory
from drgs.datasets.types import View
from drgs.effects.base import TrainingEffect
from drgs.effects.colors import ColorConfig
from drgs.effects.smoothing import bake_for_viewers, bake_smoothing
from drgs.fit.inputs import share_gaussians
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.io.formats import FORMATS, FileFormat
from drgs.training.rates import TOUCH_UP_RATES
from drgs.training.trainer import StepReport, Trainer

ITERATIONS_SHARE, TIME_SHARE = 0.08, 0.12
"""Share of the fit's iterations, and of its time: late iterations take longer."""

ROUNDED_ITERATIONS = 250

ROUNDING_SECONDS = 1e-6  # per Gaussian and iteration, on the host

HARMONICS_FACTOR = 4
"""Times the rate of harmonics, where a file shares them among Gaussians: steps are averaged."""

Watch = Callable[[int, int], None]

NEGLIGIBLE_RATE = 1e-9  # rate of values that are to stay, where 0 is not a rate


@dataclass(frozen=True)
class ForViewers:
    """Gaussians for other viewers, and how viewers render them."""

    gaussians: Gaussians  # numpy
    model: ModelConfig  # as viewers render
    background: tuple[float, float, float]
    effects: Iterable[TrainingEffect]  # of the fit

    def images(self, views: tuple[View, ...]) -> Iterator[np.ndarray]:
        """Yield images (H, W, 3) of views that were not trained on, display space, in [0, 1]."""
        for effect in self.effects:
            views = effect.correct_views(views)
        return render_views(make_scene(self.gaussians, self.model, self.background), views)


def num_iterations(config: FitConfig) -> int:
    """Return the number of extra iterations."""
    return math.ceil(ITERATIONS_SHARE * config.last_iteration)


def for_viewers(
    trainer: Trainer, gaussians: Gaussians, watch: Watch = lambda *_: None
) -> ForViewers:
    """Fit a copy of a fit's Gaussians as viewers render.

    trainer: of the finished fit; is released (:meth:`drgs.training.trainer.Trainer.release`).
    gaussians: ``trainer.gaussians()``. watch: called after each step with the number of iterations
    that are done, and of all.

    If it fails, the closed form is returned, with a :class:`UserNote`.
    """
    others = trainer.config.model.approximations.non_default
    start = _closed_form(trainer, gaussians, Approximations())
    start = replace(start, rendered_with={name: DECLARED[name].default for name in others})
    further = tuning(trainer.config, num_iterations(trainer.config))
    return _fit_further(trainer, further, start, Trainer.step, watch)


def fit_small_file(
    trainer: Trainer, gaussians: Gaussians, watch: Watch = lambda *_: None
) -> ForViewers:
    """Fit a copy of a fit's Gaussians as ``output.small_file`` rounds them; they are rounded.

    They are rendered as by the format's viewers (``shown_with`` of the format). The arguments are
    those of :func:`for_viewers`. Several processes only change them in closed form.
    """
    assert trainer.config.output.small_file is not None
    file_format = FORMATS.get(trainer.config.output.small_file).value()
    further = tuning(trainer.config, ROUNDED_ITERATIONS)
    changes = {f"model.{name}": value for name, value in file_format.shown_with.items()}
    changes["optimizer.shN_lr"] = HARMONICS_FACTOR * further.optimizer.shN_lr
    further = with_changes(further, changes)
    start = _closed_form(trainer, gaussians, further.model.approximations)
    if trainer.comm.size > 1:
        if trainer.comm.is_root:
            note_user("output.small_file: several processes write it without fitting it")
        effects, background = trainer.effects, trainer.dataset.background
        return ForViewers(start, further.model, background, effects)
    steps = _RoundedSteps(start, file_format)
    return _fit_further(trainer, further, replace(start, **steps.rounded), steps, watch)


class _RoundedSteps:
    """Steps of a trainer whose images are of rounded numbers.

    Derivatives with respect to these move the numbers that are not rounded: the straight-through
    estimator of Bengio et al. 2013, arXiv:1308.3432.
    """

    def __init__(self, start: Gaussians, file_format: FileFormat) -> None:
        self._values = {name: np.array(getattr(start, name)) for name in PARAMETER_NAMES}
        self._round = file_format.rounding(self._values)
        self.rounded = self._round_values()

    def _round_values(self) -> dict[str, np.ndarray]:
        return {k: v.astype(np.float32) for k, v in self._round(self._values).items()}

    def __call__(self, trainer: Trainer) -> StepReport:
        report, former = trainer.step(), self.rounded
        for name, value in trainer.parameters.items():
            self._values[name] += np.array(value) - former[name]
            if not np.isfinite(self._values[name]).all():  # which rounding may hide
                raise UserError(f"{name}: a number is not finite")
        self.rounded = self._round_values()
        for name, value in trainer.parameters.items():
            trainer.optimizer[name] = type(value)(self.rounded[name])
        return report


def _fit_further(
    trainer: Trainer,
    further: FitConfig,
    start: Gaussians,
    step: Callable[[Trainer], StepReport],
    watch: Watch,
) -> ForViewers:
    """Return ``start`` after more iterations with the configuration ``further``."""
    trainer.release()
    try:
        tuner = trainer.spawn(further, share_gaussians(trainer.comm, start))
        tuner.warm_start(trainer)
        while tuner.iteration < further.iterations:
            if step(tuner).passes(further.output.history_every):
                tuner.check_iterations()
            watch(tuner.iteration - trainer.iteration, further.iterations - trainer.iteration)
        tuned = replace(tuner.gaussians(), rendered_with=start.rendered_with)
    except UserError as error:  # numbers that are not finite, or too little memory by now
        note_user(f"the Gaussians for viewers are not fitted any further: {error}")
        tuned = start
    release_unused_memory()  # share of the time of those iterations
    return ForViewers(tuned, further.model, trainer.dataset.background, trainer.effects)


def _closed_form(trainer: Trainer, gaussians: Gaussians, shown: Approximations) -> Gaussians:
    """Return Gaussians in closed form, by the training cameras as the fit has them."""
    on_device = bake_smoothing(gaussians).to(mi.TensorXf)
    with dr.suspend_grad():
        cameras = trainer.fit_state().cameras()
        baked = bake_for_viewers(on_device, cameras, trainer.config.model.approximations, shown)
        return replace(baked, rendered_with=None)


def tuning(config: FitConfig, iterations: int) -> FitConfig:
    """Return the configuration of so many extra iterations after a fit with ``config``."""
    before = config.last_iteration
    total = before + iterations
    kept = {"max_gaussians": config.densify.max_gaussians}
    views_per_step = config.optimizer.views_per_step  # which processes may share
    changes = {
        **{f"model.{name}": _configured_default(name) for name in DECLARED},
        "model.smoothing": False,
        "iterations": total,
        "stop_after": None,
        "coarse": [],
        "densify": {"strategy": "adc", "start": 0, "stop": 1, **kept},  # never changes
        "optimizer": {
            **TOUCH_UP_RATES,
            "decay_from": before / total,
            "views_per_step": views_per_step,
        },
        **{f"cameras.{name}_lr": 0.0 for name in ("rotation", "translation", "focal", "principal")},
    }
    for name in ("lr", "vignetting_lr", "response_lr"):
        if getattr(config.section("colors", ColorConfig), name) is not None:
            changes[f"colors.{name}"] = NEGLIGIBLE_RATE
    return with_changes(config, changes)


def _configured_default(name: str) -> object:
    default, decimal = DECLARED[name].default, DECLARED[name].decimal
    if decimal is not None:
        return decimal
    return None if default == math.inf else default
