"""Scenes for each approximation, and what its images and derivatives are checked against."""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drgs.accuracy import exact, pixel_order, ray_colors
from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import rays as reference_rays
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from support.helpers import (
    FLOAT32,
    FLOAT64,
    device_camera,
    device_gaussians,
    frame_adjoint,
    frame_tangent,
    random_scene,
    rows,
    single,
    stacked_scene,
)

APPROXIMATIONS = {
    "exact": {"projection": "exact"},
    "unscented": {"projection": "unscented"},
    "pixel order": {"order": "pixel", "order_window": 8},
    "unscented, pixel order": {"projection": "unscented", "order": "pixel", "order_window": 8},
    "exact, pixel order": {"projection": "exact", "order": "pixel", "order_window": 8},
    "pixel colours": {"sh_direction": "pixel"},
    "all three": {
        "projection": "exact", "order": "pixel", "order_window": 8, "sh_direction": "pixel"
    },
    "all three, other cuts": {
        "projection": "exact", "order": "pixel", "order_window": 8, "sh_direction": "pixel",
        "alpha_max": 0.7, "alpha_cut": 0.03, "transmittance_stop": 0.05
    },
    "no cuts": {"alpha_cut": 0.0, "transmittance_stop": 0.0},
    "exact, no cuts": {"projection": "exact", "alpha_cut": 0.0, "transmittance_stop": 0.0},
    "other cuts": {"alpha_max": 0.7, "alpha_cut": 0.03, "transmittance_stop": 0.05},
    "3 sigma": {"extent": 3.0},
    "exact, 2 sigma": {"projection": "exact", "extent": 2.0},
    "wide low-pass": {"low_pass": 2.0},
    "no low-pass": {"low_pass": 0.0},
    "exact, no low-pass": {"projection": "exact", "low_pass": 0.0},
    "exact, antialiased": {"projection": "exact", "antialiased": True},
    "unscented, antialiased": {"projection": "unscented", "antialiased": True},
}  # fmt: skip


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


@cache
def central_differences(problem, parameter, weights_seed, seed) -> float:
    """Return the reference's d sum(weights * planes) along :func:`direction`."""
    weights, d = problem.weights(weights_seed), direction(problem, parameter, seed)

    def moved(sign):
        values = {
            n: getattr(problem.inputs[0], n) + sign * STEP * getattr(d, n) for n in PARAMETER_NAMES
        }
        return problem.reference_planes(reference.Gaussians(**values))

    return np.sum(weights * (moved(1) - moved(-1))) / (2 * STEP)


def check_gradients_equal_central_differences_of_the_reference(scene, name):
    problem = Problem(name, scene)
    gradients = problem.kernel_gradients(FLOAT64, problem.weights(seed=1))
    for parameter in PARAMETER_NAMES:
        d = direction(problem, parameter, seed=2)
        terms = getattr(d, parameter) * gradients[parameter]
        expected = central_differences(problem, parameter, weights_seed=1, seed=2)
        # A sum of terms of both signs: relative to their size.
        assert abs(terms.sum() - expected) < 1e-6 * np.abs(terms).sum(), parameter


def check_adjoint_is_the_transpose_of_the_tangent(precision, scene, name):
    problem = Problem(name, scene)
    weights = problem.weights(seed=3, marked=MARKED[precision])
    gradients = problem.kernel_gradients(precision, weights)
    gaussians, frame = problem.render(precision)
    for parameter in PARAMETER_NAMES:
        d = direction(problem, parameter, seed=4)
        tangent = frame_tangent(gaussians, frame, device_gaussians(d, precision))
        left = np.float64(weights) * problem.as_planes(tangent)
        right = np.float64(getattr(d, parameter)) * gradients[parameter]
        size = np.abs(left).sum() + np.abs(right).sum()
        # Sums of thousands of terms, each as accurate as the arrays are.
        assert abs(left.sum() - right.sum()) <= GRADIENTS[precision] / 5 * size, parameter


def check_behind_hundreds_of_layers_gradients_keep_their_accuracy():
    """Light from behind is known as a difference of sums; a splat seen through a transmittance of
    1e-9 would have no digit left. Colours darken with depth, so that all terms are positive.
    """
    count = 220
    rng = np.random.default_rng(0)
    camera = reference.Camera(np.eye(3), np.zeros(3), 20.0, 20.0, 8.0, 8.0, 16, 16)
    z = np.linspace(2, 4, count)
    gaussians = reference.Gaussians(
        means=single(np.column_stack([rng.normal(0, 0.02, (count, 2)) * z[:, None], z])),
        quats=single(rng.normal(size=(count, 4))),
        log_scales=single(np.log(rng.uniform(1.2, 1.5, (count, 3)) * z[:, None])),
        logit_opacities=single(np.full(count, -2.3)),
        sh0=single(np.repeat(np.linspace(1, -1, count), 3).reshape(count, 1, 3)),
        shN=np.zeros((count, 0, 3)),
    )
    pipeline = pipeline_of(Approximations(order="pixel", order_window=1, transmittance_stop=0.0), 0)
    results = []
    for precision in (FLOAT64, FLOAT32):
        device = device_gaussians(gaussians, precision)
        frame = rendering.render(device, device_camera(camera, precision), pipeline)
        ones = precision.array(np.ones(256))
        gradients = frame_adjoint(device, frame, [ones] * 3, 0 * ones)
        results.append(np.array(gradients.parameters.logit_opacities))
        assert np.array(frame.planes()[0]).max() < 1e-8
    # Doubled precision, 2^-48 a layer, relative to 1e-9 and to a twentieth of the colour.
    np.testing.assert_allclose(results[1], results[0], rtol=1e-3)


