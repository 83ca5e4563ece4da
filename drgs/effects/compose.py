"""The one place where an effect is put into a pipeline."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from drgs.cameras.camera import Camera
from drgs.cameras.lens import Pinhole
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.rendering import Pipeline


def with_effects(pipeline: Pipeline, gaussians: Gaussians, camera: Camera) -> Pipeline:
    """Return ``pipeline`` with the effects that the Gaussians and the camera need.

    An aperture blurs and dims splats; a smoothing filter widens Gaussians before they are
    projected. A camera that moves needs nothing here: its shutter is an object that
    :meth:`drgs.cameras.camera.Camera.seeing` asks.
    """
    if camera.aperture is not None:
        from drgs.effects.defocus import Defocused, DimmedFalloff

        model = replace(pipeline.model, falloff=DimmedFalloff(pipeline.model.falloff))
        pipeline = replace(pipeline, shape=Defocused(pipeline.shape), model=model)
    if gaussians.smoothing is not None:
        from drgs.effects.smoothing import smoothed

        pipeline = replace(pipeline, rows=smoothed)
    return pipeline


IGNORABLE = ("distortion", "defocus", "motion", "smoothing")
"""What a sensor or a file calls for and one may decide not to simulate; the last is no camera's."""


def without_effects(camera: Camera, ignored: Collection[str]) -> Camera:
    """Return the camera without ignored effects: ``distortion``, ``defocus``, ``motion``."""
    if "distortion" in ignored and camera.lens.distorts:
        camera = replace(camera, lens=Pinhole())
    if "defocus" in ignored:
        camera = replace(camera, aperture=None)
    if "motion" in ignored:
        camera = replace(camera, shutter=None)
    return camera
