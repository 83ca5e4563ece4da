"""Registration of renderings with photographs: against an image that is known everywhere."""

from dataclasses import replace

import numpy as np
import pytest
from support.small_capture import HEIGHT, WIDTH, pose_around, view

from drgs.results.alignment import align

COLORS = np.array([0.5, 0.4, 0.45])


def wave(x, y):
    """A smooth image at places in pixels, (..., 3), in 0.1..0.9."""
    parts = np.sin(0.45 * x + 0.2 * y), np.cos(0.35 * y - 0.1 * x), np.sin(0.3 * (x + y) + 1)
    return COLORS + 0.3 * np.stack(parts, axis=-1)


def pixels():
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return x, y


def view_of(image):
    return view("a", pose_around(0, 0.5), image)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.7, -0.4), (-2.1, 1.6)])
@pytest.mark.parametrize("gains", [(0, 0, 0), (0.2, -0.1, 0.05)])
def test_gains_and_shifts_are_found_and_removed(shift, gains):
    x, y = pixels()
    seen = (1 + np.array(gains)) * wave(x + shift[0], y + shift[1])
    found = align(view_of(seen), wave(x, y))
    # Of differences at the border, which the moved rendering lacks, and of interpolation.
    np.testing.assert_allclose(found.gains, gains, atol=0.01)
    np.testing.assert_allclose(found.shift, shift, atol=0.05)
    assert found.psnr > 40


def test_turns_and_zooms_are_removed():
    x, y = pixels()
    dx, dy, turn, zoom = x - WIDTH / 2, y - HEIGHT / 2, 0.06, 0.05
    seen = wave(x + zoom * dx - turn * dy, y + zoom * dy + turn * dx)
    assert -10 * np.log10(np.mean(np.square(seen - wave(x, y)))) < 32
    found = align(view_of(seen), wave(x, y))
    assert found.psnr > 38
    np.testing.assert_allclose(found.shift, 0, atol=0.03)


@pytest.mark.parametrize(
    ("name", "value"),
    [("zoom", 0.5), ("distortion", 0.5), ("skew", 0.6)],
)
def test_what_a_lens_does_is_found(name, value):
    x, y = pixels()
    size = np.hypot(WIDTH, HEIGHT) / 2
    across, down = (x - WIDTH / 2) / size, (y - HEIGHT / 2) / size
    s, strength = across**2 + down**2, {name: value}
    moved = strength.get("zoom", 0) + strength.get("distortion", 0) * s
    at = x + moved * across + strength.get("skew", 0) * down, y + moved * down
    seen = wave(*at)
    found = align(view_of(seen), wave(x, y))
    # A linear step.
    measured = float(np.ravel(getattr(found, name))[0])
    assert measured == pytest.approx(value, rel=0.35)
    assert name == "distortion" or abs(found.distortion) < 0.15
    assert found.left.shape == seen.shape[:2] and found.psnr > 33


def test_what_no_camera_explains_stays():
    x, y = pixels()
    seen = wave(x, y)
    seen[4:12, 5:15] = 0
    error = np.mean(np.square(seen - wave(x, y)))
    found = align(view_of(seen), wave(x, y))
    # The block has weights of nearly, not exactly, zero.
    assert found.psnr == pytest.approx(-10 * np.log10(error), abs=0.3)
    np.testing.assert_allclose(found.gains, 0, atol=0.02)
    mask = np.ones((HEIGHT, WIDTH), np.float32)
    mask[4:12, 5:15] = 0
    assert align(replace(view_of(seen), mask=mask), wave(x, y)).psnr > 60


@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.7, 0.4)])
def test_the_background_behind_a_transparent_photograph_has_no_gain(background):
    x, y = pixels()
    alpha = ((x - WIDTH / 2) ** 2 + (y - HEIGHT / 2) ** 2 < 60).astype(np.float32)
    behind = (1 - alpha[..., None]) * np.array(background)
    rendering = wave(x, y) * alpha[..., None] + behind
    seen = 1.2 * wave(x, y) * alpha[..., None] + behind
    found = align(replace(view_of(seen), alpha=alpha), rendering, background)
    np.testing.assert_allclose(found.gains, 0.2, atol=0.03)  # a blurred edge has weights
    assert found.psnr > 35
    assert not found.left[alpha == 0].any() and found.left[alpha > 0].any()


def test_images_that_cannot_be_aligned_differ_as_they_are():
    rng = np.random.default_rng(0)
    seen, other = rng.uniform(size=(2, HEIGHT, WIDTH, 3))
    found = align(view_of(seen), other)
    error = np.mean(np.square(seen - other))
    # Gains of -1/4 make independent noise 0.6 dB more alike; shifts and turns fit a little more.
    assert -1e-6 <= found.psnr + 10 * np.log10(error) < 1.5


@pytest.mark.parametrize("size", [(1, 1), (7, 9), (1, 30)])
def test_tiny_images_are_not_aligned(size):
    rng = np.random.default_rng(0)
    seen, other = rng.uniform(size=(2, *size, 3))
    small = replace(view_of(seen), width=size[1], height=size[0])
    found = align(small, other)
    np.testing.assert_array_equal([*found.gains, *found.shift], 0)
    assert found.psnr == pytest.approx(-10 * np.log10(np.mean(np.square(seen - other))))
