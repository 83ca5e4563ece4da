import io

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.openexr import read_exr

from drgs.io import pictures


def moving_square(count=6, width=400, height=40):
    frames = np.ones((count, height, width, 3))
    for index, frame in enumerate(frames):
        frame[10:30, 20 * index : 20 * index + 40] = [0.8, 0.1, 0.2]
    return list(frames)


def frames_of(path):
    picture = Image.open(path)
    frames = []
    for index in range(picture.n_frames):
        picture.seek(index)
        frames.append(np.asarray(picture.convert("RGB")) / 255)
    return picture, frames


def test_a_png_holds_the_picture_rounded_and_clamped(tmp_path):
    image = np.array([[[-0.5, 0.0, 0.5019], [0.999, 1.0, 7.0]]])
    pictures.write_png(tmp_path / "new" / "a.png", image)
    assert np.asarray(Image.open(tmp_path / "new" / "a.png")).tolist() == [
        [[0, 0, 128], [255, 255, 255]]
    ]


def test_an_animation_loops_and_holds_every_frame(tmp_path):
    frames = moving_square()
    pictures.write_animation(tmp_path / "a.webp", frames)
    picture, decoded = frames_of(tmp_path / "a.webp")
    assert picture.info["loop"] == 0
    assert len(decoded) == len(frames)
    for frame, expected in zip(decoded, frames, strict=True):
        assert np.abs(frame - expected).mean() < 0.02  # lossy


def test_the_gif_beside_it_is_smaller_and_keeps_the_background_exactly(tmp_path):
    frames = [np.where(frame == 1, 0.93, frame) for frame in moving_square()]
    pictures.write_animation(tmp_path / "a.webp", frames)
    picture, decoded = frames_of(tmp_path / "a.gif")
    assert picture.info["loop"] == 0
    assert picture.size == (pictures.GIF_WIDTH, 30)
    assert len(decoded) == len(frames)
    for frame in decoded:
        assert frame[0, 0] * 255 == pytest.approx([237, 237, 237])


def test_a_large_animation_is_written_at_a_lower_quality(tmp_path, monkeypatch):
    noise = list(np.random.default_rng(0).uniform(size=(3, 64, 64, 3)))
    pictures.write_animation(tmp_path / "fine.webp", noise)
    size = (tmp_path / "fine.webp").stat().st_size
    monkeypatch.setattr(pictures, "WEBP_BYTES", size - 1)
    pictures.write_animation(tmp_path / "coarse.webp", noise)
    assert (tmp_path / "coarse.webp").stat().st_size < size


def test_equal_frames_give_equal_bytes(tmp_path):
    for name in ("a", "b"):
        pictures.write_animation(tmp_path / f"{name}.webp", moving_square())
    for suffix in (".webp", ".gif"):
        first, second = ((tmp_path / f"{name}{suffix}").read_bytes() for name in "ab")
        assert first == second


def test_an_encoded_picture_is_a_file_of_its_format():
    data = pictures.encode(np.zeros((3, 5, 3)), "webp", lossless=True)
    picture = Image.open(io.BytesIO(data))
    assert (picture.format, picture.size) == ("WEBP", (5, 3))


def test_an_exr_is_written_with_one_thread(tmp_path):
    """Mitsuba alone would wait for ever."""
    mi.set_variant("llvm_ad_rgb")
    pixels = np.random.default_rng(0).normal(size=(5, 7, 4)).astype(np.float32)
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        pictures.write_exr(tmp_path / "new" / "a.exr", mi.Bitmap(pixels))
        assert dr.thread_count() == 1
    finally:
        dr.set_thread_count(threads)
    np.testing.assert_array_equal(np.array(read_exr(tmp_path / "new" / "a.exr")), pixels)
