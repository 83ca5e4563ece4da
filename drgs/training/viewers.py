"""Gaussians for other viewers: what ``point_cloud_viewers.ply`` holds beside the fit's own.

Viewers of 3DGS files render with the defaults of ``drgs.config.approximations``: 0.3 square pixels
of low-pass, and opacities as they are. A copy of Gaussians that were fitted otherwise is changed in
closed form (``drgs.effects.smoothing``) and then fitted for a few iterations more as viewers render
it, with the number of Gaussians fixed and with what the fit has found out about cameras and
colours. The fit's own Gaussians do not depend on any of it.

Measured on ``scenes/lego_mini.yml`` with ``antialiased`` and a low-pass of 0.1, where the fit has
35.16 dB: the same numbers as they are give 21.6 dB in viewers, in closed form 30.0 dB, with 160
iterations behind that 32.7 dB, with 1,000 33.3 dB. A whole fit as viewers render reaches 32.8 dB:
a filter of 0.3 square pixels lets no more detail through. Gaussians that serve both are not to be
had: 160 iterations under both rules in turn leave 32.1 dB for the fit and 24.8 dB in viewers.
With the present recipe, 37.13 dB in 3,400 iterations, further ones of 4, 8 and 10 % give 33.30,
33.64 and 33.77 dB, and a whole fit as viewers render 34.39 dB.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.approximations import DECLARED
from drgs.config.changes import changed
from drgs.config.schema import FitConfig, ModelConfig
from drgs.core.errors import UserError, UserNote
from drgs.core.memory import release_unused_memory
from drgs.datasets.types import View
from drgs.effects.smoothing import baked, baked_for_viewers
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.training.effects.base import TrainingEffect
from drgs.training.parallel.inputs import share_gaussians
from drgs.training.trainer import Trainer

SHARE = 0.08
"""Of the iterations of the fit, that are added."""

TIME_SHARE = 0.12
"""Of the time of the fit: late iterations take longer than early ones."""

RATES = {
    "means_lr": 1.6e-5,
    "means_lr_final": 1.6e-5,
    "quats_lr": 4e-3,
    "scales_lr": 0.02,
    "opacities_lr": 0.07,
    "sh0_lr": 0.06,
    "shN_lr": 4e-3,
    "decay": 0.1,
}
"""High, as few iterations have to do, and those of colours most of all. With the reference's rates
the same iterations give 1 dB less."""

NEXT_TO_NOTHING = 1e-9
"""A rate for what is to stay, where 0 is not a rate."""


@dataclass(frozen=True)
class ForViewers:
    """Gaussians for other viewers, and how these show them."""

    gaussians: Gaussians  # numpy; the header of their file says how they are rendered
    model: ModelConfig  # as viewers render
    background: tuple[float, float, float]
    effects: Iterable[TrainingEffect]  # of the fit

    def pictures(self, views: tuple[View, ...]) -> Iterator[np.ndarray]:
        """Pictures (H, W, 3) of views that were not trained on, display space, in [0, 1]."""
        for effect in self.effects:
            views = effect.measured(views)
        return render_views(make_scene(self.gaussians, self.model, self.background), views)


def num_iterations(config: FitConfig) -> int:
    """How many are added to those of a fit."""
    return math.ceil(SHARE * config.iterations)


def for_viewers(
    trainer: Trainer,
    gaussians: Gaussians,
    watch: Callable[[int], None] = lambda done: None,
) -> ForViewers:
    """Fit a copy of a fit's Gaussians as viewers render; the same bytes in every run.

    trainer: has ended, and is released: see :meth:`drgs.training.trainer.Trainer.release`.
    gaussians: the result of ``trainer.gaussians()``. watch: is called after each iteration with
    the number of iterations so far.

    Where that cannot be, as where a number is not finite, the closed form is what is given, with a
    :class:`UserNote`.
    """
    config = trainer.config
    start = _started(trainer, gaussians)
    said = {
        name: DECLARED[name].default for name in config.model.approximations.others_than_default
    }
    trainer.release()
    further = tuning(config)
    try:
        shared = share_gaussians(trainer.comm, start)
        tuned = _tuned(trainer.spawn(further, shared), trainer, watch)
    except UserError as error:  # numbers that are not finite, or too little memory by now
        note = f"the Gaussians for viewers are not fitted any further: {error}"
        warnings.warn(UserNote(note), stacklevel=2)
        tuned = start
    release_unused_memory()  # of what those iterations had
    gaussians = replace(tuned, rendered_with=said)
    return ForViewers(gaussians, further.model, trainer.dataset.background, trainer.effects)


def _tuned(tuner: Trainer, trainer: Trainer, watch: Callable[[int], None]) -> Gaussians:
    """After the iterations that follow those of ``trainer``."""
    before = trainer.config.iterations
    tuner.warm_start(trainer)
    while tuner.iteration < tuner.config.iterations:
        if tuner.step().passes(tuner.config.output.history_every):
            tuner.check_iterations()
        watch(tuner.iteration - before)
    return tuner.gaussians()


def _started(trainer: Trainer, gaussians: Gaussians) -> Gaussians:
    """In closed form, by the training cameras as the fit has them."""
    states = (read_sensor(sensor, trainer.integrator.near) for sensor in trainer.sensors())
    on_device = baked(gaussians).to(mi.TensorXf)
    with dr.suspend_grad():
        cameras = map(camera_from_sensor, states)
        return baked_for_viewers(on_device, cameras, trainer.config.model.approximations)


def tuning(config: FitConfig) -> FitConfig:
    """The configuration of the iterations that follow those of ``config``."""
    before = config.iterations
    total = before + num_iterations(config)
    kept = {"max_gaussians": config.densify.max_gaussians}
    views_per_step = config.optimizer.views_per_step  # which processes may share
    changes = {
        **{f"model.{name}": _as_configured(name) for name in DECLARED},
        "model.smoothing": False,
        "iterations": total,
        "coarse": [],
        "densify": {"strategy": "adc", "start": 0, "stop": 1, **kept},  # never changes
        "optimizer": {**RATES, "decay_from": before / total, "views_per_step": views_per_step},
        **{f"cameras.{name}_lr": 0.0 for name in ("rotation", "translation", "focal", "principal")},
    }
    if config.colors.lr is not None:
        changes["colors.lr"] = NEXT_TO_NOTHING
    return changed(config, changes)


def _as_configured(name: str) -> object:
    """The default of an approximation, as a configuration has it."""
    declared = DECLARED[name]
    if declared.unrounded is not None:
        return declared.unrounded
    return None if declared.default == math.inf else declared.default
