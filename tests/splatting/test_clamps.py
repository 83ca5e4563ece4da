"""Effect of each limit of the image model on the gradient: decided in ``constants.py``.

One splat (or a few), float64 and float32. Gradients beyond a limit are exactly zero; on its other
side, and on both sides of the slope's clamp, they are the slopes of the float64 reference.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    Cotangents,
    both_precisions,
    image_planes,
    kernel_gradients,
    render,
    single,
)

from drgs.core import constants
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference

CAMERA = reference.Camera(
    rotation=np.eye(3), center=np.zeros(3), fx=20.0, fy=20.0, cx=8.5, cy=6.5, width=17, height=13,
    near=0.25,
)  # fmt: skip

TOLERANCE = {FLOAT64: 1e-7, FLOAT32: 2e-5}
"""Relative: central differences of 1e-6 in float64; some hundred roundings in float32."""

CENTER = (8, 6)
"""The pixel whose centre is the splat's mean."""


def splat(**changes) -> reference.Gaussians:
    """One splat at the centre of the film, 3 px wide, white, of opacity 0.5."""
    fields = {
        "means": [[0.0, 0.0, 2.0]],
        "quats": [[1.0, 0.1, 0.2, 0.3]],
        "log_scales": np.log([[0.3, 0.25, 0.2]]),
        "logit_opacities": [0.0],
        "sh0": np.full((1, 1, 3), 0.5 / reference.C_00),
        "shN": np.zeros((1, 0, 3)),
    }
    fields |= changes
    return reference.Gaussians(**{name: single(value) for name, value in fields.items()})


def of_opacity(opacity) -> reference.Gaussians:
    return splat(logit_opacities=[np.log(opacity / (1 - opacity))])


def of_color(color) -> reference.Gaussians:
    return splat(sh0=np.full((1, 1, 3), (color - 0.5) / reference.C_00))


def of_size(*sizes) -> reference.Gaussians:
    return splat(log_scales=np.log([sizes]))


def at_depth(z) -> reference.Gaussians:
    gaussians = of_size(0.02, 0.02, 0.02)
    gaussians.means[0, 2] = z
    return gaussians


def layers(*logits) -> reference.Gaussians:
    depths = np.linspace(1, 2, len(logits))
    parts = [
        splat(means=[[0.0, 0.0, z]], logit_opacities=[logit])
        for z, logit in zip(depths, logits, strict=True)
    ]
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return reference.Gaussians(*map(np.concatenate, columns))


def case_of(gaussians) -> Case:
    # The reference's background is behind every image: the loss sees transmittance too.
    return Case("clamp", 17, 13, 0, recipe=lambda *_: (gaussians, CAMERA))


def at_pixel(x, y) -> Cotangents:
    """The loss is the sum of the colours of one pixel, and its depth."""
    image, alpha, depth = np.zeros((13, 17, 3)), np.zeros((13, 17)), np.zeros((13, 17))
    image[y, x], depth[y, x] = [1.0, 0.5, 0.25], 0.125
    return Cotangents(image, alpha, depth)


def gradients_of(gaussians, precision, pixel=CENTER) -> dict[str, np.ndarray]:
    return kernel_gradients(case_of(gaussians), precision, at_pixel(*pixel))


def slope(gaussians, pixel, name, index, step=1e-6) -> float:
    """Central difference of the loss by the reference with respect to one number."""
    cotangents, background = at_pixel(*pixel), case_of(gaussians).background

    def loss(sign):
        values = getattr(gaussians, name).copy()
        values[index] += sign * step
        rendered = reference.render(replace(gaussians, **{name: values}), CAMERA, background)
        image = np.sum(cotangents.d_image * rendered.image)
        return image + np.sum(cotangents.d_depth * rendered.depth)

    return (loss(1) - loss(-1)) / (2 * step)


LOGIT, RED, DEPTH, SIZE = (
    ("logit_opacities", 0), ("sh0", (0, 0, 0)), ("means", (0, 2)), ("log_scales", (0, 0))
)  # fmt: skip
ALL = PARAMETER_NAMES[:5]
NEAREST = np.nextafter(np.float32(0.25), np.float32(0))

