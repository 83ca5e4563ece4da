"""Photographs are kept as bytes, and become the numbers that they always were."""

from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
from support.datasets import load, refusal, view_at

from drgs.datasets import images, reader
from drgs.datasets.images import (
    LazyImage,
    check_memory,
    compact_mask,
    compact_photograph,
    downscale,
    num_threads,
    smaller_view,
)

RNG = np.random.default_rng(8)
GREY = (0.5, 0.5, 0.5)


def numbers_of(pixels, background=GREY):
    """Float32 numbers of bytes, composited; computed plainly."""
    values = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    if pixels.shape[2] == 3:
        return values
    alpha = values[:, :, 3:]
    return values[:, :, :3] * alpha + np.float32(background) * (1 - alpha)


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_photograph_is_stored_as_bytes(channels, dtype):
    pixels = RNG.integers(0, np.iinfo(dtype).max, (12, 16, channels), dtype)
    image, alpha = compact_photograph(pixels, GREY, None)
    assert isinstance(image, LazyImage) and image.nbytes == pixels.nbytes
    assert image.shape == (12, 16, 3)
    made = np.asarray(image)
    assert made.dtype == np.float32 and made.tobytes() == numbers_of(pixels).tobytes()
    if channels == 3:
        assert alpha is None
    else:
        expected = pixels[..., 3] / np.float32(np.iinfo(dtype).max)
        assert (alpha.nbytes, alpha.shape) == (0, (12, 16))
        assert np.asarray(alpha).tobytes() == expected.astype(np.float32).tobytes()


@pytest.mark.parametrize(
    ("width", "kept"), [(16, "bytes"), (8, "bytes"), (10, "rounded"), (5, "numbers")]
)
def test_downscaled_photograph_is_stored_in_the_smaller_form(width, kept):
    """Numbers of half the width take as much as bytes, those of a third less.

    What is scaled by no whole factor is not scaled each time that somebody asks.
    """
    pixels = RNG.integers(0, 255, (12, 16, 4), np.uint8)
    image, alpha = compact_photograph(pixels, GREY, width)
    of_all = [(image.nbytes, image), (alpha.nbytes, alpha)]
    assert sum(count for count, _ in of_all) <= pixels.nbytes
    assert all(isinstance(p, LazyImage) == (kept != "numbers") for _, p in of_all)
    if kept == "rounded":
        assert (image.nbytes, alpha.nbytes) == (2 * 10 * 8 * 3, 2 * 10 * 8)
        exact = downscale(numbers_of(pixels), width)
        assert 0 < np.abs(np.asarray(image) - exact).max() <= 0.51 / 65535
    assert image.shape == np.asarray(image).shape and image.shape[1] == width
    if width == 8:
        blocks = numbers_of(pixels).reshape(6, 2, 8, 2, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(image, blocks, atol=2e-7)


def test_mask_is_stored_in_one_byte_per_pixel():
    mask = RNG.integers(0, 2, (5, 7)).astype(np.float32)
    kept = compact_mask(mask)
    assert (kept.nbytes, kept.shape) == (35, (5, 7))
    assert np.asarray(kept).tobytes() == mask.tobytes()


def test_dataset_uses_the_memory_of_its_uncompressed_files(photographs):
    iio.imwrite(photographs / "images" / "01.png", RNG.integers(0, 256, (6, 8, 4), np.uint8))
    dataset = load(photographs)
    for view in (*dataset.train, *dataset.test):
        channels = 3 if view.alpha is None else 4
        assert view.image.nbytes == view.width * view.height * channels


def test_smaller_views_take_no_memory():
    view = view_at((4, 0, 0), (0, 0, 0))
    pixels = RNG.integers(0, 255, (30, 40, 4), np.uint8)
    image, alpha = compact_photograph(pixels, GREY, None)
    smaller = smaller_view(replace(view, image=image, alpha=alpha), 5)
    assert smaller.image.nbytes == smaller.alpha.nbytes == 0
    assert (smaller.image.shape, smaller.alpha.shape) == ((6, 8, 3), (6, 8))
    blocks = numbers_of(pixels).reshape(6, 5, 8, 5, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(smaller.image, blocks, atol=2e-7)


def test_a_lazy_image_refuses_conversion_without_a_copy():
    image, _ = compact_photograph(np.zeros((2, 2, 3), np.uint8), GREY, None)
    assert np.asarray(image, np.float64).dtype == np.float64
    with pytest.raises(ValueError, match="only by a copy"):
        image.__array__(copy=False)


def test_lazy_image_supports_array_operations():
    pixels = RNG.integers(0, 255, (4, 6, 3), np.uint8)
    image, _ = compact_photograph(pixels, GREY, None)
    numbers = numbers_of(pixels)
    assert image.dtype == np.float32 and len(image) == 4
    np.testing.assert_array_equal(image[None], numbers[None])
    np.testing.assert_array_equal(image[1, ..., 2], numbers[1, ..., 2])
    for found, expected in (
        (numbers - image, 0 * numbers),
        (np.square(image), np.square(numbers)),
        (np.clip(image, 0.2, 0.3), np.clip(numbers, 0.2, 0.3)),
    ):
        assert isinstance(found, np.ndarray) and found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)


def test_photographs_larger_than_memory_are_refused_before_reading(photographs, monkeypatch):
    """Ten photographs, one with alpha: (9 x 3 + 4) x 48 bytes."""
    rgba = RNG.integers(0, 256, (6, 8, 4), np.uint8)
    iio.imwrite(photographs / "images" / "01.png", rgba)
    files = sorted((photographs / "images").iterdir())
    monkeypatch.setattr(images, "available_memory", lambda: 1488)
    check_memory(files, None)
    monkeypatch.setattr(images, "available_memory", lambda: 1487)
    monkeypatch.setattr(reader, "read_pixels", None)
    message = (
        f"{photographs / 'images'}: 10 photographs take 1.49 kB of memory as they are kept, and "
        "1.49 kB are available; set a smaller data.image_size, or use fewer of them"
    )
    assert refusal(photographs) == message
    check_memory(files, 2)


def test_large_photographs_are_read_one_at_a_time(tmp_path):
    for width, expected in ((400, 8), (6000, 1)):
        iio.imwrite(tmp_path / "a.png", np.zeros((width, width), np.uint8))
        assert num_threads([tmp_path / "a.png"]) == expected
