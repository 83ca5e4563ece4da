"""Stages of a fit: the size of its pictures, and which one each iteration trains on.

From the views of a dataset to what the trainer renders and compares: sensors, loss targets, and
what effects need of each view on the device.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from drgs.config.schema import FitConfig
from drgs.data.images import smaller_view
from drgs.data.types import View
from drgs.integrator.scene import make_sensors
from drgs.training.effects.base import TrainingEffect
from drgs.training.losses import prepare_target
from drgs.training.views import TrainingView


@dataclass(frozen=True, eq=False)
class Stage:
    """Iterations that train on pictures of one size."""

    until: float  # last iteration
    views: list[TrainingView]


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
