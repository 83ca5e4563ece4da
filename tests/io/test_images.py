import io
import struct

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image, ImageCms
from support.openexr import read_exr

from drgs.core.errors import UserError
from drgs.io import images


def moving_square(count=6, width=400, height=40):
    frames = np.ones((count, height, width, 3))
    for index, frame in enumerate(frames):
        frame[10:30, 20 * index : 20 * index + 40] = [0.8, 0.1, 0.2]
    return list(frames)


def frames_of(path):
    rendered = Image.open(path)
    frames = []
    for index in range(rendered.n_frames):
        rendered.seek(index)
        frames.append(np.asarray(rendered.convert("RGB")) / 255)
    return rendered, frames


def test_png_contains_the_image_rounded_and_clamped(tmp_path):
    image = np.array([[[-0.5, 0.0, 0.5019], [0.999, 1.0, 7.0]]])
    images.write_png(tmp_path / "new" / "a.png", image)
    assert np.asarray(Image.open(tmp_path / "new" / "a.png")).tolist() == [
        [[0, 0, 128], [255, 255, 255]]
    ]


def test_animation_loops_and_contains_every_frame(tmp_path):
    frames = moving_square()
    images.write_animation(tmp_path / "a.webp", frames)
    rendered, decoded = frames_of(tmp_path / "a.webp")
    assert rendered.info["loop"] == 0
    assert len(decoded) == len(frames)
    for frame, expected in zip(decoded, frames, strict=True):
        assert np.abs(frame - expected).max() <= images.LOSSLESS_STEP / 2 / 255 + 1e-9


