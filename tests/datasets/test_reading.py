"""Each of several processes reads the photographs of its own views."""

import imageio.v3 as iio
import numpy as np
import pytest
from support.datasets import edit

from drgs.config.schema import DataConfig
from drgs.datasets import load_dataset
from drgs.datasets.images import without_images

RNG = np.random.default_rng(3)
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


def assert_is_placeholder(image):
    assert image.nbytes == 0
    with pytest.raises(RuntimeError, match="another process has its image"):
        np.asarray(image)


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
            assert image.shape == of_all.shape
            if view.name in ("02", "05"):
                assert_is_placeholder(image)
            else:
                np.testing.assert_array_equal(np.asarray(image), np.asarray(of_all))


def test_images_that_were_read_can_be_dropped(folder):
    view = load_dataset(DataConfig(path=folder, ignore_depth=True)).train[0]
    without = without_images(view)
    assert without.depth is None and without.mask.shape == view.mask.shape
    assert without.image.shape == view.image.shape
    assert_is_placeholder(without.image)
