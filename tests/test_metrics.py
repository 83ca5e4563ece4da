"""PSNR and SSIM against hand-made cases and scipy's two-dimensional filters."""

import numpy as np
import pytest
from scipy.ndimage import convolve

from drgs.metrics import mean_quality, psnr, ssim


def images(seed=0, shape=(31, 20, 3)):
    return np.random.default_rng(seed).random((2, *shape))


def test_psnr_of_a_constant_offset():
    image = np.full((4, 5, 3), 0.5)
    # Mean squared error 0.01: 20 dB.
    assert psnr(image + 0.1, image) == pytest.approx(20, rel=1e-12)
    assert psnr(image, image) == np.inf


def test_values_are_clamped_before_they_are_compared():
    target = np.ones((6, 6, 3))
    assert psnr(target + 3, target) == np.inf
    assert ssim(target + 3, target) == pytest.approx(1, abs=1e-14)
    assert psnr(-target, 0 * target) == np.inf


def test_single_precision_pictures_are_compared_in_double():
    x, y = images()
    assert psnr(x.astype(np.float32), y) == pytest.approx(psnr(x, y), rel=1e-6)


def test_nan_is_not_hidden():
    x, y = images()
    x[0, 0, 0] = np.nan
    assert np.isnan(psnr(x, y))
    assert np.isnan(ssim(x, y))


def test_ssim_is_one_for_equal_pictures_only():
    x, y = images()
    assert ssim(x, x) == pytest.approx(1, abs=1e-14)
    assert ssim(x, y) < 0.5
    assert ssim(x, y) == pytest.approx(ssim(y, x), rel=1e-14)


def test_ssim_of_flat_pictures_is_the_luminance_term():
    # Windows wholly inside: no variance, so S = (2ab + C1) / (a^2 + b^2 + C1).
    x, y = np.full((40, 40, 3), 0.3), np.full((40, 40, 3), 0.6)
    weights = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights /= weights.sum()
    covered = np.array([weights[max(0, 5 - i) : 5 + 40 - i].sum() for i in range(40)])
    mass = np.outer(covered, covered)  # of the window inside the picture
    a, b = 0.3 * mass, 0.6 * mass
    var_a, var_b, cov = 0.09 * mass - a * a, 0.36 * mass - b * b, 0.18 * mass - a * b
    expected = ((2 * a * b + 1e-4) * (2 * cov + 9e-4)) / (
        (a * a + b * b + 1e-4) * (var_a + var_b + 9e-4)
    )
    assert expected[20, 20] == pytest.approx((0.36 + 1e-4) / (0.45 + 1e-4), rel=1e-9)
    assert ssim(x, y) == pytest.approx(expected.mean(), rel=1e-12)


def test_ssim_is_that_of_two_dimensional_windows():
    x, y = images(1)
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window = (window / window.sum())[:, :, None]

    def mean(values):
        return convolve(values, window, mode="constant")

    var_x, var_y = mean(x * x) - mean(x) ** 2, mean(y * y) - mean(y) ** 2
    cov = mean(x * y) - mean(x) * mean(y)
    numerator = (2 * mean(x) * mean(y) + 1e-4) * (2 * cov + 9e-4)
    denominator = (mean(x) ** 2 + mean(y) ** 2 + 1e-4) * (var_x + var_y + 9e-4)
    # float64 in another order of summation.
    assert ssim(x, y) == pytest.approx((numerator / denominator).mean(), rel=1e-12)


def test_views_weigh_the_same():
    pairs = [images(0), images(1, (5, 9, 3))]
    quality = mean_quality(iter(pairs))
    assert quality.num_views == 2
    assert quality.psnr == pytest.approx(np.mean([psnr(*pair) for pair in pairs]))
    assert quality.ssim == pytest.approx(np.mean([ssim(*pair) for pair in pairs]))


def test_wrong_input_is_refused():
    x, y = images()
    with pytest.raises(ValueError, match=r"got \(31, 20, 3\) and \(30, 20, 3\)"):
        psnr(x, y[1:])
    with pytest.raises(ValueError, match=r"must both be \(H, W, 3\)"):
        ssim(x[..., 0], y[..., 0])
    with pytest.raises(ValueError, match="at least one view"):
        mean_quality([])
