"""The photometric loss as its formulas say, and what its gradient is checked against."""

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import TensorXf, TensorXf64

from drgs.training.losses import PhotometricLoss, l1_loss, prepare_target


def images(height, width, seed=0, levels=None):
    random = np.random.default_rng(seed)
    pair = random.random((2, height, width, 3))
    if levels:
        pair = np.round(pair * levels) / levels
    return pair


def naive_ssim(x, y, window=11, sigma=1.5):
    """Every window spelled out: weighted moments of zero-padded neighbourhoods."""
    radius = window // 2
    offsets = np.arange(-radius, radius + 1)
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * sigma**2))
    weights = (weights / weights.sum())[:, :, None]
    pad = [(radius, radius), (radius, radius), (0, 0)]
    x_padded, y_padded = np.pad(x, pad), np.pad(y, pad)
    result = np.empty_like(x)
    for i, j in np.ndindex(x.shape[:2]):
        a = x_padded[i : i + window, j : j + window]
        b = y_padded[i : i + window, j : j + window]
        mean_a, mean_b = (weights * a).sum((0, 1)), (weights * b).sum((0, 1))
        var_a = (weights * a * a).sum((0, 1)) - mean_a**2
        var_b = (weights * b * b).sum((0, 1)) - mean_b**2
        cov = (weights * a * b).sum((0, 1)) - mean_a * mean_b
        result[i, j] = ((2 * mean_a * mean_b + 1e-4) * (2 * cov + 9e-4)) / (
            (mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4)
        )
    return result


def reference(x, y, weight, **window):
    return (1 - weight) * np.abs(x - y).mean() + weight * (1 - naive_ssim(x, y, **window).mean())


def value_and_gradient(x, y, weight=0.2, tensor_type=TensorXf64, **window):
    target = prepare_target(tensor_type(y), **window)
    image = tensor_type(x)
    dr.enable_grad(image)
    loss = PhotometricLoss(weight)(image, target)
    dr.backward(loss)
    return loss[0], dr.grad(image).numpy()


def check_gradient_is_the_transpose_of_the_tangent():
    x, y = images(13, 9, seed=2)
    _, gradient = value_and_gradient(x, y)
    tangent = np.random.default_rng(3).standard_normal(x.shape)
    image = TensorXf64(x)
    dr.enable_grad(image)
    dr.set_grad(image, TensorXf64(tangent))
    loss = PhotometricLoss(0.2)(image, prepare_target(TensorXf64(y)))
    forward = dr.forward_to(loss)[0]
    assert forward == pytest.approx((gradient * tangent).sum(), rel=1e-12)


def check_squared_error_is_the_mean_over_pixels_and_channels(weight):
    x, y = images(21, 34)
    image, target = TensorXf64(x), prepare_target(TensorXf64(y))
    loss, error = PhotometricLoss(weight).with_squared_error(image, target)
    assert loss[0] == PhotometricLoss(weight)(image, target)[0]
    # float64 sums of two thousand terms in another order.
    assert error[0] == pytest.approx(np.mean((x - y) ** 2), rel=1e-12)


def check_black_photographs_count_like_others():
    x, _ = images(13, 9)
    y = np.zeros_like(x)
    loss, _ = value_and_gradient(x, y, 0.2)
    # float64 sums of 351 terms in another order.
    assert loss == pytest.approx(reference(x, y, 0.2), rel=1e-12)


def check_l1_gradient_is_the_sign_and_zero_at_equality():
    x, y = images(7, 11, levels=3)
    assert (x == y).any()
    expected = np.sign(x - y) / x.size
    _, gradient = value_and_gradient(x, y, weight=0)
    np.testing.assert_allclose(gradient, expected, rtol=1e-14)

    image = TensorXf64(x)
    dr.enable_grad(image)
    loss = l1_loss(image, TensorXf64(y))
    assert loss[0] == pytest.approx(np.abs(x - y).mean(), rel=1e-14)

    # With SSIM beside it, the L1 part is what is left of the whole.
    _, whole = value_and_gradient(x, y, weight=0.2)
    _, ssim_part = value_and_gradient(x, y, weight=1)
    np.testing.assert_allclose(whole - 0.2 * ssim_part, 0.8 * expected, atol=1e-15)


def check_overexposed_images_do_not_blow_up_the_gradient():
    # In single precision E[x^2] - E[x]^2 of a flat x = 60 is off by 1e-3, more than C2: taken as
    # it comes out, the denominator of S gets close to zero somewhere.
    x = 60 + 1e-3 * images(48, 48)[0]
    y = np.full_like(x, 0.5)
    _, single = value_and_gradient(x, y, weight=1, tensor_type=TensorXf)
    _, double = value_and_gradient(x, y, weight=1)
    # No digit is left in this variance; with it cut off at zero the error is a third of the
    # gradient, without that fifteen times the gradient.
    assert np.abs(single - double).max() < np.abs(double).max()
