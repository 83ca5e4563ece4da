"""Lenses against the float64 reference: what they see, images, gradients; and by themselves."""

import numpy as np
import pytest
from support.derivative_checks import check_against_differences, check_transpose
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Cotangents,
    assert_arrays_agree,
    assert_images_agree,
    both_precisions,
    clear,
    image_planes,
)
from support.lens_checks import (
    FORMS,
    IMAGE,
    case_of,
    every_lens,
    keep_bounds,
    kernel_gradients,
    tiny_scene,
)
from support.lens_scenes import (
    LENSES,
    LensCase,
    camera_behind,
    gaussians_at_points,
    points_at,
    points_near_lens_limit,
)
from support.reference_scenes import numeric_gradients

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import effects
from drgs.reference import splatting as reference

every_form = pytest.mark.parametrize("name", FORMS)


antialiased_too = pytest.mark.parametrize(
    ("name", "antialiased"),
    [(name, False) for name in LENSES] + [(name, True) for name in ("rational", "fisheye")],
)


# ----------------------------------------------------------------------------------------------
# Images
# ----------------------------------------------------------------------------------------------


def large_scene(case, rng):
    """Splats as large as the film, most with their means beside it."""
    camera = camera_behind(case, rng)
    size = np.array([case.width, case.height])
    film = rng.uniform(-0.4, 1.4, (case.count, 2)) * size
    distances = rng.uniform(1, 3, case.count)
    points = points_at(case.lens, camera, film, distances)
    near_the_end = points_near_lens_limit(case.lens, camera, film, distances)
    points = np.where(np.isnan(points), near_the_end, points)
    sizes = rng.uniform(0.1, 0.8, (case.count, 3)) * max(size)
    logits = rng.normal(-1.0, 1.0, case.count)
    return gaussians_at_points(case, rng, camera, points, sizes, logits), camera


@both_precisions
@antialiased_too
def test_image_equals_the_reference(precision, name, antialiased):
    case = clear(case_of(name, antialiased=antialiased))
    _, frame = case.render(precision)
    assert_images_agree(image_planes(frame, case), case.rendered, IMAGE[precision])


@both_precisions
@every_lens
def test_tiles_contain_every_pixel_of_large_splats(precision, name):
    """The reference evaluates every splat at every pixel."""
    case = clear(case_of(name, recipe=large_scene, count=20))
    _, frame = case.render(precision)
    assert_images_agree(image_planes(frame, case), case.rendered, IMAGE[precision])
    splats = effects.project(*case.scene, case.lens)
    x, y = splats.means2d[splats.visible].T
    beside = (x < 0) | (y < 0) | (x > case.width) | (y > case.height)
    assert beside.sum() >= 5 and (case.rendered.alpha > 0.5).mean() > 0.3


@every_lens
def test_a_lens_changes_the_image(name):
    """Otherwise the tests above would compare a pinhole with itself."""
    case = clear(case_of(name))
    plain = reference.render(*case.scene, case.background)
    assert np.abs(plain.image - case.rendered.image).max() > 0.01


# ----------------------------------------------------------------------------------------------
# Derivatives
# ----------------------------------------------------------------------------------------------


# Central differences with a step of 1e-6: the reference's J carries noise of 1e-13, so that a
# quotient is off by 1e-7 of its largest terms; curvature adds less. Measured: 4e-8.
DIFFERENCES = 1e-6


# Tolerances of test_rendering.
GRADIENTS = {FLOAT64: 1e-12, FLOAT32: 5e-5}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rational", "fisheye", "orthographic"])
def test_each_gradient_entry_equals_a_difference_of_the_reference(name, monkeypatch):
    """One splat is on the axis, one so far beside the film that its slopes may be clamped."""
    lens = LENSES[name]
    case = clear(LensCase("tiny", 13, 11, 1, 5, lens=lens, recipe=tiny_scene, threshold_width=5e-4))
    cotangents = Cotangents.random(case)
    keep_bounds(case, monkeypatch)
    weights = [cotangents.d_image, cotangents.d_alpha, cotangents.d_depth]

    def outputs(**parameters):
        rendered = case.reference_image(reference.Gaussians(**parameters))
        return [rendered.image, rendered.alpha, rendered.depth]

    parameters = {n: getattr(case.gaussians, n) for n in PARAMETER_NAMES}
    expected = numeric_gradients(outputs, weights, parameters)
    actual = kernel_gradients(case, FLOAT64, cotangents)
    assert_arrays_agree(actual, expected, DIFFERENCES)
    # The comparison notices one percent, in every array.
    for parameter, values in actual.items():
        with pytest.raises(AssertionError, match=rf"{parameter}\["):
            assert_arrays_agree({**actual, parameter: 1.01 * values}, expected, DIFFERENCES)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "antialiased"),
    [(name, False) for name in (*FORMS, "plain fisheye")] + [("rational", True), ("fisheye", True)],
)
def test_gradients_equal_differences_of_the_reference_along_a_direction(
    name, antialiased, monkeypatch
):
    """One direction for each parameter; larger scenes leave out pixels that a step may take to a
    jump."""
    case = clear(case_of(name, antialiased=antialiased, threshold_width=1e-3))
    keep_bounds(case, monkeypatch)
    check_against_differences(case, kernel_gradients, DIFFERENCES)


@both_precisions
@every_form
def test_adjoint_is_the_transpose_of_the_tangent(precision, name):
    case = clear(case_of(name))
    gaussians, frame = case.render(precision)

    check_transpose(case, precision, gaussians, [frame], kernel_gradients, GRADIENTS[precision] / 5)


@every_form
def test_single_precision_gradients_equal_double_precision(name):
    case = clear(case_of(name))
    cotangents = Cotangents.random(case)
    expected = kernel_gradients(case, FLOAT64, cotangents)
    assert_arrays_agree(kernel_gradients(case, FLOAT32, cotangents), expected, GRADIENTS[FLOAT32])
