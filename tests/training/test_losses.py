"""The photometric loss against float64 scipy, and its adjoint against finite differences."""

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float, TensorXf, TensorXf64
from scipy.ndimage import correlate1d
from support.loss_checks import (
    check_gradient_is_the_transpose_of_the_tangent,
    check_l1_gradient_is_the_sign_and_zero_at_equality,
    check_overexposed_images_do_not_blow_up_the_gradient,
    check_squared_error_is_the_mean_over_pixels_and_channels,
    images,
    reference,
    value_and_gradient,
)

from drgs.results import metrics
from drgs.training.losses import PhotometricLoss, prepare_target

# Not a multiple of the tiles' 8 in any direction; smaller than the window; single pixels.
SIZES = [(1, 1), (5, 3), (3, 17), (8, 8), (21, 34)]


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_loss_matches_the_naive_formula(height, width):
    x, y = images(height, width)
    for weight in (0, 0.2, 1):
        loss, _ = value_and_gradient(x, y, weight)
        # float64 sums of at most a few thousand terms in another order.
        assert loss == pytest.approx(reference(x, y, weight), rel=1e-12)


def test_single_precision_loss_matches_the_naive_formula():
    x, y = images(21, 34, levels=255)
    loss, _ = value_and_gradient(x, y, tensor_type=TensorXf)
    # Variances cancel to about 1e-7 of E[x^2] <= 1, relative to C2 = 9e-4 that is 1e-4 in a
    # flat window at worst; these windows' variances are 0.08, and the mean averages errors out.
    assert loss == pytest.approx(reference(x, y, 0.2), rel=2e-6)


def test_window_matches_the_target():
    x, y = images(19, 22)
    for window, sigma in ((1, 1.0), (5, 0.7), (17, 3.0)):
        loss, _ = value_and_gradient(x, y, window=window, sigma=sigma)
        assert loss == pytest.approx(reference(x, y, 0.2, window=window, sigma=sigma), rel=1e-12)


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
        bumped = []
        for sign in (1, -1):
            z = x.copy()
            z[index] += sign * step
            bumped.append(loss(TensorXf64(z), target)[0])
        numeric = (bumped[0] - bumped[1]) / (2 * step)
        # Rounding: 1e-16 / 1e-5 = 1e-11 absolute; truncation: step^2 times a third derivative
        # of at most 1e3 per mean pixel.
        assert gradient[index] == pytest.approx(numeric, rel=1e-5, abs=2e-11), index


def test_gradient_is_the_transpose_of_the_tangent():
    check_gradient_is_the_transpose_of_the_tangent()


def test_incoming_gradient_scales_the_gradient():
    x, y = images(6, 7)
    _, gradient = value_and_gradient(x, y)
    image = TensorXf64(x)
    dr.enable_grad(image)
    dr.backward(-3 * PhotometricLoss(0.2)(image, prepare_target(TensorXf64(y))))
    np.testing.assert_allclose(dr.grad(image).numpy(), -3 * gradient, rtol=1e-13)


def test_l1_gradient_is_the_sign_and_zero_at_equality():
    check_l1_gradient_is_the_sign_and_zero_at_equality()


def test_equal_images_have_zero_loss_and_gradient():
    x, _ = images(12, 12)
    loss, gradient = value_and_gradient(x, x)
    # S = 1 up to rounding of the quotient, and there it has its maximum.
    assert abs(loss) < 1e-14
    assert np.abs(gradient).max() < 1e-12


def test_single_precision_gradient_agrees_with_double():
    x, y = images(30, 41, levels=255)
    _, single = value_and_gradient(x, y, tensor_type=TensorXf)
    _, double = value_and_gradient(x, y)
    # See above: variances carry an absolute error of 1e-7, relative to var_x + var_y = 0.16.
    np.testing.assert_allclose(single, double, atol=5e-6 * np.abs(double).max())


def test_overexposed_images_have_bounded_gradients():
    check_overexposed_images_do_not_blow_up_the_gradient()


def test_two_evaluations_are_bitwise_equal():
    x, y = images(40, 50)
    first = value_and_gradient(x, y, tensor_type=TensorXf)
    second = value_and_gradient(x, y, tensor_type=TensorXf)
    assert first[0] == second[0]
    assert first[1].tobytes() == second[1].tobytes()


def test_a_second_view_compiles_no_kernel():
    def kernels(seed):
        x, y = images(24, 18, seed)
        image, photograph = TensorXf(x), TensorXf(y)
        dr.enable_grad(image)
        dr.eval(image, photograph)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            target = prepare_target(photograph)
            dr.backward(PhotometricLoss()(image, target))
            dr.eval(dr.grad(image))
            history = dr.kernel_history([dr.KernelType.JIT])
        return [kernel["hash"] for kernel in history]

    first = kernels(0)
    assert len(first) > 0
    assert kernels(1) == first


def test_target_returns_its_photograph():
    _, y = images(11, 30)
    target = prepare_target(TensorXf64(y))
    np.testing.assert_array_equal(target.image.numpy(), y)


@pytest.mark.parametrize("weight", [0, 0.2])
def test_squared_error_is_the_mean_over_pixels_and_channels(weight):
    check_squared_error_is_the_mean_over_pixels_and_channels(weight)


def test_ssim_agrees_with_the_metric():
    x, y = images(33, 20)
    loss, _ = value_and_gradient(x, y, weight=1)
    assert 1 - loss == pytest.approx(metrics.ssim(x, y), rel=1e-12)


def test_separable_scipy_blur_gives_the_same_means():
    _, y = images(23, 14)
    target = prepare_target(TensorXf64(y))
    blurred = y
    for axis in (0, 1):
        blurred = correlate1d(blurred, np.array(target.weights), axis=axis, mode="constant")
    # Column order: (channel, tile row, tile column, column, row), filled up to multiples of 8.
    tiles = target.means.numpy().reshape(3, 3, 2, 8, 8).transpose(1, 4, 2, 3, 0)
    np.testing.assert_allclose(tiles.reshape(24, 16, 3)[:23, :14], blurred, rtol=1e-13)


def test_a_wrong_shape_is_refused_with_both_sizes():
    target = prepare_target(TensorXf(np.zeros((4, 6, 3))))
    with pytest.raises(ValueError, match="image is 5 x 4 pixels, its target 6 x 4"):
        PhotometricLoss()(TensorXf(np.zeros((4, 5, 3))), target)
    with pytest.raises(ValueError, match=r"\(H, W, 3\) tensor, got shape \(4, 6, 4\)"):
        prepare_target(TensorXf(np.zeros((4, 6, 4))))


def test_values_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"dssim_weight must be in \[0, 1\], got 1.5"):
        PhotometricLoss(1.5)
    image = dr.zeros(TensorXf, (4, 4, 3))
    with pytest.raises(ValueError, match="window must be odd and at most 17 pixels, got 10"):
        prepare_target(image, window=10)
    with pytest.raises(ValueError, match="sigma must be > 0 pixels, got 0"):
        prepare_target(image, sigma=0)


def test_loss_is_a_single_value():
    x, y = images(4, 4)
    loss = PhotometricLoss()(TensorXf(x), prepare_target(TensorXf(y)))
    assert type(loss) is Float
    assert dr.width(loss) == 1
