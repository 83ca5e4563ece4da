"""Keeps the 3D smoothing filter of a fit up to date."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import mitsuba as mi
import numpy as np
from typing_extensions import override

from drgs.config.extensions import EFFECTS
from drgs.core.types import Float
from drgs.effects.smoothing import smoothing_of
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.training.effects.base import FitState, TrainingEffect

UPDATE_EVERY = 100
"""Iterations (as in Mip-Splatting's code); also where another stage begins, and after each change
of the population."""


@EFFECTS.register("smoothing")
class TrainingSmoothing(TrainingEffect):
    """The filter of ``drgs.effects.smoothing``, from the training cameras at the size in use."""

    name = "smoothing"
    by_row = frozenset({"filter"})

    def __init__(self) -> None:
        self.filter: Float | None = None

    @override
    def begin(self, fit: FitState) -> None:
        is_due = any(iteration % UPDATE_EVERY == 1 for iteration in fit.iterations_of_step)
        if self.filter is None or fit.begins_stage or is_due:
            self.filter = _smoothing(fit)
        fit.integrator.smoothing = self.filter

    @override
    def finish(self, fit: FitState) -> None:
        """Set the filter of the current means; the fit continues with the previous one."""
        fit.integrator.smoothing = _smoothing(fit)

    @override
    def on_population_change(self, fit: FitState) -> None:
        self.filter = fit.integrator.smoothing = None

    @override
    def state(self) -> dict[str, np.ndarray]:
        return {} if self.filter is None else {"filter": np.array(self.filter)}

    @override
    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self.filter = cast(Float, mi.Float(state["filter"])) if "filter" in state else None


def _smoothing(fit: FitState) -> Float:
    states = (read_sensor(sensor, fit.integrator.near) for sensor in fit.sensors())
    return smoothing_of(fit.means, map(camera_from_sensor, states))
