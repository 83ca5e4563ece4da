"""Pipelines that render with given approximations, imported when they are chosen."""

from __future__ import annotations

from dataclasses import replace

from drgs.config.approximations import FALLOFFS, ORDERS, PROJECTIONS, Approximations
from drgs.core.errors import UnsupportedError
from drgs.splatting.footprint import Cutoffs, ImageModel
from drgs.splatting.projection import color_at_mean, compensated_opacity, plain_opacity
from drgs.splatting.rendering import Feature, Pipeline, color_features

MIN_STOP = 1e-30  # stop where none is set: past it float32 has no transmittance to go back from


def pipeline_of(
    approximations: Approximations,
    sh_degree: int,
    features: tuple[Feature, ...] = (color_features,),
) -> Pipeline:
    """Create the pipeline that renders ``features``; sh_degree: of colours, 0 to 3."""
    stop = max(approximations.transmittance_stop, MIN_STOP)
    cutoffs = Cutoffs(
        approximations.alpha_max, approximations.alpha_cut, stop, approximations.extent
    )
    projection = PROJECTIONS.get(approximations.projection).value
    falloff = FALLOFFS.get(approximations.falloff).value
    if projection.falloff is not None:
        if approximations.falloff != FALLOFFS.shipped_names[0]:
            raise UnsupportedError(
                f"splats: projection '{approximations.projection}' has a falloff of its own, got "
                f"falloff '{approximations.falloff}'; use another projection, or no falloff"
            )
        falloff = projection.falloff
    model = ImageModel(falloff=falloff(), cutoffs=cutoffs)
    shape, order = ORDERS.get(approximations.order).value.create(projection, approximations)
    color = color_at_mean
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
