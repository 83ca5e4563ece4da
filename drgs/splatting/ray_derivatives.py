"""Derivatives of images with respect to a camera by way of its pixels' rays, if alpha follows them.

Projected splats do not depend on these rays: see ``drgs.splatting.rendering`` for their part.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr

from drgs.core.arrays import types_of
from drgs.core.types import Float
from drgs.splatting.rasterize import SplatGradients

if TYPE_CHECKING:
    from drgs.splatting.rendering import Frame

POSE_NUMBERS = 12  # the first of a camera; in its own axes, still rays do not depend on them


def add_rays_adjoint(
    frames: list[Frame], d_planes: list[list[Float]], camera: list[Float] | None
) -> list[Float] | None:
    """Add the rays' part to derivatives with respect to the camera's numbers, if there are any.

    Each number takes a pass in forward mode.
    """
    bins, shutter = frames[0].tiles.bins, frames[0].camera.shutter
    if camera is None or not bins.model.falloff.follows_rays:
        return camera
    t, totals = types_of(bins.rows.Float), list(camera)
    zero = dr.zeros(t.Float, bins.num_splats)
    still = SplatGradients([zero] * bins.model.falloff.num_geometry, [zero] * bins.num_features)
    for number in range(POSE_NUMBERS if shutter is None else 0, len(camera)):
        along = [dr.opaque(t.Float, float(number == k)) for k in range(len(camera))]
        tangents = tangents_with_rays(frames, still, along)
        for planes, of_frame in zip(tangents, d_planes, strict=True):
            for tangent, derivative in zip(planes, of_frame, strict=True):
                totals[number] = totals[number] + dr.sum(tangent * derivative)
    return totals


def tangents_with_rays(
    frames: list[Frame], direction: SplatGradients, camera_tangents: list[Float] | None
) -> list[list[Float]]:
    """Return the tangents of each frame's planes along those of the splats and of the rays."""
    found = []
    for frame in frames:
        tiles, model = frame.tiles, frame.tiles.bins.model
        if camera_tangents is not None:
            falloff = model.falloff.with_camera_tangents(camera_tangents)
            tiles = replace(tiles, bins=replace(tiles.bins, model=replace(model, falloff=falloff)))
        found.append(frame.order.tangent(tiles, direction))
    return found
