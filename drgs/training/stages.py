"""Stages of a fit: the size of its pictures, and which one each iteration trains on.

From the views of a dataset to what the trainer renders and compares: sensors, loss targets, and
what effects need of each view on the device.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from drgs.config.schema import FitConfig
from drgs.datasets.images import smaller_view
from drgs.datasets.types import View
from drgs.integrator.scene import make_sensors
from drgs.training.effects.base import TrainingEffect, as_tensor
from drgs.training.losses import TARGET_BYTES, Target, prepare_target
from drgs.training.views import TrainingView

KEPT_BYTES = 1 << 30
"""Of targets and effects' uploads that stay on the device until their view is drawn again: of 180
pictures of 400 x 400 px. Without room, they are made anew, in a tenth of an iteration."""


@dataclass(eq=False)
class Stage:
    """Iterations that train on pictures of one size."""

    until: float  # last iteration
    views: list[TrainingView]
    view_bytes: int  # of a pixel: what is made of a view's pictures
    room: int  # bytes left for what stays on the device
    kept: set[int] = field(default_factory=set)  # indices of the views that have it

    def seen(self, view: TrainingView) -> None:
        """After an iteration: keep what was made of the view's pictures, or let it go.

        The first views that are drawn are kept. Each round draws all views, in another order: those
        that were drawn last are no more likely to be drawn next than others.
        """
        if view.index in self.kept:
            return
        size = view.width * view.height * self.view_bytes
        if size > self.room:
            view.let_go()
        else:
            self.room -= size
            self.kept.add(view.index)

    def end(self) -> None:
        """Free what is kept: the stage will not come again."""
        for index in self.kept:
            self.views[index].let_go()
        self.kept.clear()


def make_stages(
    views: tuple[View, ...], config: FitConfig, effects: Sequence[TrainingEffect], room: int
) -> list[Stage]:
    """The configuration's coarse stages, and the last one, of pictures as they are.

    room: bytes of what is made of pictures that may stay on the device.
    """
    sizes = [(s.until, [smaller_view(v, s.factor) for v in views]) for s in config.coarse]
    view_bytes = bytes_on_device(effects)
    return [
        Stage(until, make_training_views(resized, config, effects), view_bytes, room)
        for until, resized in [*sizes, (math.inf, views)]
    ]


def bytes_on_device(effects: Sequence[TrainingEffect]) -> int:
    """Of a pixel of a view: its target, and at most what effects upload."""
    return TARGET_BYTES + sum(effect.upload_bytes for effect in effects)


def make_training_views(
    views: Sequence[View], config: FitConfig, effects: Sequence[TrainingEffect]
) -> list[TrainingView]:
    """Sensors, and what makes loss targets and what effects need, for ``views``."""
    sensors = make_sensors(views, calibrated=any(e.moves_sensors for e in effects))
    return [
        TrainingView(
            name=view.name,
            index=index,
            sensor=sensor,
            size=(view.width, view.height),
            count=partial(_counted, view),
            make_target=partial(_make_target, view, config, effects),
            makers={effect.name: partial(effect.upload, view) for effect in effects},
        )
        for index, (view, sensor) in enumerate(zip(views, sensors, strict=True))
    ]


def _make_target(view: View, config: FitConfig, effects: Sequence[TrainingEffect]) -> Target:
    image = np.asarray(view.image)
    for effect in effects:
        image = effect.target_image(view, image)
    return prepare_target(as_tensor(image), config.loss.window, config.loss.sigma)


def _counted(view: View) -> float:
    return 1.0 if view.mask is None else max(float(np.asarray(view.mask).mean()), 1e-10)
