"""An error budget of the integrator ``splats``: see ``drgs.accuracy.error_budget``."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.accuracy.error_budget import BudgetReport, choose
from drgs.core.errors import PluginError
from drgs.effects.compose import without_effects
from drgs.integrator.sensors import camera_from_sensor, read_sensor, sensors_of
from drgs.integrator.state import SplatsState


def meet_error_budget(
    splats: SplatsState, sensors: Sequence[mi.Sensor], budget: float
) -> BudgetReport:
    """Set the cheapest approximations whose images are within ``budget``; return what was found.

    sensors: those that are to be rendered. Surfaces, films' filters and open shutters are left out
    of what is measured, and a textured background is black. Raises :class:`PluginError` if the
    budget cannot be met.
    """
    alone = [one for sensor in sensors for one in sensors_of(sensor)]
    cameras = [
        without_effects(camera_from_sensor(read_sensor(one, splats.near).detach()), splats.ignore)
        for one in alone
    ]
    background = (0.0, 0.0, 0.0)
    if not isinstance(splats.background, mi.Texture):
        background = tuple(float(v) for v in np.array(dr.detach(splats.background)).ravel()[:3])
    try:
        with dr.suspend_grad():
            gaussians = dr.detach(splats.gaussians)
            report = choose(
                gaussians, cameras, splats.approximations, splats.sh_degree, background, budget
            )
    except ValueError as error:
        raise PluginError(f"splats: error {error}") from None
    splats.approximations = report.chosen.approximations
    return report
