"""Scenes for each approximation, and what its images and derivatives are checked against."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import rays as reference_rays
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from support.cases import APPROXIMATIONS
from support.helpers import (
    FLOAT32,
    FLOAT64,
    device_camera,
    device_gaussians,
    frame_adjoint,
    random_scene,
    rows,
    single,
    stacked_scene,
)

# Tolerances of test_rendering.
PLANES = {FLOAT64: 1e-12, FLOAT32: 2e-5}


GRADIENTS = {FLOAT64: 1e-12, FLOAT32: 5e-5}


MARKED = {FLOAT64: 1e-9, FLOAT32: 1e-4}
"""Relative distance from a decision within which a pixel is left out; for single precision see
helpers.NEAR_THRESHOLD."""


def close_scene(seed, width, height, degree, count):
    """Large splats that begin near the camera, seen through a wide lens: what the affine
    approximation is bad at.
    """
    gaussians, camera = stacked_scene(seed, width, height, degree, count)
    camera = replace(camera, fx=camera.fx / 2, fy=camera.fy / 2)
    rng = np.random.default_rng(seed)
    points = (gaussians.means - camera.center) @ camera.rotation.T
    points[:, :2] *= rng.uniform(0.3, 2.0, (count, 1))
    points *= rng.uniform(0.25, 1.0, (count, 1))
    means = single(points @ camera.rotation + camera.center)
    scales = single(gaussians.log_scales - rng.uniform(0.3, 2.0, (count, 3)))
    logits = single(rng.normal(0.5, 1.2, count))
    return replace(gaussians, means=means, log_scales=scales, logit_opacities=logits), camera


def around_scene(seed, width, height, degree, count):
    """Needles that reach past the camera: rays meet their peaks before and behind it."""
    gaussians, camera = close_scene(seed, width, height, degree, count)
    rng = np.random.default_rng(seed)
    tilt = Rotation.from_rotvec(rng.normal(0, 0.4, (count, 3)))
    quats = (Rotation.from_matrix(camera.rotation.T) * tilt).as_quat(scalar_first=True)
    depths = (gaussians.means - camera.center) @ camera.rotation[2]
    scales = rng.uniform([0.1, 0.1, 0.5], [0.3, 0.3, 1.5], (count, 3)) * depths[:, None]
    return replace(gaussians, quats=single(quats), log_scales=single(np.log(scales))), camera


SCENES = {
    "random": (random_scene, 37, 29, 1, 60),
    "close": (close_scene, 40, 23, 1, 20),
    "around": (around_scene, 40, 23, 1, 8),
}


@dataclass(frozen=True)
class Problem:
    """An approximation and a scene, for both sides."""

    name: str
    scene: str

    @property
    def approximations(self) -> Approximations:
        return Approximations(**APPROXIMATIONS[self.name])

    @property
    def inputs(self) -> tuple[reference.Gaussians, reference.Camera]:
        return _inputs(self.scene)

    @property
    def pipeline(self) -> rendering.Pipeline:
        return pipeline_of(self.approximations, SCENES[self.scene][3])

    def rendered(self, threshold_width) -> reference.RenderedImage:
        return _image(self, threshold_width)

    def reference_planes(self, gaussians) -> np.ndarray:
        """(H, W, 4): transmittance and colour."""
        return _planes(reference_rays.render(gaussians, self.inputs[1], (0, 0, 0), self.model))

    @property
    def model(self) -> reference_rays.ImageModel:
        names = set(reference_rays.ImageModel.__dataclass_fields__) & set(vars(self.approximations))
        return reference_rays.ImageModel(**{n: getattr(self.approximations, n) for n in names})

    def render(self, precision):
        gaussians = device_gaussians(self.inputs[0], precision)
        camera = device_camera(self.inputs[1], precision)
        return gaussians, rendering.render(gaussians, camera, self.pipeline)

    def kernel_planes(self, precision) -> np.ndarray:
        _, frame = self.render(precision)
        return self.as_planes(frame.planes())

    def as_planes(self, planes) -> np.ndarray:
        camera = self.inputs[1]
        return np.stack([rows(p).reshape(camera.height, camera.width) for p in planes], axis=-1)

    def weights(self, seed, marked=1e-3) -> np.ndarray:
        """(H, W, 4), zero at pixels that a small step may take across a decision."""
        camera = self.inputs[1]
        weights = np.random.default_rng(seed).normal(size=(camera.height, camera.width, 4))
        return single(weights * ~self.rendered(marked).near_threshold[..., None])

    def kernel_gradients(self, precision, weights) -> dict[str, np.ndarray]:
        gaussians, frame = self.render(precision)
        d_transmittance, *d_features = [
            precision.array(plane) for plane in np.moveaxis(weights, -1, 0)
        ]
        gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance)
        return {name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES}


@cache
def _inputs(scene):
    recipe, *arguments = SCENES[scene]
    return recipe(3, *arguments)


@cache
def _image(problem, threshold_width):
    return reference_rays.render(
        *problem.inputs, (0, 0, 0), problem.model, threshold_width=threshold_width
    )


def _planes(rendered) -> np.ndarray:
    return np.concatenate([rendered.transmittance[..., None], rendered.image], axis=-1)


def direction(problem, name, seed) -> reference.Gaussians:
    """Normal numbers in one parameter, zero in the others."""
    gaussians = problem.inputs[0]
    rng = np.random.default_rng(seed)
    values = {n: np.zeros_like(getattr(gaussians, n)) for n in PARAMETER_NAMES}
    values[name] = single(rng.normal(size=values[name].shape))
    return reference.Gaussians(**values)


STEP = 2.0**-24
"""Step of central differences: their error is STEP^2 times a third derivative of some 1e5, and
1e-16 / STEP of each plane's values: 1e-8 in all."""
