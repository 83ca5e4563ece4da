"""Gaussians for other viewers: ``point_cloud.ply``, if the fit renders otherwise.

Viewers render with the defaults of ``drgs.config.approximations``. A copy of Gaussians that were
fitted with other settings is changed in closed form (``drgs.effects.smoothing``) and then fitted
for a few more iterations with the viewers' settings, a fixed number of Gaussians, and the fit's
cameras and colours. The fit's own Gaussians do not depend on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.approximations import DECLARED
from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig, ModelConfig
from drgs.core.errors import UserError, note_user
from drgs.core.memory import release_unused_memory
from drgs.datasets.types import View
from drgs.effects.base import TrainingEffect
from drgs.effects.colors import ColorConfig
from drgs.effects.smoothing import bake_for_viewers, bake_smoothing
from drgs.fit.inputs import share_gaussians
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.training.rates import TOUCH_UP_RATES
from drgs.training.trainer import Trainer

ITERATIONS_SHARE, TIME_SHARE = 0.08, 0.12
"""Share of the fit's iterations, and of its time: late iterations take longer."""

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
    trainer: Trainer, gaussians: Gaussians, watch: Callable[[int], None] = lambda done: None
) -> ForViewers:
    """Fit a copy of a fit's Gaussians as viewers render.

    trainer: of the finished fit; is released (:meth:`drgs.training.trainer.Trainer.release`).
    gaussians: ``trainer.gaussians()``. watch: called after each iteration with their number.

    If it fails, the closed form is returned, with a :class:`UserNote`.
    """
    others = trainer.config.model.approximations.non_default
    start, further = _closed_form(trainer, gaussians), tuning(trainer.config)
    trainer.release()
    try:
        tuner = trainer.spawn(further, share_gaussians(trainer.comm, start))
        tuner.warm_start(trainer)
        while tuner.iteration < further.iterations:
            if tuner.step().passes(further.output.history_every):
                tuner.check_iterations()
            watch(tuner.iteration - trainer.iteration)
        tuned = tuner.gaussians()
    except UserError as error:  # numbers that are not finite, or too little memory by now
        note_user(f"the Gaussians for viewers are not fitted any further: {error}")
        tuned = start
    release_unused_memory()  # share of the time of those iterations
    gaussians = replace(tuned, rendered_with={name: DECLARED[name].default for name in others})
    return ForViewers(gaussians, further.model, trainer.dataset.background, trainer.effects)


def _closed_form(trainer: Trainer, gaussians: Gaussians) -> Gaussians:
    """Return Gaussians in closed form, by the training cameras as the fit has them."""
    on_device = bake_smoothing(gaussians).to(mi.TensorXf)
    with dr.suspend_grad():
        cameras = trainer.fit_state().cameras()
        return bake_for_viewers(on_device, cameras, trainer.config.model.approximations)


def tuning(config: FitConfig) -> FitConfig:
    """Return the configuration of the extra iterations after a fit with ``config``."""
    before = config.last_iteration
    total = before + num_iterations(config)
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
