"""Effects of a pipeline, and composited features: normals, and the user's own."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import drjit as dr

from drgs.cameras.camera import Camera
from drgs.cameras.lens import Pinhole
from drgs.core.arrays import types_of
from drgs.core.types import Float
from drgs.gaussians.parameters import Gaussians, quat_to_rotation
from drgs.splatting.projection import GaussianRows, Splats2D
from drgs.splatting.rendering import Pipeline


def with_effects(pipeline: Pipeline, gaussians: Gaussians, camera: Camera) -> Pipeline:
    """Return ``pipeline`` with the effects that the Gaussians and the camera need."""
    if camera.aperture is not None:
        from drgs.effects.defocus import Defocused, DimmedFalloff

        model = replace(pipeline.model, falloff=DimmedFalloff(pipeline.model.falloff))
        pipeline = replace(pipeline, shape=Defocused(pipeline.shape), model=model)
    reads_rows = camera.shutter is not None and camera.shutter.reads_rows
    if reads_rows and not pipeline.model.for_camera(camera).falloff.follows_rays:
        from drgs.effects.rolling_shutter import Sheared

        pipeline = replace(pipeline, shape=Sheared(pipeline.shape))
    if gaussians.smoothing is not None:
        from drgs.effects.smoothing import apply_smoothing

        pipeline = replace(pipeline, rows=apply_smoothing)
    return pipeline


IGNORABLE = ("distortion", "defocus", "motion", "smoothing")
"""Effects of a sensor or a file that can be left out; the last is no camera's."""


def without_effects(camera: Camera, ignored: Collection[str]) -> Camera:
    """Return the camera without ignored effects: ``distortion``, ``defocus``, ``motion``."""
    if "distortion" in ignored and camera.lens.distorts:
        camera = replace(camera, lens=Pinhole())
    if "defocus" in ignored:
        camera = replace(camera, aperture=None)
    if "motion" in ignored:
        camera = replace(camera, shutter=None)
    return camera


def normal_features(splats: Splats2D, rows: GaussianRows, camera: Camera) -> list[Float]:
    """Return the normals of flat Gaussians, in the world: three planes.

    A Gaussian's normal is its shortest axis, a unit vector that points to the camera. What is
    composited is the alpha-weighted sum, whose length is at most alpha. Differentiable in the
    quaternions. Not differentiated: which axis is the shortest, and which way it points.
    """
    del splats
    t = types_of(type(rows.logit_opacities))
    rotation = quat_to_rotation(rows.quats)
    a, b, c = dr.detach(rows.log_scales)
    first, second = (a <= b) & (a <= c), b <= c

    def shortest(row: int) -> Float:
        x, y, z = rotation[row]
        return dr.select(first, x, dr.select(second, y, z))

    normal = t.Array3f([shortest(row) for row in range(3)])
    direction = camera.lens.view_direction(camera, rows.means - camera.center)
    away = dr.detach(dr.dot(normal, direction)) > 0
    return list(dr.select(away, -normal, normal))


@dataclass(frozen=True)
class NamedFeature:
    """Numbers of Gaussians under a name, composited as one plane each."""

    name: str

    def __call__(self, splats: Splats2D, rows: GaussianRows, camera: Camera) -> list[Float]:
        """Return the feature's columns."""
        del splats, camera
        assert rows.features is not None, "a pipeline composites what there is"
        return list(rows.features[self.name])
