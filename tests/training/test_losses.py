"""The photometric loss against float64 scipy, and its adjoint against finite differences."""

from functools import partial

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import TensorXf, TensorXf64
from support import loss_checks
from support.helpers import central_difference
from support.kernels import kernel_hashes
from support.loss_checks import images, reference, value_and_gradient

from drgs.training.losses import PhotometricLoss, prepare_target

# Smaller than the window in one direction or both; with 27, no more zeros than the window needs.
SIZES = [(1, 1), (5, 3), (3, 17), (8, 27), (21, 34)]


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_loss_matches_the_naive_formula(height, width):
    x, y = images(height, width)
    for weight in (0, 0.2, 1):
        loss, _ = value_and_gradient(x, y, weight)
        # float64 sums of at most a few thousand terms in another order.
        assert loss == pytest.approx(reference(x, y, weight), rel=1e-12)


def test_single_precision_loss_matches_the_naive_formula_and_its_gradient_double_precision():
    x, y = images(21, 34, levels=255)
    loss, single = value_and_gradient(x, y, tensor_type=TensorXf)
    # Variances cancel to about 1e-7 of E[x^2] <= 1, relative to C2 = 9e-4 that is 1e-4 in a
    # flat window at worst; these windows' variances are 0.08, and the mean averages errors out.
    assert loss == pytest.approx(reference(x, y, 0.2), rel=2e-6)
    _, double = value_and_gradient(x, y)
    # An absolute error of 1e-7 relative to var_x + var_y = 0.16.
    np.testing.assert_allclose(single, double, atol=5e-6 * np.abs(double).max())


def test_window_matches_the_target():
    for size in ((19, 22), (1, 1), (4, 16)):
        x, y = images(*size)
        for window, sigma in ((1, 1.0), (5, 0.7), (25, 3.0)):
            loss, _ = value_and_gradient(x, y, window=window, sigma=sigma)
            expected = reference(x, y, 0.2, window=window, sigma=sigma)
            assert loss == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_gradient_equals_central_differences(height, width, weight):
    x, y = images(height, width, seed=1)
    _, gradient = value_and_gradient(x, y, weight)
    target, loss = prepare_target(TensorXf64(y)), PhotometricLoss(weight)
    corners = [(0, 0, 0), (height - 1, width - 1, 2), (0, width - 1, 1), (height - 1, 0, 2)]
    inner = [(height // 2, width // 2, 0), (height // 3, 2 * width // 3, 1)]
    # |x - y| has a kink: with this seed the nearest is 1e-4 away, ten steps.
    step = 1e-5
    assert np.abs(x - y).min() > step
    for index in {*corners, *inner}:
        numeric = central_difference(lambda z: loss(TensorXf64(z), target)[0], x, index, step)
        # Rounding: 1e-16 / 1e-5 = 1e-11 absolute; truncation: step^2 times a third derivative
        # of at most 1e3 per mean pixel.
        assert gradient[index] == pytest.approx(numeric, rel=1e-5, abs=2e-11), index


@pytest.mark.parametrize(
    "check",
    [
        loss_checks.check_gradient_is_the_transpose_of_the_tangent,
        loss_checks.check_black_photographs_count_like_others,
        loss_checks.check_l1_gradient_is_the_sign_and_zero_at_equality,
        loss_checks.check_overexposed_images_do_not_blow_up_the_gradient,
        partial(loss_checks.check_squared_error_is_the_mean_over_pixels_and_channels, 0),
        partial(loss_checks.check_squared_error_is_the_mean_over_pixels_and_channels, 0.2),
    ],
)
def test_law_of_the_loss_holds(check):
    """A law that broken kernels violate: see test_mutants.py."""
    check()


def test_kernels_do_not_depend_on_the_size_of_images():
    def hashes(height, width):
        x, y = images(height, width)

        def act():
            value_and_gradient(x, y, tensor_type=TensorXf)
            dr.eval(prepare_target(TensorXf(y)).image)

        return kernel_hashes(act)

    assert hashes(21, 34) == hashes(40, 61)


REFUSED = [
    ((4, 6, 3), {}, "image is 5 x 4 pixels, its target 6 x 4"),
    ((4, 6, 4), {}, r"\(H, W, 3\) tensor, got shape \(4, 6, 4\)"),
    ((4, 5, 3), {"weight": 1.5}, r"dssim_weight must be in \[0, 1\], got 1.5"),
    ((4, 5, 3), {"window": 10}, "window must be odd, in pixels, got 10"),
    ((4, 5, 3), {"sigma": 0}, "sigma must be > 0 pixels, got 0"),
]


@pytest.mark.parametrize(("shape", "options", "message"), REFUSED)
def test_wrong_shapes_and_values_are_refused(shape, options, message):
    with pytest.raises(ValueError, match=message):
        value_and_gradient(np.zeros((4, 5, 3)), np.zeros(shape), **options)
