"""Photographs that are stored on their side, with EXIF's word for it."""

import json

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps
from support.datasets import load, look_at, refusal

from drgs.io.images import image_size, read_header, read_pixels, upright

STORED = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)


def save(path, orientation, pixels=STORED, **options):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(pixels).save(path, exif=exif, **options)


def write_dataset(folder, orientation, pixels=STORED, **size):
    """Two views of one image, whose camera has this size in px."""
    frames = []
    for i in range(2):
        save(folder / f"{i}.png", orientation, pixels)
        pose = look_at((4, i, 1), (0, 0, 0)).tolist()
        frames.append({"file_path": f"{i}.png", "transform_matrix": pose})
    meta = {"fl_x": 9.0, "frames": frames, **size}
    (folder / "transforms.json").write_text(json.dumps(meta))


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_rotated_like_pillow(tmp_path, orientation, suffix):
    path = tmp_path / f"a.{suffix}"
    save(path, orientation)
    found = read_header(path).orientation
    assert found == orientation
    with Image.open(path) as image:
        expected = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    np.testing.assert_array_equal(upright(read_pixels(path), found), expected)


@pytest.mark.parametrize("compression", [None, "tiff_lzw"])
def test_tiff_orientation_is_ignored_like_in_colmap(tmp_path, compression):
    pycolmap = pytest.importorskip("pycolmap")
    path = tmp_path / "a.tif"
    for orientation in range(1, 9):
        save(path, orientation, compression=compression)
        np.testing.assert_array_equal(read_pixels(path), STORED)
        np.testing.assert_array_equal(pycolmap.Bitmap.read(str(path), True).to_array(), STORED)
        assert image_size(path) == read_header(path).size == (8, 6)


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_camera_size_decides_whether_its_image_is_rotated(tmp_path, orientation):
    upright_size, stored_size = {"w": 6, "h": 8}, {"w": 8}
    for size, pixels in ((upright_size, upright(STORED, orientation)), (stored_size, STORED)):
        write_dataset(tmp_path, orientation, **size)
        view = load(tmp_path).train[0]
        assert (view.height, view.width) == pixels.shape[:2]
        np.testing.assert_array_equal(view.image, pixels.astype(np.float32) / np.float32(255))


SQUARE = np.zeros((6, 6, 3), np.uint8)


@pytest.mark.parametrize(
    ("orientation", "pixels", "size"),
    [
        (3, STORED, {"w": 8, "h": 6}),
        (6, STORED, {}),
        (6, SQUARE, {"w": 6, "h": 6}),
        (2, SQUARE, {}),
    ],
    ids=["half a turn", "no size", "a square", "mirrored"],
)
def test_ambiguous_orientation_is_refused(tmp_path, orientation, pixels, size):
    write_dataset(tmp_path, orientation, pixels, **size)
    message = f".png: has the EXIF orientation {orientation}, and w and h do not tell"
    assert message in refusal(tmp_path)
