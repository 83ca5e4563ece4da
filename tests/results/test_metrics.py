"""PSNR and SSIM against hand-made cases and scipy's two-dimensional filters."""

import numpy as np
import pytest
from scipy.ndimage import convolve

from drgs.results.metrics import mean_quality, psnr, ssim


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


def test_single_precision_images_are_compared_in_double():
    x, y = images()
    assert psnr(x.astype(np.float32), y) == pytest.approx(psnr(x, y), rel=1e-6)


def test_nan_is_not_hidden():
    x, y = images()
    x[0, 0, 0] = np.nan
    assert np.isnan(psnr(x, y))
    assert np.isnan(ssim(x, y))


def test_ssim_is_one_for_equal_images_only():
    x, y = images()
    assert ssim(x, x) == pytest.approx(1, abs=1e-14)
    assert ssim(x, y) < 0.5
    assert ssim(x, y) == pytest.approx(ssim(y, x), rel=1e-14)


def test_ssim_of_flat_images_is_the_luminance_term():
    # Windows wholly inside: no variance, so S = (2ab + C1) / (a^2 + b^2 + C1).
    x, y = np.full((40, 40, 3), 0.3), np.full((40, 40, 3), 0.6)
    weights = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights /= weights.sum()
    covered = np.array([weights[max(0, 5 - i) : 5 + 40 - i].sum() for i in range(40)])
    mass = np.outer(covered, covered)  # of the window inside the image
    a, b = 0.3 * mass, 0.6 * mass
    var_a, var_b, cov = 0.09 * mass - a * a, 0.36 * mass - b * b, 0.18 * mass - a * b
    expected = ((2 * a * b + 1e-4) * (2 * cov + 9e-4)) / (
        (a * a + b * b + 1e-4) * (var_a + var_b + 9e-4)
    )
    assert expected[20, 20] == pytest.approx((0.36 + 1e-4) / (0.45 + 1e-4), rel=1e-9)
    assert ssim(x, y) == pytest.approx(expected.mean(), rel=1e-12)


def test_ssim_matches_two_dimensional_windows():
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


def test_views_have_equal_weight():
    pairs = [images(0), images(1, (5, 9, 3))]
    quality = mean_quality(iter(pairs))
    assert quality.num_views == 2
    assert quality.psnr == pytest.approx(np.mean([psnr(*pair) for pair in pairs]))
    assert quality.ssim == pytest.approx(np.mean([ssim(*pair) for pair in pairs]))


def test_psnr_with_a_mask_uses_kept_pixels():
    x, y = images()
    mask = np.random.default_rng(3).integers(0, 2, x.shape[:2])
    squared = [(x[i, j] - y[i, j]) ** 2 for i, j in np.argwhere(mask)]
    assert psnr(x, y, mask) == pytest.approx(-10 * np.log10(np.mean(squared)), rel=1e-12)
    assert psnr(x, y, np.ones(x.shape[:2])) == psnr(x, y)
    assert psnr(x, y, mask.astype(np.float32)) == psnr(x, y, mask)


def test_masked_pixels_do_not_affect_metrics():
    """SSIM's windows see black there."""
    x, y = images()
    mask = np.ones(x.shape[:2])
    mask[5:20, 3:9] = 0
    spoiled = np.where(mask[..., None] > 0, x, 0.5)
    assert psnr(spoiled, y, mask) == psnr(x, y, mask)
    assert ssim(spoiled, y, mask) == ssim(x, y, mask)
    black = [values * mask[..., None] for values in (x, y)]
    assert ssim(x, y, mask) == ssim(*black, mask) != ssim(*black)


def test_ssim_with_a_mask_averages_the_map_over_kept_pixels():
    """The expected value uses a window in two dimensions at each pixel of masked images."""
    x, y = images(2, (14, 13, 3))
    mask = np.ones((14, 13))
    mask[2:6, 4:9] = 0
    a, b = x * mask[..., None], y * mask[..., None]
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / 4.5)
    window /= window.sum()
    padded = [np.pad(v, ((5, 5), (5, 5), (0, 0))) for v in (a, b)]
    found = []
    for i, j in np.argwhere(mask):
        p, q = (v[i : i + 11, j : j + 11] for v in padded)

        def mean(values):
            return np.einsum("ij,ijc->c", window, values)

        mp, mq = mean(p), mean(q)
        vp, vq, cov = mean(p * p) - mp**2, mean(q * q) - mq**2, mean(p * q) - mp * mq
        found.append(
            (2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4))
        )
    assert ssim(x, y, mask) == pytest.approx(np.mean(found), rel=1e-12)


def test_views_may_have_masks():
    (x, y), (p, q) = images(0), images(1)
    mask = np.ones(p.shape[:2])
    mask[:10] = 0
    quality = mean_quality([(x, y, None), (p, q, mask)])
    assert quality.psnr == pytest.approx((psnr(x, y) + psnr(p, q, mask)) / 2)
    assert quality.ssim == pytest.approx((ssim(x, y) + ssim(p, q, mask)) / 2)


def test_wrong_input_is_refused():
    x, y = images()
    with pytest.raises(ValueError, match=r"got \(31, 20, 3\) and \(30, 20, 3\)"):
        psnr(x, y[1:])
    with pytest.raises(ValueError, match=r"must both be \(H, W, 3\)"):
        ssim(x[..., 0], y[..., 0])
    with pytest.raises(ValueError, match="at least one view"):
        mean_quality([])
