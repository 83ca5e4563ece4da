"""Error budgets of the integrator ``splats``: cameras of sensors, images for the search."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.accuracy.error_budget import BudgetReport, Renderer, Search
from drgs.accuracy.pipeline import pipeline_of
from drgs.cameras.camera import Camera
from drgs.config.approximations import Approximations
from drgs.core.errors import PluginError
from drgs.core.types import Float
from drgs.effects.compose import with_effects, without_effects
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.sensors import camera_from_sensor, read_sensor, sensors_of
from drgs.integrator.state import SplatsState
from drgs.splatting import rendering


def renderer_of(
    gaussians: Gaussians,
    given: Approximations,
    sh_degree: int,
    background: tuple[float, float, float],
) -> Renderer:
    """Return the renderer of Gaussians on the device, over a background in display space."""

    def planes(camera: Camera, approximations: Approximations) -> list[Float]:
        with dr.suspend_grad():
            pipeline = with_effects(pipeline_of(approximations, sh_degree), gaussians, camera)
            planes = rendering.render(gaussians, camera, pipeline).planes()
            dr.eval(planes)
        return planes

    return Renderer(planes, given, background)


def meet_error_budget(
    splats: SplatsState, sensors: Sequence[mi.Sensor], budget: float
) -> BudgetReport:
    """Set the cheapest approximations whose images are within ``budget``; return what was found.

    sensors: those that are to be rendered. Surfaces and films' filters are left out of what is
    measured, and a textured background is black. Raises :class:`PluginError` if the budget cannot
    be met.
    """
    alone = [one for sensor in sensors for one in sensors_of(sensor)]
    cameras = [
        without_effects(camera_from_sensor(read_sensor(one, splats.near)), splats.ignore)
        for one in alone
    ]
    background = (0.0, 0.0, 0.0)
    if not isinstance(splats.background, mi.Texture):
        red, green, blue = (float(v) for v in np.array(dr.detach(splats.background)).ravel())
        background = red, green, blue
    try:
        with dr.suspend_grad():
            gaussians, given = dr.detach(splats.gaussians), splats.given_approximations
            renderer = renderer_of(gaussians, given, splats.sh_degree, background)
            report = Search(renderer, cameras).choose(budget)
    except ValueError as error:
        raise PluginError(f"splats: error {error}") from None
    splats.budget_report = report
    return report
