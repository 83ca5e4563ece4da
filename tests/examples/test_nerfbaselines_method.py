"""The method of nerfbaselines trains, renders and resumes; a stub stands for nerfbaselines."""

import ast
import importlib
import runpy
import sys
from dataclasses import dataclass, fields
from types import ModuleType
from unittest import mock

import numpy as np
import pytest
from conftest import REPOSITORY

from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.viewpoints import look_at
from drgs.core.errors import UserError

FOLDER = REPOSITORY / "examples" / "nerfbaselines"

CAMERA_MODELS = ("pinhole", "opencv", "opencv_fisheye", "full_opencv")  # by nerfbaselines' numbers

DISTORTION = (0.1, -0.02, 0.003, -0.004, 0.05, 0.06, 0.07, 0.08)  # k1 k2 p1 p2 k3 k4 k5 k6


@dataclass
class Cameras:
    """One camera as nerfbaselines has it, or several, along the first axis."""

    poses: np.ndarray
    intrinsics: np.ndarray
    image_sizes: np.ndarray
    camera_models: np.ndarray
    distortion_parameters: np.ndarray

    def __getitem__(self, index):
        return Cameras(*(getattr(self, field.name)[index] for field in fields(self)))

    def item(self):
        return self


def make_cameras(count, model="opencv", width=24, height=16):
    angles = 2 * np.pi * np.arange(count) / count
    centers = np.stack([3 * np.cos(angles), 3 * np.sin(angles), np.full(count, 1.0)], axis=1)
    poses = np.stack([look_at(center, (0, 0, 0), (0, 0, 1)) for center in centers])
    return Cameras(
        poses[:, :3].astype(np.float32),
        np.tile(np.float32([30, 31, 12.5, 8]), (count, 1)),
        np.tile(np.int32([width, height]), (count, 1)),
        np.full(count, CAMERA_MODELS.index(model)),
        np.tile(np.float32(DISTORTION), (count, 1)),
    )


def make_dataset(**changes):
    """A dataset of nerfbaselines: six views, and points without colours."""
    rng = np.random.default_rng(0)
    paths = [f"/data/images/{index}.png" for index in range(6)]
    return {
        "cameras": make_cameras(6),
        "images": list(rng.integers(0, 256, (6, 16, 24, 3), np.uint8)),
        "image_paths": paths,
        "image_paths_root": "/data/images",
        "sampling_masks": None,
        "points3D_xyz": rng.uniform(-0.5, 0.5, (40, 3)).astype(np.float32),
        "points3D_rgb": np.zeros((40, 3), np.uint8),
        "metadata": {"color_space": "srgb"},
        **changes,
    }


@pytest.fixture(scope="module")
def registered():
    """Specifications that were registered."""
    return []


@pytest.fixture(scope="module", autouse=True)
def method_module(registered):
    stub = ModuleType("nerfbaselines")
    stub.Method, stub.MethodInfo, stub.ModelInfo = object, dict, dict
    stub.camera_model_from_int = CAMERA_MODELS.__getitem__
    stub.register = registered.append
    with pytest.MonkeyPatch.context() as patch:  # of these names alone: drgs' modules stay
        patch.setitem(sys.modules, "nerfbaselines", stub)
        patch.syspath_prepend(FOLDER)
        patch.delitem(sys.modules, "drgs_method", raising=False)
        yield importlib.import_module("drgs_method")
    del sys.modules["drgs_method"]


def test_the_file_registers_itself_where_it_is_not_imported(registered, method_module):
    assert not registered  # by the import
    with mock.patch.object(sys, "path", [*sys.path]):
        runpy.run_path(str(FOLDER / "drgs_method.py"), run_name="drgs_method.py")
    (specification,) = registered
    module, name = specification["method_class"].split(":")
    assert (specification["id"], module) == ("drgs", "drgs_method")
    assert hasattr(method_module, name)


