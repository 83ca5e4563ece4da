"""Photographs are kept as bytes, and become the numbers that they always were."""

from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
from support.datasets import edit, load, refusal

from drgs.config.schema import DataConfig
from drgs.datasets import images, load_dataset, reader
from drgs.datasets.images import (
    LazyImage,
    choose_store,
    compact_photograph,
    downscale,
    without_images,
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


@pytest.mark.parametrize(("width", "kept"), [(8, "bytes"), (10, "rounded"), (5, "numbers")])
def test_downscaled_photograph_is_stored_in_the_smaller_form(width, kept):
    """Numbers of half the width take as much as bytes, those of a third less.

    What is scaled by no whole factor is not scaled each time that somebody asks.
    """
    pixels = RNG.integers(0, 255, (12, 16, 4), np.uint8)
    image, alpha = compact_photograph(pixels, GREY, width)
    assert image.nbytes + alpha.nbytes <= pixels.nbytes
    assert all(isinstance(each, LazyImage) == (kept != "numbers") for each in (image, alpha))
    assert image.shape == np.asarray(image).shape and image.shape[1] == width
    exact = downscale(numbers_of(pixels), width)
    if kept == "rounded":
        assert (image.nbytes, alpha.nbytes) == (2 * 10 * 8 * 3, 2 * 10 * 8)
        assert 0 < np.abs(np.asarray(image) - exact).max() <= 0.51 / 65535
    else:
        np.testing.assert_allclose(image, exact, atol=2e-7)


@pytest.mark.parametrize("shape", [(6, 8), (7, 9), (5, 11), (3, 2)])
def test_downscaling_averages_over_each_pixels_area(shape):
    image = np.random.default_rng(1).random((*shape, 3)).astype(np.float32)
    actual = downscale(image, 4)
    height, width = actual.shape[:2]
    assert (height, width) == (round(shape[0] * 4 / shape[1]), 4) if shape[1] > 4 else shape
    # Each source pixel repeated until old and new pixel edges coincide, then plain means.
    repeated = image.astype(np.float64).repeat(height, axis=0).repeat(width, axis=1)
    blocks = repeated.reshape(height, shape[0], width, shape[1], 3)
    np.testing.assert_allclose(actual, blocks.mean(axis=(1, 3)), rtol=1e-6)


def test_scaling_a_composite_equals_compositing_scaled_premultiplied_colours(blender):
    folder, images_of_views = blender
    actual = load(folder, image_size=3, background=(0.25, 0.5, 0.75)).train[0].image
    pixels = images_of_views["train", 0].astype(np.float64) / 255
    pixels[..., :3] *= pixels[..., 3:]
    small = pixels.reshape(2, 2, 3, 2, 4).mean(axis=(1, 3))
    expected = small[..., :3] + np.array([0.25, 0.5, 0.75]) * (1 - small[..., 3:])
    np.testing.assert_allclose(actual, expected, atol=5e-7)


def test_image_size_scales_images_and_intrinsics_together(photographs):
    full, half = load(photographs), load(photographs, image_size=4)
    a, b = full.train[0], half.train[0]
    assert (b.width, b.height, b.image.shape) == (4, 3, (3, 4, 3))
    np.testing.assert_allclose(b.K[:2], a.K[:2] / 2)
    assert "4x3" in half.description
    assert load(photographs, image_size=100).train[0].width == 8  # never enlarged


def test_grey_images_become_rgb(photographs):
    grey = np.full((6, 8), 51, np.uint8)
    grey_and_alpha = np.full((6, 8, 2), (51, 255), np.uint8)
    for pixels in (grey, np.full((6, 8), 13107, np.uint16), grey_and_alpha):
        iio.imwrite(photographs / "images" / "01.png", pixels)
        image = load(photographs).train[0].image
        assert image.shape == (6, 8, 3)
        np.testing.assert_allclose(image, 0.2, rtol=1e-6)


def test_lazy_image_supports_array_operations():
    pixels = RNG.integers(0, 255, (4, 6, 3), np.uint8)
    image, _ = compact_photograph(pixels, GREY, None)
    numbers = numbers_of(pixels)
    assert image.dtype == np.float32 and len(image) == 4
    assert np.asarray(image, np.float64).dtype == np.float64
    for found, expected in (
        (image[None], numbers[None]),
        (image[1, ..., 2], numbers[1, ..., 2]),
        (numbers - image, 0 * numbers),
        (np.clip(image, 0.2, 0.3), np.clip(numbers, 0.2, 0.3)),
    ):
        assert isinstance(found, np.ndarray) and found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(ValueError, match="only by a copy"):
        image.__array__(copy=False)


def test_photographs_larger_than_memory_are_refused_before_reading(photographs, monkeypatch):
    """Ten photographs, one with alpha: (9 x 3 + 4) x 48 bytes."""
    rgba = RNG.integers(0, 256, (6, 8, 4), np.uint8)
    iio.imwrite(photographs / "images" / "01.png", rgba)
    files = sorted((photographs / "images").iterdir())
    monkeypatch.setattr(images, "available_memory", lambda: 1488)
    choose_store(files, None, True)
    monkeypatch.setattr(images, "available_memory", lambda: 1487)
    monkeypatch.setattr(reader, "read_pixels", None)
    assert refusal(photographs, in_memory=True) == (
        f"{photographs / 'images'}: 10 photographs take 1.49 kB of memory as they are kept, and "
        "1.49 kB are available; set data.in_memory=false or a smaller data.image_size, or use "
        "fewer of them"
    )
    choose_store(files, 2, True)


IMAGES = ("image", "alpha", "mask", "depth")


@pytest.fixture
def folder(photographs):
    """Photographs with alpha, masks and depths."""
    for index in range(10):
        pixels = RNG.integers(0, 256, (6, 8, 4), np.uint8)
        iio.imwrite(photographs / "images" / f"{index:02d}.png", pixels)
        iio.imwrite(photographs / f"mask{index}.png", np.full((6, 8), 255, np.uint8))
        np.save(photographs / f"depth{index}.npy", RNG.random((6, 8)))

    def add_data(meta):
        for index, frame in enumerate(meta["frames"]):
            frame.update(mask_path=f"mask{9 - index}.png", depth_file_path=f"depth{9 - index}.npy")

    edit(photographs / "transforms.json", add_data)
    return photographs


def test_images_of_other_processes_are_not_read(folder):
    """Pixels are damaged behind the headers, so all but the images is known."""
    config = DataConfig(path=folder, image_size=4)
    every = load_dataset(config)
    for index in (2, 5):
        image = folder / "images" / f"{index:02d}.png"
        image.write_bytes(image.read_bytes()[: image.stat().st_size // 2])
        (folder / f"mask{index}.png").write_bytes(b"")
        (folder / f"depth{index}.npy").write_bytes(b"")
    some = load_dataset(config, keeps=lambda name: name not in ("02", "05"))
    for view, expected in zip(some.train, every.train, strict=True):
        for name in ("name", "fx", "fy", "cx", "cy", "width", "height", "files"):
            assert getattr(view, name) == getattr(expected, name)
        for name in IMAGES:
            image, of_all = getattr(view, name), getattr(expected, name)
            if view.name not in ("02", "05"):
                np.testing.assert_array_equal(np.asarray(image), np.asarray(of_all))
                image = getattr(without_images(view), name)  # they are dropped after they were read
            assert image.nbytes == 0 and image.shape == of_all.shape
            with pytest.raises(RuntimeError, match="another process has its image"):
                np.asarray(image)
    assert without_images(replace(every.train[0], depth=None)).depth is None