LIMITS = {
    "alpha just below its clamp": (of_opacity(0.985), (), [LOGIT, RED]),
    "alpha clamped": (of_opacity(0.9975), ("logit_opacities", "log_scales", "quats"), [RED, DEPTH]),
    "alpha above its cut": (of_opacity(1.01 * constants.ALPHA_CUT), (), [LOGIT, RED]),
    "alpha below its cut": (of_opacity(0.99 * constants.ALPHA_CUT), ALL, []),
    "a colour above 0": (of_color(0.01), (), [LOGIT, RED]),
    "a negative colour": (of_color(-0.01), ("sh0",), [LOGIT]),
    "at the near plane": (at_depth(0.25), (), [RED]),
    "nearer than the near plane": (at_depth(NEAREST), ALL, []),
    "two layers above the stop": (layers(1, 8, 0), (), [("sh0", (2, 0, 0)), ("means", (2, 2))]),
}
"""A scene, parameters whose gradients are zero, and numbers whose gradients are slopes."""


@both_precisions
@pytest.mark.parametrize("name", LIMITS)
def test_gradients_beyond_a_limit_are_zero(precision, name):
    gaussians, without, numbers = LIMITS[name]
    gradients = gradients_of(gaussians, precision)
    assert [name for name in without if gradients[name].any()] == []
    assert_slopes(gaussians, gradients, precision, CENTER, numbers)


def assert_slopes(gaussians, gradients, precision, pixel, numbers):
    for name, index in numbers:
        expected = slope(gaussians, pixel, name, index)
        assert abs(expected) > 1e-4, name
        error = abs(gradients[name][index] - expected)
        assert error <= TOLERANCE[precision] * max(1.0, abs(expected)), name


@both_precisions
def test_splats_behind_the_stop_have_no_gradient(precision):
    """Two clamped splats leave just less than the stop: the second and all behind have none."""
    gradients = gradients_of(layers(8, 8, 0), precision)
    for name in ("sh0", "means"):
        assert gradients[name][0].any() and not gradients[name][1:].any()


@both_precisions
@pytest.mark.parametrize("factor", [0.98, 1.02, -0.98, -1.02])
def test_a_clamped_slope_is_a_constant_in_the_covariance_only(precision, factor):
    """On either side of the clamp all slopes are those of the reference: beyond it the covariance
    depends on z but not on x, while the position on the film depends on both."""
    slope_x = factor * (1 + constants.TAN_CLAMP) * (CAMERA.width / 2) / CAMERA.fx
    z, size = 2.0, 2 * (abs(slope_x) - 0.3)  # reaches the film
    sizes = np.log([[size, 0.5 * size, 0.7 * size]])
    gaussians = splat(means=[[slope_x * z, 0.1, z]], log_scales=sizes)
    pixel = 16 if factor > 0 else 0, 6
    gradients = gradients_of(gaussians, precision, pixel)
    assert_slopes(gaussians, gradients, precision, pixel, [("means", (0, 0)), DEPTH, SIZE])


@both_precisions
def test_a_colour_of_zero_keeps_its_gradient(precision):
    """The weight of the pixel, opacity 0.5, times the basis function."""
    basis = float(precision.dtype(reference.C_00))  # the sum is exactly 0 in both precisions
    gaussians = splat()
    gaussians.sh0[:] = -0.5 / basis
    expected = 0.5 * reference.C_00 * np.array([1.0, 0.5, 0.25])
    np.testing.assert_allclose(gradients_of(gaussians, precision)["sh0"][0, 0], expected, rtol=1e-6)


@both_precisions
def test_exponents_far_below_underflow_are_zero_not_garbage(precision):
    """A needle along x: a few pixels off it the exponent is below -1000, where exp2 underflows."""
    gaussians = splat(log_scales=np.log([[2.0, 1e-4, 1e-4]]), quats=[[1.0, 0, 0, 0]])
    case = case_of(gaussians)
    rendered = image_planes(render(case, precision)[1], case)
    rows_of_the_needle = np.abs(np.arange(13) + 0.5 - CAMERA.cy) < 3
    assert (rendered["alpha"][rows_of_the_needle] > 0).any()
    assert (rendered["transmittance"][~rows_of_the_needle] == 1).all()
    assert not gradients_of(gaussians, precision, (8, 0))["means"].any()


@both_precisions
def test_subpixel_splat_has_position_gradients_but_no_scale_gradients(precision):
    """The low-pass is added, not clamped: the gradient of the size fades with the size squared."""

    def gradients(size):
        return gradients_of(of_size(size, size, size), precision, (9, 6))

    slopes = [np.abs(gradients(size)["log_scales"]).sum() for size in (0.02, 0.01, 0.005)]
    assert slopes[0] / slopes[1] == pytest.approx(4, rel=0.3)
    assert slopes[1] / slopes[2] == pytest.approx(4, rel=0.1)
    assert gradients(1e-8)["means"].any()
