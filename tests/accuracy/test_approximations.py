"""Each choice of accuracy against the float64 reference: picture, gradients, tangents, kernels."""

import math
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import drjit as dr
import numpy as np
import pytest
from conftest import PATHS
from scipy.spatial.transform import Rotation
from support.helpers import (
    FLOAT32,
    FLOAT64,
    assert_arrays_agree,
    both_precisions,
    device_camera,
    device_gaussians,
    frame_adjoint,
    frame_tangent,
    random_scene,
    rows,
    single,
    stacked_scene,
)

from drgs.accuracy import exact as perspective
from drgs.accuracy import pixel_order, ray_colors
from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import rays as reference_rays
from drgs.reference import splatting as reference
from drgs.splatting import rendering

CHOICES = {
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

all_choices = pytest.mark.parametrize("name", CHOICES)

# Those of test_rendering.
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

all_scenes = pytest.mark.parametrize("scene", ("random", "close"))


@dataclass(frozen=True)
class Problem:
    """A choice and a scene, for both sides."""

    name: str
    scene: str

    @property
    def choices(self) -> Approximations:
        return Approximations(**CHOICES[self.name])

    @property
    def inputs(self) -> tuple[reference.Gaussians, reference.Camera]:
        return _inputs(self.scene)

    @property
    def pipeline(self) -> rendering.Pipeline:
        return pipeline_of(self.choices, SCENES[self.scene][3])

    def picture(self, threshold_width) -> reference.Picture:
        return _picture(self, threshold_width)

    def reference_planes(self, gaussians) -> np.ndarray:
        """(H, W, 4): transmittance and colour."""
        return _planes(reference_rays.render(gaussians, self.inputs[1], (0, 0, 0), self.model))

    @property
    def model(self) -> reference_rays.ImageModel:
        names = set(reference_rays.ImageModel.__dataclass_fields__) & set(vars(self.choices))
        return reference_rays.ImageModel(**{n: getattr(self.choices, n) for n in names})

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
        return single(weights * ~self.picture(marked).near_threshold[..., None])

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
def _picture(problem, threshold_width):
    return reference_rays.render(
        *problem.inputs, (0, 0, 0), problem.model, threshold_width=threshold_width
    )


def _planes(picture) -> np.ndarray:
    return np.concatenate([picture.transmittance[..., None], picture.image], axis=-1)


# ----------------------------------------------------------------------------------------------
# Pictures
# ----------------------------------------------------------------------------------------------


@both_precisions
@all_scenes
@all_choices
def test_picture_equals_the_reference(precision, scene, name):
    problem = Problem(name, scene)
    picture = problem.picture(MARKED[precision])
    kept = ~picture.near_threshold
    assert kept.mean() > 0.9
    actual = {"planes": problem.kernel_planes(precision)[kept]}
    assert_arrays_agree(actual, {"planes": _planes(picture)[kept]}, PLANES[precision])


@all_choices
def test_choice_changes_the_picture(name):
    """Otherwise the tests above would compare the default with itself."""
    default = [reference.render(*_inputs(scene)) for scene in SCENES]
    chosen = [Problem(name, scene).picture(1e-9) for scene in SCENES]
    assert any(np.abs(a.image - b.image).max() > 1e-3 for a, b in zip(chosen, default, strict=True))


def test_order_converges_with_the_window():
    """A layer of discs tilted every way: their order differs from pixel to pixel."""
    scene = Problem("exact, pixel order", "close")
    expected = scene.picture(1e-9)
    errors = []
    for window in (1, 2, 4, 8):
        pipeline = pipeline_of(replace(scene.choices, order_window=window), 1)
        gaussians, camera = scene.inputs
        frame = rendering.render(
            device_gaussians(gaussians, FLOAT64), device_camera(camera, FLOAT64), pipeline
        )
        difference = scene.as_planes(frame.planes()) - _planes(expected)
        errors.append(np.sqrt(np.mean(difference[~expected.near_threshold] ** 2)))
    assert errors[0] > 1e-3 and errors[-1] < 1e-13
    assert all(after <= before + 1e-12 for before, after in pairwise(errors))


# ----------------------------------------------------------------------------------------------
# Derivatives
# ----------------------------------------------------------------------------------------------


def direction(problem, name, seed) -> reference.Gaussians:
    """Normal numbers in one parameter, zero in the others."""
    gaussians = problem.inputs[0]
    rng = np.random.default_rng(seed)
    values = {n: np.zeros_like(getattr(gaussians, n)) for n in PARAMETER_NAMES}
    values[name] = single(rng.normal(size=values[name].shape))
    return reference.Gaussians(**values)


STEP = 2.0**-24
"""Of the central differences: their error is STEP^2 times a third derivative of some 1e5, and
1e-16 / STEP of each plane's values: 1e-8 in all."""


@cache
def central_differences(problem, parameter, weights_seed, seed) -> float:
    """Of the reference, along :func:`direction`: d sum(weights * planes)."""
    weights, d = problem.weights(weights_seed), direction(problem, parameter, seed)

    def moved(sign):
        values = {
            n: getattr(problem.inputs[0], n) + sign * STEP * getattr(d, n) for n in PARAMETER_NAMES
        }
        return problem.reference_planes(reference.Gaussians(**values))

    return np.sum(weights * (moved(1) - moved(-1))) / (2 * STEP)


@all_scenes
@all_choices
def test_gradients_equal_central_differences_of_the_reference(scene, name):
    problem = Problem(name, scene)
    gradients = problem.kernel_gradients(FLOAT64, problem.weights(seed=1))
    for parameter in PARAMETER_NAMES:
        d = direction(problem, parameter, seed=2)
        terms = getattr(d, parameter) * gradients[parameter]
        expected = central_differences(problem, parameter, weights_seed=1, seed=2)
        # A sum of terms of both signs: relative to their size.
        assert abs(terms.sum() - expected) < 1e-6 * np.abs(terms).sum(), parameter


@both_precisions
@all_scenes
@all_choices
def test_adjoint_is_the_transpose_of_the_tangent(precision, scene, name):
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


@all_scenes
@all_choices
def test_single_precision_gradients_equal_double_precision(scene, name):
    problem = Problem(name, scene)
    weights = problem.weights(seed=5)
    expected = problem.kernel_gradients(FLOAT64, weights)
    assert_arrays_agree(problem.kernel_gradients(FLOAT32, weights), expected, GRADIENTS[FLOAT32])


@all_choices
def test_same_bytes_in_every_run(name):
    problem = Problem(name, "random")
    weights = problem.weights(seed=6)
    first, second = (
        [problem.kernel_planes(FLOAT32), *problem.kernel_gradients(FLOAT32, weights).values()]
        for _ in range(2)
    )
    assert [a.tobytes() for a in first] == [a.tobytes() for a in second]


def test_behind_hundreds_of_layers_gradients_keep_their_accuracy():
    """What lies behind is known as a difference of sums; a splat seen through a transmittance of
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


def test_what_the_order_of_faint_splats_is_worth():
    """A splat before 200 that are fainter than what is put in order: it loses at most their sum of
    its light, and they gain at most as much.
    """
    faint, count = 0.9 * pixel_order.UNORDERED_ALPHA, 201
    z = np.linspace(2, 4, count)
    alphas = np.full(count, faint)
    alphas[0] = 0.5
    gaussians = reference.Gaussians(
        means=single(np.column_stack([0 * z, 0 * z, z])),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=single(np.log(np.full((count, 3), 0.5) * z[:, None])),
        logit_opacities=single(np.log(alphas / (1 - alphas))),
        sh0=single(np.random.default_rng(0).normal(size=(count, 1, 3))),
        shN=np.zeros((count, 0, 3)),
    )
    camera = reference.Camera(np.eye(3), np.zeros(3), 20.0, 20.0, 8.0, 8.0, 16, 16)
    choices = {"order": "pixel", "alpha_cut": 0.0, "transmittance_stop": 0.0}
    expected = reference_rays.render(gaussians, camera, model=reference_rays.ImageModel(**choices))
    device = device_gaussians(gaussians, FLOAT64)
    pipeline = pipeline_of(Approximations(**choices, order_window=4), 0)
    frame = rendering.render(device, device_camera(camera, FLOAT64), pipeline)
    color = np.stack([rows(plane) for plane in frame.planes()[1:]], axis=-1)
    error = np.abs(color - expected.image.reshape(-1, 3))
    brightest = np.maximum(gaussians.sh0 * reference.C_00 + 0.5, 0).max()
    assert error.max() <= brightest * alphas[0] * alphas[1:].sum()
    T = rows(frame.planes()[0])
    np.testing.assert_allclose(T, expected.transmittance.ravel(), rtol=0, atol=1e-12)


def test_no_stop_leaves_gradients_behind_any_number_of_opaque_layers():
    """Transmittance is 1e-60 there, which float32 has not: it ends before."""
    count = 30
    camera = reference.Camera(np.eye(3), np.zeros(3), 20.0, 20.0, 8.0, 8.0, 16, 16)
    z = np.linspace(2, 4, count)
    gaussians = reference.Gaussians(
        means=single(np.column_stack([0 * z, 0 * z, z])),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), single(np.log(3))),
        logit_opacities=np.full(count, 12.0),
        sh0=single(np.random.default_rng(0).normal(size=(count, 1, 3))),
        shN=np.zeros((count, 0, 3)),
    )
    results = []
    for precision in (FLOAT64, FLOAT32):
        device = device_gaussians(gaussians, precision)
        pipeline = pipeline_of(Approximations(transmittance_stop=0.0), 0)
        frame = rendering.render(device, device_camera(camera, precision), pipeline)
        ones = precision.array(np.ones(256))
        gradients = frame_adjoint(device, frame, [ones] * 3, 0 * ones).parameters
        results.append([np.array(gradients.sh0), np.array(gradients.logit_opacities)])
    for single_precision, correct in zip(results[1], results[0], strict=True):
        tolerance = GRADIENTS[FLOAT32] * np.abs(correct).max()
        np.testing.assert_allclose(single_precision, correct, rtol=0, atol=tolerance)


def test_sums_of_products_are_exact_to_twice_the_precision():
    """The second half of the terms almost cancels the first."""
    count = 100
    rng = np.random.default_rng(0)
    a, b = (single(rng.normal(size=count)) for _ in range(2))
    a, b = np.append(a, -a), np.append(b, b * (1 + 2.0**-20))
    assert (a == single(a)).all()
    high = low = FLOAT32.Float(0)
    for x, y in zip(a, single(b), strict=True):
        high, low = pixel_order._add_product(high, low, FLOAT32.Float(x), FLOAT32.Float(y))
    exact = math.fsum(a * single(b))
    # Of doubled single precision, 2^-48 a term.
    assert abs(float(high[0]) + float(low[0]) - exact) < 200 * 2.0**-48 * np.abs(a * b).max()


def test_twins_are_composited_in_one_order_by_picture_and_derivative():
    """Every splat is there twice, in two colours, at equal depths. Pictures are linear in the
    colours that are not clamped: their derivatives, times them, give the picture again. (The window
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
    pictures = [np.array([rows(p) for p in f.planes()[1:]]) for f in (frame, without)]
    linear = np.sum(weights * (pictures[0] - pictures[1]))
    from_gradients = np.sum(twins["sh0"] * np.array(gradients.parameters.sh0))
    assert from_gradients == pytest.approx(linear, rel=1e-12)


def precise(values):
    return FLOAT64.array(values)


def test_a_peak_in_the_plane_of_the_camera_shows_nothing():
    """Nor does one behind it: a = 1 - dx is 0 at dx = 1, and -1 at dx = 2."""
    number = FLOAT64.Float
    geometry = [number(x) for x in (0.5, 0.5, 1, 0, 1, 0, -1, 0, 0.5)]
    camera = device_camera(SCENES["close"][0](3, 40, 23, 1, 1)[1], FLOAT64)

    def offsets_from(x, y):
        return [[i + 0.5 - x for i in range(4)]] * 4, [[j + 0.5 - y] * 4 for j in range(4)]

    response = perspective.RayResponse().seen_by(camera)
    footprint = response.footprint(geometry, offsets_from, number(0) == 0)
    shows = np.array([float(x[0]) > -math.inf for x in footprint.log2_alpha]).reshape(4, 4)
    assert shows[:, 0].all() and not shows[:, 1:].any()


def test_a_splat_without_opacity_has_no_derivatives():
    """An opacity that underflows to zero has the logarithm - inf."""
    number = FLOAT64.Float
    response = perspective.RayResponse()
    geometry = [number(x) for x in (0.5, 0.5, 1, 0, 1, -math.inf, -1, 0, 0.5)]
    derivatives = response.derivatives(geometry, [number(0)] * response.num_moments)
    assert [float(d[0]) for d in derivatives] == [0] * 9


def test_a_colour_at_its_minimum_keeps_its_derivative():
    """As Dr.Jit's selection does for the colour at the mean; below it there is none."""
    number = FLOAT64.Float
    colors = ray_colors.RayColors(sh_degree=0, basis=([number(1)],))
    stored = [number(x) for x in (-0.5, -0.75, 0, -3)]  # colour 0, -0.25, 0.5; another feature
    zeros, ones = [number(0)] * 4, [number(1)] * 4
    derivatives = colors.add_derivatives(zeros, stored, 0, number(1), ones)
    tangents = colors.tangents(stored, ones, 0)
    for values in (derivatives, tangents):
        assert [float(x[0]) for x in values] == [1, 0, 1, 1]


# ----------------------------------------------------------------------------------------------
# Approximations
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"projection": "affine"}, "projection must be one of ewa, unscented, exact, got 'affine'"),
        ({"order": "entry"}, "order must be one of center, pixel, got 'entry'"),
        ({"order_window": 0}, "order_window must be from 1 to 64, got 0"),
        ({"sh_direction": "ray"}, "sh_direction must be one of mean, pixel, got 'ray'"),
        ({"alpha_max": 1.0}, "alpha_max must be above 0 and below 1 in float32, got 1.0"),
        ({"alpha_max": 1 - 1e-9}, "alpha_max must be above 0 and below 1 in float32, got 0.99999"),
        ({"alpha_cut": -0.1}, "alpha_cut must be from 0 to below 1, got -0.1"),
        ({"transmittance_stop": math.nan}, "transmittance_stop must be from 0 to below 1, got nan"),
        ({"extent": 0.0}, "extent must be positive, got 0.0"),
        ({"low_pass": math.inf}, "low_pass must be finite and not negative, got inf"),
    ],
)
def test_what_is_no_choice_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Approximations(**values)