def test_names_that_the_check_imports_exist():
    """The method's own are imported by the fixture."""
    tree = ast.parse((FOLDER / "check.py").read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    found = {(n.module, a.name) for n in imports for a in n.names if n.module.startswith("drgs")}
    assert len(found) >= 6
    for module, name in found:
        assert hasattr(importlib.import_module(module), name), f"{module}.{name}"


def test_a_checkpoint_renders_the_same_and_continues_to_the_same_bytes(method_module, tmp_path):
    dataset, camera = make_dataset(), make_cameras(1)[0]
    overrides = {"iterations": "6", "densify.budget.gaussians": 60, "coarse": "[]"}
    method = method_module.DrgsMethod(train_dataset=dataset, config_overrides=overrides)
    assert method.get_info()["num_iterations"] == 6
    assert method.get_info()["loaded_step"] is None
    for step in range(4):
        method.train_iteration(step)
    image = method.render(camera)["color"]
    assert image.shape == (16, 24, 3)
    assert np.ptp(image) > 0
    method.save(tmp_path / "first")

    loaded = method_module.DrgsMethod(checkpoint=tmp_path / "first")
    assert loaded.get_info()["loaded_step"] == 4
    np.testing.assert_array_equal(loaded.render(camera)["color"], image)
    loaded.save(tmp_path / "again")
    resumed = method_module.DrgsMethod(checkpoint=tmp_path / "first", train_dataset=dataset)
    resumed.save(tmp_path / "resumed")
    for name in ("point_cloud_drgs.ply", "state.npz", "config.json"):
        expected = (tmp_path / "first" / name).read_bytes()
        assert (tmp_path / "again" / name).read_bytes() == expected
        assert (tmp_path / "resumed" / name).read_bytes() == expected

    for each in (method, resumed):
        for step in range(4, 6):
            each.train_iteration(step)
    np.testing.assert_array_equal(resumed.render(camera)["color"], method.render(camera)["color"])
    with pytest.raises(UserError, match="needs a training dataset"):
        loaded.train_iteration(4)


def test_lenses_have_the_coefficients_of_their_models(method_module):
    k1, k2, p1, p2, k3, k4, k5, k6 = map(float, np.float32(DISTORTION))
    whole = {"k3": k3, "k4": k4, "k5": k5, "k6": k6}
    expected = {
        "pinhole": None,
        "opencv": RadialTangential.from_coefficients(k1=k1, k2=k2, p1=p1, p2=p2),
        "full_opencv": RadialTangential.from_coefficients(k1=k1, k2=k2, p1=p1, p2=p2, **whole),
        "opencv_fisheye": Fisheye.from_coefficients(k1=k1, k2=k2, k3=k3, k4=k4),
    }
    for model, lens in expected.items():
        assert method_module.make_lens(make_cameras(1, model)[0]) == lens, model
    straight = make_cameras(1)[0]
    straight.distortion_parameters[:] = 0
    assert method_module.make_lens(straight) is None


def test_views_have_the_cameras_images_and_masks_of_the_dataset(method_module, tmp_path):
    rng = np.random.default_rng(1)
    images = list(rng.integers(0, 256, (6, 18, 25, 4), np.uint8))  # padded to the largest
    masks = list(rng.random((6, 18, 25)) > 0.5)
    metadata = {"color_space": "srgb", "background_color": np.uint8([255, 0, 51])}
    dataset = make_dataset(images=images, sampling_masks=masks, metadata=metadata)
    config = method_module.make_config(dataset, {})
    read = method_module.make_dataset(dataset, config, tmp_path)
    assert read.background == (1.0, 0.0, 0.2)
    assert [view.name for view in read.train] == [f"{index}.png" for index in range(6)]
    view, camera = read.train[2], dataset["cameras"][2]
    pixels = images[2][:16, :24] / 255
    expected = pixels[..., :3] * pixels[..., 3:] + (1 - pixels[..., 3:]) * read.background
    np.testing.assert_allclose(view.image, expected, atol=1e-6)  # of float32
    np.testing.assert_array_equal(view.mask, masks[2][:16, :24])
    np.testing.assert_array_equal(view.camera_to_world[:3], camera.poses)
    assert (view.fx, view.fy, view.cx, view.cy) == (30, 31, 12.5, 8)
    half = method_module.make_config(dataset, {"data.image_size": 12})
    small = method_module.make_dataset(dataset, half, tmp_path).train[2]
    assert np.shape(small.image) == (8, 12, 3)
    assert (small.fx, small.cy) == (15, 4)
    with pytest.raises(UserError, match="color space"):
        linear = make_dataset(metadata={"color_space": "linear"})
        method_module.make_dataset(linear, config, tmp_path)
