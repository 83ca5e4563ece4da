"""Ordinary scenes in single precision, and rows that are not finite."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    Case,
    Cotangents,
    assert_images_agree,
    bitwise,
    both_precisions,
    clear,
    device_camera,
    device_gaussians,
    frame_adjoint,
    image_planes,
    kernel_gradients,
    plane_cotangents,
    reference_gaussians,
    reference_gradients,
    render,
)

from drgs.bench.scenes import bench_camera, bench_gaussians
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import rendering

# ----------------------------------------------------------------------------------------------
# Ordinary scenes
# ----------------------------------------------------------------------------------------------


def bench_scene(seed, width, height, degree, count):
    return reference_gaussians(bench_gaussians(count, seed)), bench_camera(width)


ORDINARY = [
    Case("bench scene", 400, 400, 3, count=10_000, recipe=bench_scene),
    Case("splats of all sizes, antialiased", 200, 150, 1, count=10_000, antialiased=True),
]


@pytest.mark.slow
@pytest.mark.parametrize("case", ORDINARY, ids=lambda case: case.name)
def test_ten_thousand_gaussians_match_the_reference_in_float32(case):
    """Images within 2e-5 of the reference, gradients within 1e-4, cosines above 0.99999.

    A mean at 400 px carries 3 roundings of 2.4e-5 px or less, of either sign, and alpha changes by
    at most 1.1 per px: some 1e-5 in a pixel that a dozen splats share. Measured 1.9e-5 and 1.9e-5.
    Pixels near a threshold may flip, at most 1e-4 of them.
    """
    cotangents = Cotangents.random(case)
    rendered = image_planes(render(case, FLOAT32)[1], case)
    assert_images_agree(rendered, case.rendered, 2e-5)
    actual = kernel_gradients(case, FLOAT32, cotangents)
    for name, wanted in reference_gradients(case, cotangents).items():
        error = np.abs(actual[name] - wanted).max()
        assert error <= 1e-4 * np.abs(wanted).max(), name
        # A background's three numbers, say: a product of norms in float64 throughout.
        found = actual[name].astype(np.float64)
        cosine = np.sum(found * wanted) / np.linalg.norm(found) / np.linalg.norm(wanted)
        assert cosine > 0.99999, name


# ----------------------------------------------------------------------------------------------
# Rows that are not finite
# ----------------------------------------------------------------------------------------------


NOT_FINITE = Case("not finite", 21, 18, 1, count=30)

MEANINGFUL_INFINITIES = {
    ("log_scales", -np.inf): "a scale of 0: a point, which the low-pass makes a pixel wide",
    ("logit_opacities", np.inf): "an opacity of 1",
    ("sh0", -np.inf): "a colour of 0",
    ("shN", -np.inf): "a colour of 0, or of infinity, which is dropped",
    ("shN", np.inf): "the same, by the sign of the basis",
}


def planes_and_gradients(gaussians, case, precision):
    device = device_gaussians(gaussians, precision)
    frame = rendering.render(device, device_camera(case.camera, precision), case.pipeline)
    gradients = frame_adjoint(
        device, frame, *plane_cotangents(case, Cotangents.random(case), precision)
    )
    planes = [np.array(plane) for plane in frame.planes()]
    return planes, vars(reference_gaussians(gradients.parameters))


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", PARAMETER_NAMES)
def test_nonfinite_value_affects_no_other_row(precision, antialiased, value, name):
    """The row is dropped: the image and all other gradients are, bit by bit, those without it."""
    case = clear(replace(NOT_FINITE, antialiased=antialiased))
    row = most_important_row(case)
    spoiled = {key: getattr(case.gaussians, key).copy() for key in PARAMETER_NAMES}
    spoiled[name].reshape(len(spoiled[name]), -1)[row, 0] = value
    planes, gradients = planes_and_gradients(reference.Gaussians(**spoiled), case, precision)
    assert all(np.isfinite(plane).all() for plane in planes)
    assert all(np.isfinite(gradient).all() for gradient in gradients.values())
    if (name, value) in MEANINGFUL_INFINITIES:
        return
    without = {key: np.delete(array, row, 0) for key, array in vars(case.gaussians).items()}
    expected_planes, expected_gradients = planes_and_gradients(
        reference.Gaussians(**without), case, precision
    )
    assert bitwise(planes) == bitwise(expected_planes)
    for key, gradient in gradients.items():
        assert not gradient[row].any(), key
        np.testing.assert_array_equal(np.delete(gradient, row, 0), expected_gradients[key], key)


@cache
def most_important_row(case) -> int:
    gradients = reference_gradients(case, Cotangents.random(case))
    return int(np.argmax(np.abs(gradients["logit_opacities"])))


@both_precisions
@pytest.mark.parametrize(
    ("name", "value"), [("log_scales", -np.inf), ("logit_opacities", np.inf), ("sh0", -np.inf)]
)
def test_meaningful_infinities_are_rendered_as_limits(precision, name, value):
    """The limit of large numbers: the image is that of -1e4 (or 1e4), to the last bit."""
    case = clear(NOT_FINITE)
    row = most_important_row(case)
    images = []
    for number in (value, np.sign(value) * 1e4):
        fields = {key: getattr(case.gaussians, key).copy() for key in PARAMETER_NAMES}
        fields[name].reshape(len(fields[name]), -1)[row, :] = number
        images.append(planes_and_gradients(reference.Gaussians(**fields), case, precision)[0])
    assert bitwise(images[0]) == bitwise(images[1])
    without = {key: np.delete(array, row, 0) for key, array in vars(case.gaussians).items()}
    dropped = planes_and_gradients(reference.Gaussians(**without), case, precision)[0]
    assert bitwise(images[0]) != bitwise(dropped)