def test_equal_choices_make_equal_pipelines():
    """The plugin reuses a frame whose pipeline is the same."""
    for values in ({}, *CHOICES.values()):
        assert pipeline_of(Approximations(**values), 2) == pipeline_of(Approximations(**values), 2)
        assert values == {} or pipeline_of(Approximations(**values), 2) != pipeline_of(
            Approximations(), 2
        )


CHOSEN_MODULES = (
    "exact", "peak_depths", "pixel_lists", "pixel_order", "ray_colors", "sample_points",
    "unscented",
)  # fmt: skip

PROGRAM = """
import json, sys
sys.path[:0] = {tests!r}
for name in {blocked!r}:
    sys.modules["drgs.accuracy." + name] = None  # importing it raises ImportError
import test_composition as t
from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
print(json.dumps(t.kernels_of_a_frame(pipeline_of(Approximations(**{choices!r}), 2))))
"""


def kernels_in_a_new_process(run_python, blocked, **choices):

    program = PROGRAM.format(tests=PATHS, blocked=blocked, choices=choices)
    return run_python(program)


def test_a_choice_that_is_not_taken_costs_nothing(run_python):
    """Hash and operation count of the default's kernels, with all other modules out of reach."""
    import json

    results = [kernels_in_a_new_process(run_python, blocked) for blocked in ((), CHOSEN_MODULES)]
    assert [r.returncode for r in results] == [0, 0], results[1].stderr
    whole, reduced = (json.loads(r.stdout) for r in results)
    assert whole == reduced and all(len(kernels) >= 3 for kernels in whole.values())


