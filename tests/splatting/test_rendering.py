"""The whole chain against the float64 reference and gsplat: image, gradients, tangents, bytes."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    NEAR_THRESHOLD,
    Case,
    Cotangents,
    assert_arrays_agree,
    assert_images_agree,
    both_precisions,
    clear,
    device_camera,
    device_gaussians,
    frame_adjoint,
    image_planes,
    kernel_gradients,
    plane_cotangents,
    reference_gradients,
    render,
    rows,
)
from support.rendering_checks import (
    CASES,
    GRADIENTS,
    check_adjoint_is_the_transpose_of_the_tangent,
    check_camera_gradients_of_two_frames_equal_differences_of_the_reference,
    check_camera_tangents_of_two_frames_equal_differences_of_the_reference,
    check_gradients_equal_the_reference,
    check_tangent_equals_central_differences_of_the_reference,
    expected_gradients,
)

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from drgs.splatting.projection import plain_opacity

# Relative to the largest value of each array.
#
# float64: some hundred operations of 1e-16 on each pixel. Measured 6e-15; gradients 6e-14.
#
# float32: a mean at 50 px carries 3 roundings, 1e-5 px. alpha changes by |U d| alpha / sqrt(0.3)
# <= 1.1 per px, so by 1e-5, and a pixel by a few such errors of either sign: measured 4e-6.
# Gradients: the same errors, and those of S / (1 - a), 1e-7 / 0.01 = 1e-5 of the largest term;
# then rows that cancel (a quaternion's gradient is small beside its terms). Measured 1e-5.
IMAGE = {FLOAT64: 1e-12, FLOAT32: 2e-5}


all_cases = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


# ----------------------------------------------------------------------------------------------
# Image
# ----------------------------------------------------------------------------------------------


@both_precisions
@all_cases
def test_image_equals_the_reference(precision, case):
    """No pixel is near a threshold, so none is left out."""
    case = clear(case)
    _, frame = render(case, precision)
    assert not case.rendered.near_threshold.any()
    assert_images_agree(image_planes(frame, case), case.rendered, IMAGE[precision])


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("antialiased", [False, True])
def test_larger_images_differ_only_at_marked_pixels(precision, seed, antialiased):
    """Scenes as they come: a few of the 10,800 pixels are near a threshold, at most one flips."""
    case = Case("large", 120, 90, 1, count=600, antialiased=antialiased, seed=seed)
    assert case.rendered.near_threshold.any()
    _, frame = render(case, precision)
    assert_images_agree(image_planes(frame, case), case.rendered, IMAGE[precision])


def test_stacked_scenes_stop_pixels_and_clamp_alphas():
    for case in map(clear, CASES[-2:]):
        splats = reference.project(case.gaussians, case.camera, case.antialiased)
        colors = reference.sh_colors(case.gaussians, case.camera, case.rendered_degree)
        _, stops = reference._composite_and_stops(
            splats.means2d, splats.conics, splats.opacities, colors, splats.depths,
            splats.visible, case.background, case.width, case.height, NEAR_THRESHOLD,
        )  # fmt: skip
        assert (stops < splats.visible.sum()).sum() >= 100
        y, x = np.mgrid[: case.height, : case.width] + 0.5
        clamped = 0
        for mean, conic, opacity in zip(
            splats.means2d, splats.conics, splats.opacities, strict=True
        ):
            d = np.stack([x, y], axis=-1) - mean
            alpha = opacity * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", d, conic, d))
            clamped += (alpha > reference.ALPHA_MAX).sum()
        assert clamped >= 10


# ----------------------------------------------------------------------------------------------
# Gradients
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@both_precisions
@all_cases
def test_gradients_equal_the_reference(precision, case):
    check_gradients_equal_the_reference(precision, case)


@pytest.mark.parametrize(
    ("field", "first", "end"),
    [("geometry", 0, 2), ("geometry", 2, 5), ("geometry", 5, 6), ("features", 0, 3)],
    ids=["means2d", "conic_factor", "opacities", "features"],
)
@both_precisions
def test_gradient_errors_of_one_percent_are_detected(precision, field, first, end, monkeypatch):
    """A mistake in one output of the hand-written adjoint reaches an array that is compared."""
    case = clear(CASES[0])
    adjoint = rendering.composite_adjoint

    def wrong(*args):
        gradients = adjoint(*args)
        values = getattr(gradients, field)
        scaled = [1.01 * v if first <= k < end else v for k, v in enumerate(values)]
        return replace(gradients, **{field: scaled})

    monkeypatch.setattr(rendering, "composite_adjoint", wrong)
    actual = kernel_gradients(case, precision, Cotangents.random(case))
    with pytest.raises(AssertionError, match="kernels"):
        assert_arrays_agree(actual, expected_gradients(case), GRADIENTS[precision])


@both_precisions
def test_gradients_of_a_larger_image(precision):
    """The cotangent is zero at marked pixels, in both computations."""
    case = Case("large", 120, 90, 1, count=600, seed=1)
    marked = case.rendered.near_threshold
    assert 0 < marked.sum() <= 50
    cotangents = Cotangents.random(case)
    actual = kernel_gradients(case, precision, cotangents)
    assert_arrays_agree(actual, reference_gradients(case, cotangents), GRADIENTS[precision])


@both_precisions
@pytest.mark.parametrize("output", ["d_image", "d_alpha", "d_depth"])
def test_each_output_alone_has_the_right_gradients(precision, output):
    case = clear(CASES[1])
    zeros = {name: np.zeros_like(v) for name, v in vars(Cotangents.random(case)).items()}
    cotangents = Cotangents(**{**zeros, output: getattr(Cotangents.random(case), output)})
    actual = kernel_gradients(case, precision, cotangents)
    expected = reference_gradients(case, cotangents)
    assert_arrays_agree(actual, expected, GRADIENTS[precision])


@both_precisions
@pytest.mark.parametrize(
    "features",
    [
        (rendering.color_features,),
        (rendering.depth_feature,),
        (rendering.depth_feature, rendering.color_features, rendering.depth_feature),
    ],
    ids=["color", "depth", "depth color depth"],
)
def test_features_are_composited_in_the_given_order(precision, features):
    case = clear(CASES[0])
    pipeline = rendering.Pipeline(3, plain_opacity, features)
    gaussians, frame = render(case, precision, pipeline)
    cotangents = Cotangents.random(case)
    rendered = {
        rendering.color_features: list(
            np.moveaxis(case.rendered.image, -1, 0)
            - case.background[:, None, None] * case.rendered.transmittance
        ),
        rendering.depth_feature: [case.rendered.depth],
    }
    weights = {
        rendering.color_features: list(np.moveaxis(cotangents.d_image, -1, 0)),
        rendering.depth_feature: [cotangents.d_depth],
    }
    expected = [case.rendered.transmittance] + [p for f in features for p in rendered[f]]
    actual = [rows(plane).reshape(case.height, case.width) for plane in frame.planes()]
    assert len(actual) == len(expected)
    assert_arrays_agree(dict(enumerate(actual)), dict(enumerate(expected)), IMAGE[precision])

    gradients = frame_adjoint(
        gaussians,
        frame,
        [precision.array(w) for feature in features for w in weights[feature]],
        precision.array(cotangents.d_alpha),
    )
    d_color = cotangents.d_image * (rendering.color_features in features)
    d_depth = cotangents.d_depth * features.count(rendering.depth_feature)
    reference_values = reference.render_gradients(
        *case.scene, np.zeros(3), d_color, -cotangents.d_alpha, d_depth
    )
    actual = {name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES}
    expected = {name: reference_values[name] for name in PARAMETER_NAMES}
    assert_arrays_agree(actual, expected, GRADIENTS[precision])


@both_precisions
def test_attached_parameters_are_detached(precision):
    """``mi.render`` does the same: gradients are suspended while attached parameters are given."""
    case = clear(CASES[0])
    gaussians = device_gaussians(case.gaussians, precision)
    dr.enable_grad(gaussians)
    with dr.suspend_grad():
        camera = device_camera(case.camera, precision)
        frame = rendering.render(gaussians, camera, case.pipeline)
        cotangents = plane_cotangents(case, Cotangents.random(case), precision)
        gradients = frame_adjoint(gaussians, frame, *cotangents)
    assert_arrays_agree(
        {name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
        {name: expected_gradients(case)[name] for name in PARAMETER_NAMES},
        GRADIENTS[precision],
    )
    assert not any(np.array(dr.grad(getattr(gaussians, name))).any() for name in PARAMETER_NAMES)


@both_precisions
def test_splats_overlapping_the_film_are_visible(precision):
    case = clear(CASES[0])
    gaussians, frame = render(case, precision)
    gradients = frame_adjoint(
        gaussians, frame, *plane_cotangents(case, Cotangents.random(case), precision)
    )
    visible = np.array(gradients.visible)
    assert 0 < visible.sum() < len(visible)
    in_front = reference.project(*case.scene).visible
    assert not (visible & ~in_front).any() and (in_front & ~visible).any()
    touched = expected_gradients(case)["means2d"].any(axis=1)
    assert visible[touched].all()
    assert not rows(gradients.means2d)[~visible].any()


@both_precisions
def test_image_without_visible_splats_is_background(precision):
    case = Case("hidden", 20, 13, 1, count=5)
    hidden = replace(case.gaussians, logit_opacities=np.full(5, -8.0))
    gaussians = device_gaussians(hidden, precision)
    frame = rendering.render(gaussians, device_camera(case.camera, precision), case.pipeline)
    rendered = image_planes(frame, case)
    np.testing.assert_array_equal(rendered["image"], np.broadcast_to(case.background, (13, 20, 3)))
    assert not rendered["depth"].any() and not rendered["alpha"].any()
    gradients = frame_adjoint(
        gaussians, frame, *plane_cotangents(case, Cotangents.random(case), precision)
    )
    for name in PARAMETER_NAMES:
        values = np.array(getattr(gradients.parameters, name))
        assert values.shape == getattr(hidden, name).shape and not values.any(), name
    assert not np.array(gradients.visible).any()


@both_precisions
@pytest.mark.parametrize("logit", [-np.inf, -900.0, -120.0])
def test_an_opacity_that_underflows_to_zero_has_no_gradient(precision, logit):
    case = clear(CASES[0])
    logits = case.gaussians.logit_opacities.copy()
    row = int(np.argmax(np.abs(expected_gradients(case)["logit_opacities"])))
    logits[row] = logit
    gaussians = device_gaussians(replace(case.gaussians, logit_opacities=logits), precision)
    frame = rendering.render(gaussians, device_camera(case.camera, precision), case.pipeline)
    cotangents = plane_cotangents(case, Cotangents.random(case), precision)
    gradients = frame_adjoint(gaussians, frame, *cotangents)
    for name in PARAMETER_NAMES:
        values = np.array(getattr(gradients.parameters, name))
        assert np.isfinite(values).all() and not values[row].any(), name


# ----------------------------------------------------------------------------------------------
# Tangents
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@both_precisions
@all_cases
def test_adjoint_is_the_transpose_of_the_tangent(precision, case):
    check_adjoint_is_the_transpose_of_the_tangent(precision, case)


@both_precisions
@all_cases
def test_tangent_equals_central_differences_of_the_reference(precision, case):
    check_tangent_equals_central_differences_of_the_reference(precision, case)


# ----------------------------------------------------------------------------------------------
# Several frames of a camera that is differentiated, too
# ----------------------------------------------------------------------------------------------


CAMERA_CASES = [
    Case("of the camera", 37, 29, 1),
    Case("of the camera, antialiased", 33, 17, 0, antialiased=True),
]


@pytest.mark.slow
@pytest.mark.parametrize("case", CAMERA_CASES, ids=lambda case: case.name)
def test_camera_gradients_of_two_frames_equal_differences_of_the_reference(case):
    check_camera_gradients_of_two_frames_equal_differences_of_the_reference(case)


@pytest.mark.parametrize("case", CAMERA_CASES, ids=lambda case: case.name)
def test_camera_tangents_of_two_frames_equal_differences_of_the_reference(case):
    check_camera_tangents_of_two_frames_equal_differences_of_the_reference(case)


# ----------------------------------------------------------------------------------------------
# Sums of weights
# ----------------------------------------------------------------------------------------------


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
        rendered = reference.composite(
            splats.means2d, splats.conics, splats.opacities, np.repeat(white[:, None], 3, axis=1),
            splats.depths, splats.visible, np.zeros(3), case.width, case.height,
            cuts=splats.cuts,
        )  # fmt: skip
        expected.append(np.sum(rendered.image[..., 0] * plane))
    approximations = Approximations(sh_direction=sh_direction)
    pipeline = pipeline_of(approximations, case.rendered_degree)
    _, frame = render(case, precision, pipeline)
    got = np.array(rendering.weighted_sums(frame, precision.array(plane)), np.float64)
    assert np.max(expected) > 1
    np.testing.assert_allclose(got, expected, atol=IMAGE[precision] * np.max(expected))
