"""PSNR and SSIM against hand-made cases and windows in two dimensions."""

import numpy as np
import pytest

from drgs.results.metrics import flip, mean_quality, psnr, ssim


def images(seed=0, shape=(17, 14, 3)):
    return np.random.default_rng(seed).random((2, *shape))


X, Y = images()
MASK = np.ones(X.shape[:2])
MASK[5:12, 3:9] = 0


def test_psnr_of_known_images():
    """Values are clamped, compared in double precision, and not hidden where they are NaN."""
    image, white = np.full((4, 5, 3), 0.5), np.ones((6, 6, 3))
    # Mean squared error 0.01: 20 dB.
    assert psnr(image + 0.1, image) == pytest.approx(20, rel=1e-12)
    assert psnr(image, image) == psnr(white + 3, white) == psnr(-white, 0 * white) == np.inf
    assert ssim(white + 3, white) == pytest.approx(1, abs=1e-14)
    assert psnr(X.astype(np.float32), Y) == pytest.approx(psnr(X, Y), rel=1e-6)
    wrong = X.copy()
    wrong[0, 0, 0] = np.nan
    assert np.isnan(psnr(wrong, Y)) and np.isnan(ssim(wrong, Y))


@pytest.mark.parametrize("mask", [None, MASK], ids=["all", "mask"])
def test_ssim_is_the_mean_over_two_dimensional_windows(mask):
    """A window at each kept pixel of masked images, which are black beyond their edges."""
    kept = np.ones_like(MASK) if mask is None else mask
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window /= window.sum()
    padded = [np.pad(v * kept[..., None], ((5, 5), (5, 5), (0, 0))) for v in (X, Y)]
    found = []
    for i, j in np.argwhere(kept):
        p, q = (v[i : i + 11, j : j + 11] for v in padded)
        mp, mq, pp, qq, pq = (
            np.einsum("ij,ijc->c", window, v) for v in (p, q, p * p, q * q, p * q)
        )
        luminance = (2 * mp * mq + 1e-4) / (mp**2 + mq**2 + 1e-4)
        found.append(luminance * (2 * (pq - mp * mq) + 9e-4) / (pp - mp**2 + qq - mq**2 + 9e-4))
    # float64 in another order of summation.
    assert ssim(X, Y, mask) == pytest.approx(np.mean(found), rel=1e-12)
    assert ssim(Y, X, mask) == pytest.approx(ssim(X, Y, mask), rel=1e-14)
    assert ssim(X, X, mask) == pytest.approx(1, abs=1e-14)


def test_masked_pixels_do_not_affect_metrics():
    """SSIM's windows see black there."""
    squared = [(X[i, j] - Y[i, j]) ** 2 for i, j in np.argwhere(MASK)]
    assert psnr(X, Y, MASK) == pytest.approx(-10 * np.log10(np.mean(squared)), rel=1e-12)
    assert psnr(X, Y, MASK.astype(np.float32)) == psnr(X, Y, MASK)
    spoiled = np.where(MASK[..., None] > 0, X, 0.5)
    assert psnr(spoiled, Y, MASK) == psnr(X, Y, MASK)
    assert ssim(spoiled, Y, MASK) == ssim(X, Y, MASK)


def test_views_have_equal_weight_and_may_have_masks():
    x, y = images(1, (5, 9, 3))
    quality = mean_quality(iter([(X, Y, MASK), (x, y)]))
    assert quality.num_views == 2
    assert quality.psnr == pytest.approx((psnr(X, Y, MASK) + psnr(x, y)) / 2)
    assert quality.ssim == pytest.approx((ssim(X, Y, MASK) + ssim(x, y)) / 2)


def test_wrong_input_is_refused():
    with pytest.raises(ValueError, match=r"got \(17, 14, 3\) and \(16, 14, 3\)"):
        psnr(X, Y[1:])
    with pytest.raises(ValueError, match=r"must both be \(H, W, 3\)"):
        ssim(X[..., 0], Y[..., 0])
    with pytest.raises(ValueError, match="at least one view"):
        mean_quality([])


def lab_of(linear):
    """L*a*b* of linear sRGB (3,), D65, with the chroma of Hunt's effect."""
    matrix = [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750]]
    matrix = np.array([*matrix, [0.0193339, 0.1191920, 0.9503041]])
    ratio = matrix @ linear / matrix.sum(axis=1)
    x, y, z = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio * 841 / 108 + 4 / 29)
    lightness = 116 * y - 16
    return np.array([lightness, 5 * (x - y) * lightness, 2 * (y - z) * lightness])


@pytest.mark.parametrize(("first", "second"), [(0.5, 0.55), (0.1, 0.9), (0.3, 0.3)])
def test_flip_of_plain_grey_images_is_that_of_their_lightness(first, second):
    """Andersson et al. 2020, sections 4.1.3 and 4.3; where the mask is 0, the images differ."""
    pytest.importorskip("flip_evaluator")
    linear = [((v + 0.055) / 1.055) ** 2.4 for v in (first, second)]
    difference = np.abs(np.subtract(*(lab_of(np.full(3, v))[0] for v in linear))) ** 0.7
    green, blue = lab_of(np.array([0, 1, 0])), lab_of(np.array([0, 0, 1]))
    most = (abs(green[0] - blue[0]) + np.hypot(*(green - blue)[1:])) ** 0.7
    share = difference / most
    expected = share * 0.95 / 0.4 if share < 0.4 else 0.95 + (share - 0.4) / 0.6 * 0.05
    image, target = np.full((30, 90, 3), first), np.full((30, 90, 3), second)
    # flip-evaluator computes in float32, with rounded matrices.
    assert flip(image, target) == pytest.approx(expected, abs=1e-4)
    mask = np.ones((30, 90))
    image[:, :10], mask[:, :40] = 1, 0
    assert flip(image, target, mask) == pytest.approx(expected, abs=1e-4)