@pytest.mark.parametrize(
    ("module", "choices"),
    [
        ("exact", {"projection": "exact"}),
        ("unscented", {"projection": "unscented"}),
        ("pixel_order", {"order": "pixel"}),
        ("ray_colors", {"sh_direction": "pixel"}),
    ],
)
def test_a_module_out_of_reach_is_missed_when_it_is_chosen(run_python, module, choices):
    result = kernels_in_a_new_process(run_python, (module,), **choices)
    assert result.returncode != 0 and f"drgs.accuracy.{module}" in result.stderr


def test_choices_take_effect_at_their_stage_alone():
    """Kernels in front of a choice's stage are those of the default."""
    import test_composition as composition

    plain = composition.kernels_of_a_frame(pipeline_of(Approximations(), 1))["forward"]
    cut = composition.kernels_of_a_frame(pipeline_of(Approximations(transmittance_stop=0.0), 1))[
        "forward"
    ]
    assert plain != cut and len(plain) == len(cut)
    assert sum(a != b for a, b in zip(plain, cut, strict=True)) == 1


def test_no_kernel_of_a_choice_reduces_floats_in_memory():
    import test_composition as composition

    problem = Problem("all three", "random")
    weights = problem.weights(seed=8)
    for function in (
        lambda: problem.kernel_planes(FLOAT32),
        lambda: problem.kernel_gradients(FLOAT32, weights),
    ):
        found, count = composition.float_reductions(function)
        assert not found and count > 3


def test_no_gaussians_on_the_film():
    """Empty lists."""
    problem = Problem("exact, pixel order", "random")
    gaussians = replace(problem.inputs[0], means=problem.inputs[0].means * 0 + 1e3)
    device = device_gaussians(gaussians, FLOAT32)
    frame = rendering.render(device, device_camera(problem.inputs[1], FLOAT32), problem.pipeline)
    planes = problem.as_planes(frame.planes())
    assert (planes[..., 0] == 1).all() and not planes[..., 1:].any()
    ones = dr.ones(FLOAT32.Float, planes[..., 0].size)
    gradients = frame_adjoint(device, frame, [ones] * 3, ones)
    assert not any(np.array(getattr(gradients.parameters, n)).any() for n in PARAMETER_NAMES)
