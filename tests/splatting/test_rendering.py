"""Features, gradients and weights of whole images."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    Cotangents,
    assert_arrays_agree,
    both_precisions,
    clear,
    device_camera,
    device_gaussians,
    frame_adjoint,
    plane_cotangents,
    reference_gradients,
    render,
)

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import rendering

# Relative to the largest value of each array.
#
# float64: some hundred operations of 1e-16 on each pixel. Measured 6e-15; gradients 6e-14.
#
# float32: a mean at 50 px carries 3 roundings, 1e-5 px. alpha changes by |U d| alpha / sqrt(0.3)
# <= 1.1 per px, so by 1e-5, and a pixel by a few such errors of either sign: measured 4e-6.
# Gradients: the same errors, and those of S / (1 - a), 1e-7 / 0.01 = 1e-5 of the largest term;
# then rows that cancel (a quaternion's gradient is small beside its terms). Measured 1e-5.
IMAGE = {FLOAT64: 1e-12, FLOAT32: 2e-5}
GRADIENTS = {FLOAT64: 1e-12, FLOAT32: 5e-5}

CASE = Case("degree 3", 37, 29, 3)


@both_precisions
@pytest.mark.parametrize(
    ("features", "order"),
    [
        ((rendering.color_features,), "center"),
        ((rendering.depth_feature,), "center"),
        (
            (rendering.depth_feature, rendering.color_features, rendering.depth_feature),
            "center",
        ),
        *(((), order) for order in ("center", "pixel")),  # what an alpha mask needs
    ],
    ids=["color", "depth", "depth color depth", "nothing", "nothing, pixel order"],
)
def test_features_are_composited_in_the_given_order(precision, features, order):
    """Planes and gradients are those of colour and depth, whose law the matrix checks."""
    usual = pipeline_of(Approximations(order=order), 3, CASE.pipeline.features)
    gaussians, frame = render(CASE, precision, replace(usual, features=features))
    _, usual = render(CASE, precision, usual)
    channels = [
        channel
        for feature in features
        for channel in ([3] if feature is rendering.depth_feature else [0, 1, 2])
    ]
    transmittance, *planes = usual.planes()
    expected = [transmittance, *(planes[channel] for channel in channels)]
    for actual, plane in zip(frame.planes(), expected, strict=True):
        assert dr.all(actual == plane)

    rng = np.random.default_rng(1)
    d_transmittance, *weights = (
        precision.array(w) for w in rng.normal(size=(1 + len(channels), 37 * 29))
    )
    summed = [dr.zeros(precision.Float, 37 * 29)] * 4
    for channel, weight in zip(channels, weights, strict=True):
        summed[channel] = summed[channel] + weight
    actual, wanted = (
        frame_adjoint(gaussians, each, d_features, d_transmittance).parameters
        for each, d_features in ((frame, weights), (usual, summed))
    )
    assert_arrays_agree(
        {name: np.array(getattr(actual, name)) for name in PARAMETER_NAMES},
        {name: np.array(getattr(wanted, name)) for name in PARAMETER_NAMES},
        GRADIENTS[precision] if features else 0,
    )


@both_precisions
def test_attached_parameters_are_detached(precision):
    """``mi.render`` does the same: gradients are suspended while attached parameters are given."""
    case = clear(CASE)
    gaussians = device_gaussians(case.gaussians, precision)
    dr.enable_grad(gaussians)
    with dr.suspend_grad():
        camera = device_camera(case.camera, precision)
        frame = rendering.render(gaussians, camera, case.pipeline)
        cotangents = plane_cotangents(case, Cotangents.random(case), precision)
        gradients = frame_adjoint(gaussians, frame, *cotangents)
    expected = reference_gradients(case, Cotangents.random(case))
    assert_arrays_agree(
        {name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
        {name: expected[name] for name in PARAMETER_NAMES},
        GRADIENTS[precision],
    )
    assert not any(np.array(dr.grad(getattr(gaussians, name))).any() for name in PARAMETER_NAMES)


@pytest.mark.parametrize("sh_direction", ["mean", "pixel"])
@both_precisions
def test_weighted_sums_are_image_contributions_times_the_plane(precision, sh_direction):
    """The reference composites each Gaussian alone in white, among the others in black.

    Whatever its colour is: two are black, as far as negative colours are.
    """
    case = clear(Case("weights", 23, 19, 1, count=12))
    case.gaussians.sh0[:2] = -3
    splats = reference.project(case.gaussians, case.camera)
    plane = np.random.default_rng(3).uniform(0, 1, (case.height, case.width))
    expected = []
    for white in np.eye(12):
        colors = np.repeat(white[:, None], 3, axis=1)
        rendered = reference.composite(splats, colors, np.zeros(3), case.width, case.height)
        expected.append(np.sum(rendered.image[..., 0] * plane))
    approximations = Approximations(sh_direction=sh_direction)
    pipeline = pipeline_of(approximations, case.rendered_degree)
    _, frame = render(case, precision, pipeline)
    got = np.array(rendering.weighted_sums(frame, precision.array(plane))[0], np.float64)
    assert np.max(expected) > 1
    np.testing.assert_allclose(got, expected, atol=IMAGE[precision] * np.max(expected))
