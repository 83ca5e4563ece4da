"""Windows, faint splats, kernels and messages of approximations, beyond the laws of images."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.cases import APPROXIMATIONS, CASES
from support.helpers import (
    FLOAT32,
    FLOAT64,
    device_camera,
    device_gaussians,
    frame_adjoint,
    rows,
    single,
)
from support.kernels import float_reductions
from support.reference_lenses import gaussians_at
from support.studies import reference_rays

from drgs.accuracy import pixel_order
from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.reference import splatting as reference
from drgs.splatting import rendering

NAMED = {case.name: case for case in CASES}


@pytest.mark.slow
def test_order_converges_with_the_window():
    """A layer of discs tilted every way: their order differs from pixel to pixel."""
    case, errors = NAMED["exact, pixel order, close"], []
    expected, marked = case.reference_image
    for window in (1, 2, 4, 8):
        chosen = replace(case, approximations={**case.approximations, "order_window": window})
        difference = chosen.planes(case.values)[:4] - expected
        errors.append(np.sqrt(np.mean(difference[:, ~marked] ** 2)))
    assert errors[0] > 1e-3 and errors[-1] < 1e-13
    assert all(after <= before + 1e-12 for before, after in pairwise(errors))


def on_axis(logits, sizes) -> reference.Gaussians:
    """Round splats behind each other, sizes relative to their depths."""
    z = np.linspace(2, 4, len(logits))
    found = gaussians_at(single(np.column_stack([0 * z, 0 * z, z])), sizes * z[:, None])
    sh0 = single(np.random.default_rng(0).normal(size=(len(z), 1, 3)))
    scales = single(found.log_scales)
    return replace(found, log_scales=scales, logit_opacities=single(logits), sh0=sh0)


CAMERA = reference.Camera(np.eye(3), np.zeros(3), 20.0, 20.0, 8.0, 8.0, 16, 16)


def test_unordered_faint_splats_change_the_image_within_bounds():
    """A splat before 200 that are fainter than what is put in order: it loses at most their sum of
    its light, and they gain at most as much.
    """
    faint, count = 0.9 * pixel_order.UNORDERED_ALPHA, 201
    alphas = np.full(count, faint)
    alphas[0] = 0.5
    gaussians = on_axis(np.log(alphas / (1 - alphas)), 0.5)
    approximations = {"order": "pixel", "alpha_cut": 0.0, "transmittance_stop": 0.0}
    expected = reference_rays.render(
        gaussians, CAMERA, model=reference_rays.ImageModel(**approximations)
    )
    device = device_gaussians(gaussians, FLOAT64)
    pipeline = pipeline_of(Approximations(**approximations, order_window=4), 0)
    frame = rendering.render(device, device_camera(CAMERA, FLOAT64), pipeline)
    color = np.stack([rows(plane) for plane in frame.planes()[1:]], axis=-1)
    error = np.abs(color - expected.image.reshape(-1, 3))
    brightest = np.maximum(gaussians.sh0 * reference.C_00 + 0.5, 0).max()
    assert error.max() <= brightest * alphas[0] * alphas[1:].sum()
    T = rows(frame.planes()[0])
    np.testing.assert_allclose(T, expected.transmittance.ravel(), rtol=0, atol=1e-12)


def test_without_transmittance_stop_gradients_exist_behind_opaque_layers():
    """Transmittance is 1e-60 there, which float32 has not: it ends before."""
    gaussians, results = on_axis(np.full(30, 12.0), 1.0), []
    for precision in (FLOAT64, FLOAT32):
        device = device_gaussians(gaussians, precision)
        pipeline = pipeline_of(Approximations(transmittance_stop=0.0), 0)
        frame = rendering.render(device, device_camera(CAMERA, precision), pipeline)
        ones = precision.array(np.ones(256))
        gradients = frame_adjoint(device, frame, [ones] * 3, 0 * ones).parameters
        results.append([np.array(gradients.sh0), np.array(gradients.logit_opacities)])
    for single_precision, correct in zip(results[1], results[0], strict=True):
        tolerance = 5e-5 * np.abs(correct).max()
        np.testing.assert_allclose(single_precision, correct, rtol=0, atol=tolerance)


# ----------------------------------------------------------------------------------------------
# Approximations
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"projection": "affine"},
            "projection must be one of ewa, exact, unscented \\(others come with",
        ),
        ({"order": "entry"}, "order must be one of center, pixel \\(others come with"),
        ({"order_window": 0}, "order_window must be from 1 to 64, got 0"),
        ({"sh_direction": "ray"}, "sh_direction must be one of mean, pixel, got 'ray'"),
        ({"alpha_max": 1.0}, "alpha_max must be above 0 and below 1 in float32, got 1.0"),
        ({"alpha_max": 1 - 1e-9}, "alpha_max must be above 0 and below 1 in float32, got 0.99999"),
        ({"alpha_cut": -0.1}, "alpha_cut must be from 0 to below 1, got -0.1"),
        ({"transmittance_stop": math.nan}, "transmittance_stop must be from 0 to below 1, got nan"),
        ({"extent": 0.0}, "extent must be above 0, and at most 1e9 or infinite, got 0.0"),
        ({"low_pass": math.inf}, "low_pass must be finite and not negative, got inf"),
    ],
)
def test_invalid_approximations_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Approximations(**values)


def test_equal_approximations_make_equal_pipelines():
    """The plugin reuses a frame whose pipeline is the same."""
    for values in ({}, *APPROXIMATIONS.values()):
        assert pipeline_of(Approximations(**values), 2) == pipeline_of(Approximations(**values), 2)
        assert values == {} or pipeline_of(Approximations(**values), 2) != pipeline_of(
            Approximations(), 2
        )


def test_no_kernel_of_an_approximation_reduces_floats_in_memory():
    case = NAMED["all three, close"]
    weights = np.ones((5, case.width * case.height))
    for function in (
        lambda: case.planes(case.values, FLOAT32.Float),
        lambda: case.gradients(case.values, weights, FLOAT32.Float),
    ):
        found, count = float_reductions(function)
        assert not found and count > 3
