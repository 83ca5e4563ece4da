"""From approximations to the pipeline that renders with them.

Everything but the defaults is in modules of its own, imported when it is chosen: what is not chosen
costs nothing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from drgs.config.approximations import Approximations
from drgs.splatting.cutoffs import Cutoffs
from drgs.splatting.image_model import DEFAULT, ImageModel
from drgs.splatting.projection import (
    Projection,
    color_at_mean,
    compensated_opacity,
    ewa,
    plain_opacity,
)
from drgs.splatting.rendering import CenterOrder, Feature, Pipeline, color_features

if TYPE_CHECKING:
    from drgs.accuracy.pixel_lists import PeakDepths

LEAST_STOP = 1e-30
"""Where no stop is asked for: past it float32 has no transmittance to go back from."""


def pipeline_of(
    approximations: Approximations,
    sh_degree: int,
    features: tuple[Feature, ...] = (color_features,),
) -> Pipeline:
    """What renders ``features`` with ``approximations``, colours of ``sh_degree`` (0 to 3)."""
    stop = max(approximations.transmittance_stop, LEAST_STOP)
    cutoffs = Cutoffs(
        approximations.alpha_max, approximations.alpha_cut, stop, approximations.extent
    )
    model = DEFAULT if cutoffs == Cutoffs() else ImageModel(cutoffs=cutoffs)
    shape, order, color = ewa, CenterOrder(), color_at_mean
    if approximations.projection == "exact":
        from drgs.accuracy.exact import RayResponse, exact_shape

        shape, model = exact_shape, replace(model, response=RayResponse())
    elif approximations.projection == "unscented":
        from drgs.accuracy.unscented import unscented_shape

        shape = unscented_shape
    if approximations.order == "pixel":
        from drgs.accuracy.pixel_order import PixelOrder

        shape, depths = _with_depths(approximations, shape)
        order = PixelOrder(approximations.order_window, depths)
    if approximations.sh_direction == "pixel":
        from drgs.accuracy.ray_colors import RayColors, stored_coefficients

        color, model = stored_coefficients, replace(model, features=RayColors(sh_degree))
    return Pipeline(
        sh_degree=sh_degree,
        features=features,
        opacity_rule=compensated_opacity if approximations.antialiased else plain_opacity,
        shape=shape,
        color=color,
        low_pass=approximations.low_pass,
        model=model,
        order=order,
    )


def _with_depths(
    approximations: Approximations, shape: Projection
) -> tuple[Projection, PeakDepths]:
    """A projection that knows depths at a pixel, and who computes them."""
    from drgs.accuracy.exact import ewa_with_depth
    from drgs.accuracy.peak_depths import AffineDepths, RayDepths

    if approximations.projection == "exact":
        return shape, RayDepths()
    if approximations.projection == "unscented":
        from drgs.accuracy.unscented import unscented_with_depth

        return unscented_with_depth, AffineDepths()
    return ewa_with_depth, AffineDepths()