@pytest.mark.parametrize("background", [(255, 255, 255), (0, 0, 0), (131, 97, 202)])
def test_compression_leaves_a_flat_background_clean(tmp_path, background):
    """Soft blobs of noise, whose codes would spread over the blocks around them."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:64, :96]
    color, frames = np.array(background) / 255, []
    for k in range(5):
        alpha = np.clip(1.4 - np.hypot(x - 30 - 6 * k, y - 30) / 16, 0, 1)[..., None]
        frames.append(alpha * rng.uniform(size=(64, 96, 3)) + (1 - alpha) * color)
    images.write_animation(tmp_path / "a.webp", frames)
    _, decoded = frames_of(tmp_path / "a.webp")
    for frame, expected in zip(decoded, frames, strict=True):
        empty = (expected == color).all(axis=2)
        assert 0.3 < empty.mean() < 0.9
        assert (np.round(frame[empty] * 255) == background).all()
        assert np.abs(frame - expected).max() <= (images.LOSSLESS_STEP + 1) / 2 / 255


def test_images_without_flat_background_are_compressed_lossily(tmp_path, monkeypatch):
    noise = list(np.random.default_rng(0).uniform(size=(3, 64, 64, 3)))
    images.write_animation(tmp_path / "full.webp", noise)
    assert b"VP8 " in (tmp_path / "full.webp").read_bytes()
    for frame in noise:
        frame[:, 32:] = 1
    images.write_animation(tmp_path / "half.webp", noise)
    assert b"VP8L" in (tmp_path / "half.webp").read_bytes()
    monkeypatch.setattr(images, "LOSSLESS_WEBP_BYTES", 10_000)
    images.write_animation(tmp_path / "small.webp", noise)
    assert b"VP8 " in (tmp_path / "small.webp").read_bytes()


def test_gif_is_smaller_and_keeps_the_background_exactly(tmp_path):
    frames = [np.where(frame == 1, 0.93, frame) for frame in moving_square()]
    images.write_animation(tmp_path / "a.webp", frames)
    rendered, decoded = frames_of(tmp_path / "a.gif")
    assert rendered.info["loop"] == 0
    assert rendered.size == (images.GIF_WIDTH, 30)
    assert len(decoded) == len(frames)
    for frame in decoded:
        assert frame[0, 0] * 255 == pytest.approx([237, 237, 237])


def test_a_large_animation_is_written_at_a_lower_quality(tmp_path, monkeypatch):
    noise = list(np.random.default_rng(0).uniform(size=(3, 64, 64, 3)))
    images.write_animation(tmp_path / "fine.webp", noise)
    size = (tmp_path / "fine.webp").stat().st_size
    monkeypatch.setattr(images, "WEBP_BYTES", size - 1)
    images.write_animation(tmp_path / "coarse.webp", noise)
    assert (tmp_path / "coarse.webp").stat().st_size < size


def test_equal_frames_give_equal_bytes(tmp_path):
    for name in ("a", "b"):
        images.write_animation(tmp_path / f"{name}.webp", moving_square())
    for suffix in (".webp", ".gif"):
        first, second = ((tmp_path / f"{name}{suffix}").read_bytes() for name in "ab")
        assert first == second


def test_an_encoded_image_is_a_file_of_its_format():
    data = images.encode(np.zeros((3, 5, 3)), "webp", lossless=True)
    rendered = Image.open(io.BytesIO(data))
    assert (rendered.format, rendered.size) == ("WEBP", (5, 3))


def test_an_exr_is_written_with_one_thread(tmp_path):
    """Mitsuba alone would wait for ever."""
    mi.set_variant("llvm_ad_rgb")
    pixels = np.random.default_rng(0).normal(size=(5, 7, 4)).astype(np.float32)
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        images.write_exr(tmp_path / "new" / "a.exr", mi.Bitmap(pixels))
        assert dr.thread_count() == 1
    finally:
        dr.set_thread_count(threads)
    np.testing.assert_array_equal(np.array(read_exr(tmp_path / "new" / "a.exr")), pixels)


# Reading, and notes on ignored content


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


def test_colours_of_16_bits_keep_the_upper_8_with_a_note(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 2**16, (4, 5, 3), np.uint16)
    mi.Bitmap(pixels).write(str(tmp_path / "a.png"))
    write_tiff16(tmp_path / "a.tif", pixels)
    (tmp_path / "a.ppm").write_bytes(b"P6 5 4 65535\n" + pixels.astype(">u2").tobytes())
    for name in ("a.png", "a.tif", "a.ppm"):
        read = images.read_pixels(tmp_path / name)
        assert np.abs(read.astype(int) - pixels / 257).max() <= 1 and read.dtype == np.uint8
        (what,) = images.unused_content(tmp_path / name)
        assert what == "of 16 bits a channel, of which 8 are used"
    Image.fromarray(pixels[:, :, 0]).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(images.read_pixels(tmp_path / "grey.png")[..., 1], pixels[..., 0])
    assert images.unused_content(tmp_path / "grey.png") == []


def test_transparent_colour_of_a_png_is_respected(tmp_path):
    pixels = np.zeros((2, 3, 3), np.uint8)
    pixels[0, 1] = 9, 8, 7
    for array, key in ((pixels, (9, 8, 7)), (pixels[:, :, 0], 9)):
        Image.fromarray(array).save(tmp_path / "a.png", transparency=key)
        header = images.read_header(tmp_path / "a.png")
        assert header.has_alpha and header.size == (3, 2)
        alpha = images.read_pixels(tmp_path / "a.png")[:, :, 3]
        np.testing.assert_array_equal(alpha == 0, pixels[:, :, 0] == 9)


def test_profiles_and_further_images_are_reported(tmp_path):
    grey = Image.new("RGB", (3, 2), (90, 90, 90))
    lab, srgb = (
        ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes() for name in ("LAB", "sRGB")
    )
    for options, said in (
        ({"icc_profile": srgb}, []),
        (
            {"icc_profile": lab},
            ["with the colour profile Lab identity built-in, which is not applied"],
        ),
        ({"icc_profile": b"broken"}, []),
    ):
        for name in ("a.jpg", "a.png", "a.tif"):
            grey.save(tmp_path / name, **options)
            assert images.unused_content(tmp_path / name) == said
    for name in ("a.tif", "a.gif", "a.webp", "b.png"):
        grey.save(tmp_path / name, save_all=True, append_images=[Image.new("RGB", (3, 2))])
        several = "with several images each, of which the first is used"
        assert images.unused_content(tmp_path / name) == [several]


@pytest.mark.parametrize("value", [-1, 70_000])
def test_whole_numbers_of_more_than_16_bits_are_refused(tmp_path, value):
    Image.fromarray(np.full((2, 3), value, np.int32)).save(tmp_path / "a.tif")
    with pytest.raises(UserError, match=f"must have values of 16 bits, 0 to 65535, got {value} to"):
        images.read_pixels(tmp_path / "a.tif")