def check_sums_of_products_are_exact_to_twice_the_precision():
    """The second half of the terms almost cancels the first."""
    count = 100
    rng = np.random.default_rng(0)
    a, b = (single(rng.normal(size=count)) for _ in range(2))
    a, b = np.append(a, -a), np.append(b, b * (1 + 2.0**-20))
    assert (a == single(a)).all()
    high = low = FLOAT32.Float(0)
    for x, y in zip(a, single(b), strict=True):
        high, low = pixel_order._add_product(high, low, FLOAT32.Float(x), FLOAT32.Float(y))
    expected = math.fsum(a * single(b))
    # Doubled single precision: 2^-48 a term.
    assert abs(float(high[0]) + float(low[0]) - expected) < 200 * 2.0**-48 * np.abs(a * b).max()


def check_twins_are_composited_in_one_order_by_image_and_derivative():
    """Every splat is there twice, in two colours, at equal depths. Images are linear in the
    colours that are not clamped: their derivatives, times them, give the image again. (The window
    is odd: a comparison that swaps twins does it again at every insertion.)
    """
    gaussians, camera = close_scene(3, 20, 12, 0, 10)
    twins = {n: np.repeat(getattr(gaussians, n), 2, axis=0) for n in PARAMETER_NAMES}
    twins["sh0"] = single(np.random.default_rng(1).uniform(-1, 1, (20, 1, 3)))
    pipeline = pipeline_of(Approximations(projection="exact", order="pixel", order_window=7), 0)
    weights = single(np.random.default_rng(2).normal(size=(3, 240)))
    device = device_gaussians(reference.Gaussians(**twins), FLOAT64)
    frame = rendering.render(device, device_camera(camera, FLOAT64), pipeline)
    black = device_gaussians(reference.Gaussians(**{**twins, "sh0": 0 * twins["sh0"]}), FLOAT64)
    without = rendering.render(black, device_camera(camera, FLOAT64), pipeline)
    gradients = frame_adjoint(device, frame, [precise(w) for w in weights], precise(0 * weights[0]))
    images = [np.array([rows(p) for p in f.planes()[1:]]) for f in (frame, without)]
    linear = np.sum(weights * (images[0] - images[1]))
    from_gradients = np.sum(twins["sh0"] * np.array(gradients.parameters.sh0))
    assert from_gradients == pytest.approx(linear, rel=1e-12)


def precise(values):
    return FLOAT64.array(values)


def check_a_peak_in_the_plane_of_the_camera_shows_nothing():
    """Nor does one behind it: a = 1 - dx is 0 at dx = 1, and -1 at dx = 2."""
    number = FLOAT64.Float
    geometry = [number(x) for x in (0.5, 0.5, 1, 0, 1, 0, -1, 0, 0.5)]
    camera = device_camera(SCENES["close"][0](3, 40, 23, 1, 1)[1], FLOAT64)

    def offsets_from(x, y):
        return [[i + 0.5 - x for i in range(4)]] * 4, [[j + 0.5 - y] * 4 for j in range(4)]

    falloff = exact.RayFalloff().for_camera(camera)
    footprint = falloff.footprint(geometry, offsets_from, number(0) == 0)
    shows = np.array([float(x[0]) > -math.inf for x in footprint.log2_alpha]).reshape(4, 4)
    assert shows[:, 0].all() and not shows[:, 1:].any()


def check_a_splat_without_opacity_has_no_derivatives():
    """An opacity that underflows to zero has the logarithm - inf."""
    number = FLOAT64.Float
    falloff = exact.RayFalloff()
    geometry = [number(x) for x in (0.5, 0.5, 1, 0, 1, -math.inf, -1, 0, 0.5)]
    derivatives = falloff.derivatives(geometry, [number(0)] * falloff.num_moments)
    assert [float(d[0]) for d in derivatives] == [0] * 9


def check_a_colour_at_its_minimum_keeps_its_derivative():
    """Dr.Jit's selection does the same for the colour at the mean; below it there is none."""
    number = FLOAT64.Float
    colors = ray_colors.RayColors(sh_degree=0, basis=([number(1)],))
    stored = [number(x) for x in (-0.5, -0.75, 0, -3)]  # colour 0, -0.25, 0.5; another feature
    zeros, ones = [number(0)] * 4, [number(1)] * 4
    derivatives = colors.add_derivatives(zeros, stored, 0, number(1), ones)
    tangents = colors.tangents(stored, ones, 0)
    for values in (derivatives, tangents):
        assert [float(x[0]) for x in values] == [1, 0, 1, 1]
