"""Each of several processes reads the photographs of its own views."""

import json

import imageio.v3 as iio
import numpy as np
import pytest
from support.datasets import look_at

from drgs.config.schema import DataConfig
from drgs.datasets import load_dataset
from drgs.datasets.images import without_images

RNG = np.random.default_rng(3)
SIZE = 12, 8
CAMERA = {"fl_x": 10.0, "w": SIZE[0], "h": SIZE[1]}


@pytest.fixture
def folder(tmp_path):
    """Six photographs with masks and depths, in nerfstudio's layout."""
    frames = []
    for index in range(6):
        shape = (SIZE[1], SIZE[0])
        iio.imwrite(tmp_path / f"{index}.png", RNG.integers(0, 256, (*shape, 4), np.uint8))
        iio.imwrite(tmp_path / f"mask{index}.png", np.full(shape, 255, np.uint8))
        np.save(tmp_path / f"depth{index}.npy", RNG.random(shape))
        frame = {"file_path": f"{index}.png", "mask_path": f"mask{index}.png"}
        frame["depth_file_path"] = f"depth{index}.npy"
        frame["transform_matrix"] = look_at((3, index, 1), (0, 0, 0)).tolist()
        frames.append(frame)
    (tmp_path / "transforms.json").write_text(json.dumps({**CAMERA, "frames": frames}))
    return tmp_path


def test_images_of_other_ranks_are_not_read(folder):
    """Pixels are damaged behind the headers, so all but the images is known."""
    config = DataConfig(path=folder, image_size=6)
    every = load_dataset(config)
    for name in ("2.png", "5.png"):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])
    for index in (2, 5):
        (folder / f"mask{index}.png").write_bytes(b"")
        (folder / f"depth{index}.npy").write_bytes(b"")
    some = load_dataset(config, keeps=lambda name: name[0] not in "25")
    assert [v.name for v in some.train] == [v.name for v in every.train]
    for view, expected in zip(some.train, every.train, strict=True):
        for name in ("fx", "fy", "cx", "cy", "width", "height", "files"):
            assert getattr(view, name) == getattr(expected, name)
        for name in ("image", "alpha", "mask", "depth"):
            rendered, of_all = getattr(view, name), getattr(expected, name)
            assert rendered.shape == of_all.shape
            if view.name[0] not in "25":
                np.testing.assert_array_equal(np.asarray(rendered), np.asarray(of_all))
                continue
            assert rendered.nbytes == 0
            with pytest.raises(RuntimeError, match="another process has its image"):
                np.asarray(rendered)


def test_images_of_other_ranks_can_be_dropped(folder):
    view = load_dataset(DataConfig(path=folder, ignore_depth=True)).train[0]
    without = without_images(view)
    assert without.depth is None and without.mask.shape == view.mask.shape
    assert without.image.shape == view.image.shape and without.image.nbytes == 0
    with pytest.raises(RuntimeError, match="another process has its image"):
        np.asarray(without.image)
