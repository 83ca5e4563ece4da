"""Images and animations that are written, and what is read of others."""

import struct

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image, ImageCms, ImageSequence

from drgs.core.errors import UserError
from drgs.io import images


def frames_of(path):
    rendered = Image.open(path)
    assert rendered.info["loop"] == 0
    return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(rendered)]


def test_png_contains_the_image_rounded_and_clamped(tmp_path):
    image = np.array([[[-0.5, 0.0, 0.5019], [0.999, 1.0, 7.0]]])
    images.write_png(tmp_path / "new" / "a.png", image)
    written = np.asarray(Image.open(tmp_path / "new" / "a.png"))
    assert written.tolist() == [[[0, 0, 128], [255, 255, 255]]]


@pytest.mark.parametrize("background", [(255, 255, 255), (0, 0, 0), (131, 97, 202)])
def test_compression_leaves_a_flat_background_clean(tmp_path, background):
    """Soft blobs of noise, whose codes would spread over the blocks around them."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:64, :600]
    color, frames = np.array(background) / 255, []
    for k in range(5):
        alpha = np.clip(1.4 - np.hypot(x - 30 - 6 * k, y - 30) / 16, 0, 1)[..., None]
        frames.append(alpha * rng.uniform(size=(64, 600, 3)) + (1 - alpha) * color)
    for name in ("a", "b"):
        images.write_animation(tmp_path / f"{name}.webp", frames)
    assert (tmp_path / "a.webp").read_bytes() == (tmp_path / "b.webp").read_bytes()
    for frame, expected in zip(frames_of(tmp_path / "a.webp"), frames, strict=True):
        empty = (expected == color).all(axis=2)
        assert (frame[empty] == background).all()
        assert np.abs(frame / 255 - expected).max() <= (images.LOSSLESS_STEP + 1) / 2 / 255


def test_a_large_animation_is_written_at_a_lower_quality(tmp_path, monkeypatch):
    noise = list(np.random.default_rng(0).uniform(size=(3, 64, 64, 3)))
    images.write_animation(tmp_path / "fine.webp", noise)
    size = (tmp_path / "fine.webp").stat().st_size
    monkeypatch.setattr(images, "WEBP_BYTES", size - 1)
    images.write_animation(tmp_path / "coarse.webp", noise)
    assert (tmp_path / "coarse.webp").stat().st_size < size


def write_tiff16(path, pixels):
    """Little-endian, one strip of RGB of 16 bits, as scanners and raw converters write it."""
    height, width, channels = pixels.shape
    data = pixels.astype("<u2").tobytes()
    bits = 8 + 2 + 9 * 12 + 4
    entries = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, channels, bits), (259, 3, 1, 1)]
    entries += [(262, 3, 1, 2), (273, 4, 1, bits + 6), (277, 3, 1, channels), (278, 4, 1, height)]
    entries += [(279, 4, 1, len(data))]
    content = b"II*\0" + struct.pack("<IH", 8, len(entries))
    content += b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4)
    path.write_bytes(content + struct.pack("<3H", 16, 16, 16) + data)


def test_colours_of_16_bits_keep_the_upper_8(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 2**16, (4, 5, 3), np.uint16)
    mi.Bitmap(pixels).write(str(tmp_path / "a.png"))
    write_tiff16(tmp_path / "a.tif", pixels)
    (tmp_path / "a.ppm").write_bytes(b"P6 5 4 65535\n" + pixels.astype(">u2").tobytes())
    for name in ("a.png", "a.tif", "a.ppm"):
        read = images.read_pixels(tmp_path / name)
        assert np.abs(read.astype(int) - pixels / 257).max() <= 1 and read.dtype == np.uint8
    Image.fromarray(pixels[:, :, 0]).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(images.read_pixels(tmp_path / "grey.png")[..., 1], pixels[..., 0])


def test_transparent_colour_of_a_png_is_respected(tmp_path):
    pixels = np.zeros((2, 3, 3), np.uint8)
    pixels[0, 1] = 9, 8, 7
    for array, key in ((pixels, (9, 8, 7)), (pixels[:, :, 0], 9)):
        Image.fromarray(array).save(tmp_path / "a.png", transparency=key)
        header = images.read_header(tmp_path / "a.png")
        assert header.has_alpha and header.size == (3, 2)
        alpha = images.read_pixels(tmp_path / "a.png")[:, :, 3]
        np.testing.assert_array_equal(alpha == 0, pixels[:, :, 0] == 9)


LAB, SRGB = (
    ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes() for name in ("LAB", "sRGB")
)
GREY = Image.new("RGB", (3, 2), (90, 90, 90))


@pytest.mark.parametrize(
    ("profile", "name"), [(SRGB, ""), (b"broken", ""), (LAB, "Lab identity built-in")]
)
def test_other_colour_profiles_than_srgb_are_named(tmp_path, profile, name):
    for suffix in ("jpg", "png", "tif"):
        GREY.save(tmp_path / f"a.{suffix}", icc_profile=profile)
        assert images.colour_profile(tmp_path / f"a.{suffix}") == name


@pytest.mark.parametrize("value", [-1, 70_000])
def test_whole_numbers_of_more_than_16_bits_are_refused(tmp_path, value):
    Image.fromarray(np.full((2, 3), value, np.int32)).save(tmp_path / "a.tif")
    with pytest.raises(UserError, match=f"must have values of 16 bits, 0 to 65535, got {value} to"):
        images.read_pixels(tmp_path / "a.tif")
