"""A dataset reader that lives outside of drgs."""

import json

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support import small_capture as capture
from support import small_fits as fits
from support.datasets import views_by_name
from support.installed_examples import installed_examples

import drgs
from drgs.cameras.fisheye import Fisheye
from drgs.config.load import config_from
from drgs.core.errors import UserError
from drgs.datasets import load_dataset
from drgs.datasets.folders import find_reader
from drgs.datasets.reader import READERS, DatasetReader, Photographs, TransformsFrame
from drgs.io.images import write_png


@pytest.fixture(autouse=True)
def example():
    with installed_examples("numpy_poses") as modules:
        yield modules["numpy_poses"]


@pytest.fixture
def folder(tmp_path):
    """The photographs of a small capture in the layout of the example."""
    views = capture.make_dataset(train=5, test=0).train
    (tmp_path / "images").mkdir()
    for index, view in enumerate(views):
        write_png(tmp_path / "images" / f"{index}.png", np.asarray(view.image))
    np.save(tmp_path / "poses.npy", [view.camera_to_world for view in views])
    camera = {name: getattr(views[0], name) for name in ("fx", "fy", "cx", "cy")}
    (tmp_path / "intrinsics.json").write_text(json.dumps(camera))
    return tmp_path, views


@pytest.mark.parametrize("kind", ["auto", "numpy_poses"])
def test_cameras_and_images_come_from_the_folder(folder, kind):
    path, views = folder
    found = views_by_name(load_dataset(path, type=kind, test_every=4))
    assert sorted(found) == [str(index) for index in range(5)]
    for index, view in enumerate(views):
        own = found[str(index)]
        np.testing.assert_allclose(own.camera_to_world, view.camera_to_world, atol=1e-12)
        assert (own.fx, own.fy, own.cx, own.cy) == (view.fx, view.fy, view.cx, view.cy)
        np.testing.assert_allclose(np.asarray(own.image), np.asarray(view.image), atol=0.5 / 255)


def test_configuration_sets_the_reader_section(folder):
    path, views = folder
    mi.set_variant("llvm_ad_rgb")
    values = fits.config_of().model_dump() | {"data": {"path": str(path)}, "iterations": 2}
    values |= {"init": {"num_points": 30}, "numpy_poses": {"unit": 2.0}}
    trainer = drgs.train(config_from(values, "x.yml")).trainer
    centers = {view.name: view.center for view in trainer.dataset.train}
    expected = {str(index): 2 * view.center for index, view in enumerate(views)}
    for name, center in centers.items():
        np.testing.assert_allclose(center, expected[name], rtol=1e-6)


def test_errors_of_the_reader_are_reported(folder):
    path, _ = folder
    (path / "images" / "9.png").write_bytes(b"")
    with pytest.raises(UserError, match=r"poses\.npy: must have a pose for each of the 6 files"):
        load_dataset(path)
    poses = np.load(path / "poses.npy")
    (path / "images" / "9.png").unlink()
    poses[2, 0, 0] = np.nan
    np.save(path / "poses.npy", poses)
    with pytest.raises(UserError, match=r"poses\.npy: frame 2: "):
        load_dataset(path)


def test_shipped_readers_come_first_and_unknown_ones_are_refused(folder, tmp_path):
    path, _ = folder
    with pytest.raises(UserError, match=r"data\.type must be one of 'auto', .*'numpy_poses'; did"):
        load_dataset(path, type="numpy_pose")
    (path / "transforms.json").write_text("{}")
    assert find_reader(config_from({"data": {"path": str(path)}}, "x").data)[0] == "nerfstudio"


class LensAndMask(DatasetReader):
    """The example's cameras behind a fisheye, with a mask and depth of the first photograph."""

    def photographs(self, config):
        frames, (mask, depth) = [], (config.path / name for name in ("mask.png", "depth.npy"))
        for index, pose in enumerate(np.load(config.path / "poses.npy")):
            image = config.path / "images" / f"{index}.png"
            lens = {"camera_model": "OPENCV_FISHEYE", "k1": 0.1}
            files = {} if index else {"mask": mask, "depth": depth}
            frames.append(
                TransformsFrame.from_camera(
                    config.path, index, image, pose, (30.0, 31.0), None, lens, files
                )
            )
        return Photographs("outside", config.path, frames)


def test_a_reader_gives_lenses_masks_and_depth(folder):
    path, views = folder
    shape = np.asarray(views[0].image).shape[:2]
    mask = np.arange(np.prod(shape)).reshape(shape) % 3 > 0
    Image.fromarray(np.uint8(255 * mask)).save(path / "mask.png")
    np.save(path / "depth.npy", 2.0 + mask)
    READERS.register("outside")(LensAndMask)
    dataset = load_dataset(path, type="outside", test_every=4)
    found = views_by_name(dataset)
    assert all(v.lens == Fisheye.from_coefficients(k1=0.1) for v in found.values())
    np.testing.assert_array_equal(found["0"].mask, mask)
    np.testing.assert_array_equal(found["0"].depth, 2.0 + mask)
    assert found["1"].mask is None and found["1"].depth is None
    assert "; masks of 1 of 5 photographs; depth in units of 1" in dataset.description
    settings = {"ignore_masks": True, "ignore_depth": True}
    plain = load_dataset(path, type="outside", test_every=4, **settings)
    assert views_by_name(plain)["0"].mask is None and views_by_name(plain)["0"].depth is None
    assert "masks (mask_path) ignored; depth (depth_file_path) ignored" in plain.description
