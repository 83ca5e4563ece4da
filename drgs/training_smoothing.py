"""Keeps the 3D smoothing filter of a fit up to date. Layer 4, imported for ``model.smoothing``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from drgs.camera import camera_from_sensor, read_sensor
from drgs.smoothing import smoothing_of
from drgs.training_effects import TrainingEffect

if TYPE_CHECKING:
    from drgs.trainer import Trainer, TrainingView

EVERY = 100
"""Iterations (as in Mip-Splatting's code); also where another stage begins, and after each change
of the population."""


class TrainingSmoothing(TrainingEffect):
    """The filter of ``drgs.smoothing``, from the training cameras at the size in use."""

    name = "smoothing"

    def __init__(self) -> None:
        self.filter: mi.Float | None = None

    def before(self, trainer: Trainer, view: TrainingView) -> None:
        """Find the filter anew where the means have moved, or are others."""
        del view
        begins = any(trainer.iteration == stage.until + 1 for stage in trainer.stages)
        if self.filter is None or begins or trainer.iteration % EVERY == 1:
            self.filter = self._found(trainer)
        trainer.integrator.smoothing = self.filter

    def finish(self, trainer: Trainer) -> None:
        """The filter of the means as they are; what the fit goes on with stays."""
        trainer.integrator.smoothing = self._found(trainer)

    @staticmethod
    def _found(trainer: Trainer) -> mi.Float:
        for effect in trainer.effects:
            for view in trainer.views:
                effect.place(view)
        states = (read_sensor(view.sensor, trainer.integrator.near) for view in trainer.views)
        return smoothing_of(trainer.means, map(camera_from_sensor, states))

    def repopulated(self, trainer: Trainer) -> None:
        """The former filter has other rows."""
        self.filter = trainer.integrator.smoothing = None

    def state(self) -> dict[str, np.ndarray]:
        """The filter, if there is one."""
        return {} if self.filter is None else {"filter": np.array(self.filter)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue with it."""
        self.filter = mi.Float(state["filter"]) if "filter" in state else None
