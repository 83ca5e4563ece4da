"""Single properties of derivatives that no law of rendering shows."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from drgs.accuracy import exact, pixel_order, ray_colors
from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.integrator.film import SamplePoints
from drgs.reference import splatting as reference
from drgs.splatting import footprint, rendering
from drgs.splatting.footprint import Alpha
from drgs.splatting.rasterize import composite_step
from drgs.testing import Case, single
from support.cases import CASES, close, reference_camera, thresholds
from support.helpers import FLOAT32, FLOAT64, device_camera, device_gaussians, frame_adjoint, rows

MIXED = next(case for case in CASES if case.name == "default, mixed")


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
    case = Case("twins", scene=close, width=20, height=12, focal=10.0, count=10, degree=0)
    gaussians, camera = reference.Gaussians(**case.values), reference_camera(case)
    twins = {n: np.repeat(getattr(gaussians, n), 2, axis=0) for n in PARAMETER_NAMES}
    twins["sh0"] = single(np.random.default_rng(1).uniform(-1, 1, (20, 1, 3)))
    pipeline = pipeline_of(Approximations(projection="exact", order="pixel", order_window=7), 0)
    weights = single(np.random.default_rng(2).normal(size=(3, 240)))
    device = device_gaussians(reference.Gaussians(**twins), FLOAT64)
    frame = rendering.render(device, device_camera(camera, FLOAT64), pipeline)
    black = device_gaussians(reference.Gaussians(**{**twins, "sh0": 0 * twins["sh0"]}), FLOAT64)
    without = rendering.render(black, device_camera(camera, FLOAT64), pipeline)
    gradients = frame_adjoint(
        device, frame, [FLOAT64.array(w) for w in weights], FLOAT64.array(0 * weights[0])
    )
    images = [np.array([rows(p) for p in f.planes()[1:]]) for f in (frame, without)]
    linear = np.sum(weights * (images[0] - images[1]))
    from_gradients = np.sum(twins["sh0"] * np.array(gradients.parameters.sh0))
    assert from_gradients == pytest.approx(linear, rel=1e-12)


def check_a_peak_in_the_plane_of_the_camera_shows_nothing():
    """Nor does one behind it: a = 1 - dx is 0 at dx = 1, and -1 at dx = 2."""
    number = FLOAT64.Float
    geometry = [number(x) for x in (0.5, 0.5, 1, 0, 1, 0, -1, 0, 0.5)]
    camera = Case("camera").camera()

    def offsets_from(x, y):
        return [i + 0.5 - x for i in range(4)] * 4, [k // 4 + 0.5 - y for k in range(16)]

    falloff = exact.RayFalloff().for_camera(camera)
    footprint = falloff.footprint(geometry, offsets_from, number(0) == 0)
    shows = np.array([float(x[0]) > -math.inf for x in footprint.log2_alpha]).reshape(4, 4)
    assert shows[:, 0].all() and not shows[:, 1:].any()


def check_a_splat_without_opacity_has_no_derivatives():
    """An opacity that underflows to zero has the logarithm - inf."""
    zero = FLOAT64.Float(0)
    rays = [FLOAT64.Float(x) for x in (0.5, 0.5, 1, 0, 1, -math.inf, -1, 0, 0.5)]
    for falloff, geometry in ((exact.RayFalloff(), rays), (footprint.GaussianFalloff(), rays[:6])):
        derivatives = falloff.derivatives(geometry, [zero] * falloff.num_moments)
        assert [float(d[0]) for d in derivatives] == [0] * len(geometry)


def check_decisions_at_equality_are_replayed():
    """The image is linear in colours; where alpha reaches its maximum, it grows no more."""
    case = thresholds()
    weights = np.random.default_rng(1).normal(size=(5, 81))

    def difference(case, name, row, step):
        moved = {**case.values, name: case.values[name].copy()}
        moved[name][row] += step
        return np.sum(weights * (case.planes(moved) - case.planes(case.values))) / step

    for row, gradient in enumerate(case.gradients(case.values, weights)["sh0"]):
        expected = difference(case, "sh0", row, 2.0**-10)
        assert gradient.sum() == pytest.approx(expected, rel=1e-9)
    clamped = replace(case, approximations={"alpha_max": case.approximations["alpha_max"]})
    found = clamped.gradients(clamped.values, weights)["logit_opacities"][0]
    assert found == pytest.approx(difference(clamped, "logit_opacities", 0, 2.0**-24), rel=1e-5)


def check_decisions_at_equality():
    """Alpha at its cut exists, and a transmittance at the stop is composited."""
    number = FLOAT64.Float
    assert Alpha.from_log2(number(-2), -2.0, 0.5).value[0] == 0.25
    assert composite_step(number(0.5), number(0.5), 0.25)[1][0] == 0.25


def check_a_row_that_is_not_finite_has_no_gradient():
    """The derivatives of other rows and of the camera are the same without it."""
    case, results = MIXED, []
    weights = [FLOAT64.array(w) for w in np.random.default_rng(1).normal(size=(5, 162))]
    for extra in (0, 1):
        nan = {n: np.full_like(v[:extra], np.nan) for n, v in case.values.items()}
        values = {n: np.concatenate([v, nan[n]]) for n, v in case.values.items()}
        gaussians, frames = case.frames(values)
        found = rendering.frames_adjoint(gaussians, frames, [weights], with_camera=True)
        results.append((found.parameters.numpy(), rows(found.camera)))
    (expected, camera), (parameters, beside) = results
    np.testing.assert_array_equal(beside, camera)
    for name in PARAMETER_NAMES:
        np.testing.assert_array_equal(
            getattr(parameters, name),
            np.concatenate([getattr(expected, name), 0 * getattr(expected, name)[:1]]),
            name,
        )


def check_gradients_of_frames_and_samples_add_up():
    """A frame and its two equal samples per pixel have the gradients of three frames."""
    gaussians, (frame,) = MIXED.frames(MIXED.values)
    weights = [FLOAT64.array(w) for w in np.random.default_rng(1).normal(size=(5, 162))]
    centers = dr.full(FLOAT64.Float, 0.5, 2 * 162)
    model = replace(frame.pipeline.model, positions=SamplePoints(centers, centers, samples=2))
    sampled = rendering.render_again(frame, model)
    twice = [dr.tile(0.375 * w, 2) for w in weights]
    parts = [0.25 * w for w in weights]
    total = rendering.frames_adjoint(gaussians, [frame, sampled], [parts, twice], with_camera=True)
    once = rendering.frames_adjoint(gaussians, [frame], [weights], with_camera=True)
    expected = MIXED.gradients(MIXED.values, np.array(weights))
    for name in PARAMETER_NAMES:
        found = np.array(getattr(total.parameters, name))
        np.testing.assert_allclose(found, expected[name], atol=1e-12 * np.abs(found).max())
    np.testing.assert_allclose(rows(total.camera), rows(once.camera), rtol=1e-9)
    # All places on the film move with the principal point.
    places = rows(once.means2d).sum(axis=0)
    np.testing.assert_allclose(places, rows(once.camera).ravel()[14:16], rtol=1e-9)


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


CHECKS = [value for name, value in globals().items() if name.startswith("check_")]
