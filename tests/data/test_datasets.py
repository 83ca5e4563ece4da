import json
import math
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.config.schema import DataConfig, FitConfig
from drgs.core.errors import UserError
from drgs.data import initial_gaussians, load_dataset
from drgs.data.images import downscale, smaller_view
from drgs.data.initial import focus_of, mean_squared_neighbour_distance, points_in_view
from drgs.data.types import Dataset, View


def look_at(center, target, up=(0, 0, 1)):
    """(4, 4) camera to world in OpenGL axes (x right, y up, z backward)."""
    center, target = np.asarray(center, float), np.asarray(target, float)
    back = (center - target) / np.linalg.norm(center - target)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, center], axis=1)
    return matrix


def view_at(center, target, width=40, height=30):
    matrix = look_at(center, target)
    matrix[:3, 1:3] *= -1
    image = np.zeros((height, width, 3), np.float32)
    return View("v", image, matrix, width, width, width / 2, height / 2, width, height)


def dataset_of(views, half_extent=None):
    return Dataset(tuple(views), tuple(views), "test", (1.0, 1.0, 1.0), half_extent, "")


CENTERS = [(4, 0, 0), (0, 4, 1), (-3, 0, 2)]


@pytest.fixture
def blender(tmp_path):
    """A NeRF-synthetic folder of 3 random 6x4 RGBA views a split; returns (folder, images)."""
    rng = np.random.default_rng(0)
    images = {}
    for split in ("train", "val"):
        (tmp_path / split).mkdir()
        frames = []
        for i, center in enumerate(CENTERS):
            images[split, i] = rng.integers(0, 256, (4, 6, 4), np.uint8)
            iio.imwrite(tmp_path / split / f"r_{i}.png", images[split, i])
            matrix = look_at(center, (0, 0, 0)).tolist()
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix})
        meta = {"camera_angle_x": 0.8, "frames": frames}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(meta))
    return tmp_path, images


@pytest.fixture
def photographs(tmp_path):
    """A nerfstudio folder of 10 grey 8x6 photographs, frames in reverse order of names."""
    (tmp_path / "images").mkdir()
    frames = []
    for i in reversed(range(10)):
        iio.imwrite(tmp_path / "images" / f"{i:02d}.png", np.full((6, 8, 3), 20 * i, np.uint8))
        center = (4 * math.cos(i), 4 * math.sin(i), 1)
        matrix = look_at(center, (0, 0, 0)).tolist()
        frames.append({"file_path": f"images/{i:02d}.png", "transform_matrix": matrix})
    meta = {"fl_x": 9.0, "fl_y": 8.0, "cx": 3.5, "cy": 3.25, "w": 8, "h": 6, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    return tmp_path


def edit(path, change):
    """Apply ``change`` to the parsed JSON of ``path``."""
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def load(folder, **options):
    return load_dataset(DataConfig(path=folder, **options))


def refusal(folder, **options):
    with pytest.raises(UserError) as error:
        load(folder, **options)
    return str(error.value)


# NeRF-synthetic


def test_rgba_is_composited_over_the_background_in_display_space(blender):
    folder, images = blender
    for name, color in (("white", 1.0), ("black", 0.0)):
        view = load(folder, background=name).train[1]
        pixels = images["train", 1].astype(np.float64) / 255
        expected = pixels[..., :3] * pixels[..., 3:] + color * (1 - pixels[..., 3:])
        # Four float32 roundings of numbers <= 1.
        np.testing.assert_allclose(view.image, expected, atol=4 * 6e-8)
        assert view.image.dtype == np.float32


def test_a_background_colour_is_used_channel_by_channel(blender):
    folder, images = blender
    dataset = load(folder, background=(0.0, 0.5, 1.0))
    assert dataset.background == (0.0, 0.5, 1.0)
    alpha = images["train", 0][..., 3] / 255
    expected = images["train", 0][..., 1] / 255 * alpha + 0.5 * (1 - alpha)
    np.testing.assert_allclose(dataset.train[0].image[..., 1], expected, atol=4 * 6e-8)


def test_the_horizontal_angle_gives_the_focal_length(blender):
    view = load(blender[0]).train[0]
    assert (view.width, view.height, view.cx, view.cy) == (6, 4, 3, 2)
    assert view.fx == view.fy
    assert 2 * math.atan(view.width / 2 / view.fx) == pytest.approx(0.8, abs=1e-12)


def test_cameras_look_at_the_origin_with_y_down(blender):
    for view, center in zip(load(blender[0]).train, CENTERS, strict=True):
        assert view.name.startswith("r_")
        np.testing.assert_allclose(view.center, center)
        # In OpenCV axes the origin lies straight ahead, and world up is at negative y.
        rotation = view.camera_to_world[:3, :3]
        ahead = rotation.T @ (np.zeros(3) - center)
        np.testing.assert_allclose(ahead, [0, 0, np.linalg.norm(center)], atol=1e-12)
        assert (rotation.T @ [0, 0, 1])[1] < 0
        assert np.linalg.det(rotation) == pytest.approx(1)


def test_val_is_measured_on_where_there_is_no_test_split(blender):
    dataset = load(blender[0])
    assert dataset.test_split == "val"
    assert "measured on 3 views of split val" in dataset.description


def test_a_test_split_is_preferred_and_test_split_names_another(blender):
    folder, images = blender
    (folder / "transforms_test.json").write_text((folder / "transforms_train.json").read_text())
    assert load(folder).test_split == "test"
    dataset = load(folder, test_split="val", background="black")
    assert dataset.test_split == "val"
    pixels = images["val", 2] / 255
    np.testing.assert_allclose(
        dataset.test[2].image, pixels[..., :3] * pixels[..., 3:], atol=4 * 6e-8
    )


def test_a_suffix_in_file_path_is_accepted(blender):
    edit(
        blender[0] / "transforms_train.json",
        lambda m: m["frames"][0].update(file_path="train/r_0.png"),
    )
    assert load(blender[0]).train[0].name == "r_0"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(frames=[]), "frames is empty; there must be at least one view"),
        (lambda m: m.update(frames=3), "frames must be a list of objects, got 3"),
        (
            lambda m: m.pop("frames"),
            "frames is missing; it must be a list of objects, one per view",
        ),
        (lambda m: m["frames"].append(7), "frames[3] must be an object, got 7"),
        (lambda m: m.pop("camera_angle_x"), "camera_angle_x must be a finite number, got null"),
        (lambda m: m.update(camera_angle_x=0), "camera_angle_x must be > 0, got 0"),
        (
            lambda m: m.update(camera_angle_x=1e-5),
            "camera_angle_x must be between 0.0001 and 3.102 (radians), got 1e-05",
        ),
        (
            lambda m: m.update(camera_angle_x=10**400),
            "camera_angle_x must be a finite number, got an integer beyond it",
        ),
        (lambda m: m.update(camera_angle_x=40), "camera_angle_x must be < pi (radians), got 40"),
        (
            lambda m: m["frames"][1].pop("file_path"),
            "frames[1].file_path must be text, got null",
        ),
        (
            lambda m: m["frames"][1].pop("transform_matrix"),
            "frames[1].transform_matrix is missing",
        ),
        (
            lambda m: m["frames"][1].update(transform_matrix=[[1, 2], [3, 4]]),
            "frames[1].transform_matrix must be 4 x 4 numbers, got shape (2, 2)",
        ),
        (
            lambda m: m["frames"][1].update(transform_matrix=[[1, 2], [3]]),
            "frames[1].transform_matrix must be 4 x 4 numbers, got [[1, 2], [3]]",
        ),
        (
            lambda m: m["frames"][1].update(transform_matrix=np.eye(4)[:3].tolist()),
            "frames[1].transform_matrix must be 4 x 4 numbers, got shape (3, 4)",
        ),
        (
            lambda m: m["frames"][1].update(transform_matrix=[["1"] * 4] * 4),
            "frames[1].transform_matrix must be 4 x 4 numbers, got "
            '[["1", "1", "1", "1"], ["1", "1", "1", "1"], ["1", "1", "...',
        ),
        (
            lambda m: m["frames"][1]["transform_matrix"][2].__setitem__(3, -2e9),
            "frames[1].transform_matrix[2][3] must be at most 1e+09 in size, got -2e+09; scale the "
            "scene down",
        ),
        (
            lambda m: m["frames"][2]["transform_matrix"][0].__setitem__(3, math.nan),
            "frames[2].transform_matrix[0][3] must be finite, got nan",
        ),
        (
            lambda m: m["frames"][0].update(transform_matrix=np.diag([2, 2, 2, 1]).tolist()),
            "frames[0].transform_matrix must be rigid (rotation and translation) to 0.0001: "
            "|R R^T - I| is 3, det R is 8",
        ),
        (
            lambda m: m["frames"][0].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()),
            "frames[0].transform_matrix must be rigid (rotation and translation) to 0.0001: "
            "|R R^T - I| is 0, det R is -1",
        ),
        (
            lambda m: m["frames"][0].update(transform_matrix=np.diag([1, 1, 1, 2]).tolist()),
            "frames[0].transform_matrix must end in the row 0 0 0 1, got [0.0, 0.0, 0.0, 2.0]",
        ),
    ],
)
def test_a_wrong_transforms_file_is_refused_with_file_and_key(blender, change, message):
    path = blender[0] / "transforms_train.json"
    edit(path, change)
    assert refusal(blender[0]) == f"{path}: {message}"


@pytest.mark.parametrize(("shear", "is_accepted"), [(0.9e-4, True), (1.1e-4, False)])
def test_a_matrix_is_rigid_to_1e_4(blender, shear, is_accepted):
    # R = [[1, shear, 0], [0, 1, 0], [0, 0, 1]] has |R R^T - I| = shear (and its square).
    matrix = np.eye(4)
    matrix[0, 1] = shear
    path = blender[0] / "transforms_train.json"
    edit(path, lambda m: m["frames"][0].update(transform_matrix=matrix.tolist()))
    if is_accepted:
        load(blender[0])
    else:
        assert "must be rigid (rotation and translation) to 0.0001" in refusal(blender[0])


def test_a_picture_without_alpha_is_refused(blender):
    path = blender[0] / "val" / "r_2.png"
    iio.imwrite(path, np.zeros((4, 6, 3), np.uint8))
    assert refusal(blender[0]) == (
        f"{path}: must have an alpha channel (RGBA), as the NeRF-synthetic layout promises, got "
        "an opaque image; save it with alpha, or use the nerfstudio layout (transforms.json)"
    )


def test_a_picture_of_another_size_is_refused(blender):
    path = blender[0] / "train" / "r_2.png"
    iio.imwrite(path, np.zeros((6, 4, 4), np.uint8))
    assert refusal(blender[0]) == (
        f"{path}: must be 6 x 4 px, as r_0.png is, got 4 x 6; scale the images of a split to one "
        "size"
    )


def test_a_missing_image_is_named(blender):
    folder = blender[0]
    (folder / "train" / "r_1.png").unlink()
    assert refusal(folder) == (
        f"{folder / 'transforms_train.json'}: frames[1].file_path: there is no image "
        f"{folder / 'train' / 'r_1'} (or with .png added)"
    )


def test_a_broken_image_is_named(blender):
    broken = blender[0] / "train" / "r_1.png"
    broken.write_bytes(b"not a picture")
    assert refusal(blender[0]).startswith(f"{broken}: cannot read the image: ")


def test_malformed_json_names_file_and_line(blender):
    path = blender[0] / "transforms_train.json"
    path.write_text('{"frames": [\n')
    assert refusal(blender[0]).startswith(f"{path}: not valid JSON: Expecting value: line 2")


def test_no_test_views_is_an_error(blender):
    (blender[0] / "transforms_val.json").unlink()
    assert refusal(blender[0]) == (
        f"{blender[0]}: there are no test views: neither transforms_test.json nor "
        "transforms_val.json is there; data.test_split: train measures on the training views"
    )


def test_a_missing_split_is_an_error(blender):
    assert refusal(blender[0], test_split="test") == (
        f"{blender[0] / 'transforms_test.json'}: cannot read the file: No such file or directory"
    )


# nerfstudio


def test_every_eighth_view_by_file_name_is_test(photographs):
    dataset = load(photographs)
    assert [view.name for view in dataset.test] == ["00", "08"]
    assert [view.name for view in dataset.train] == ["01", "02", "03", "04", "05", "06", "07", "09"]
    assert dataset.test_split == "test"
    # Each view kept its own picture and its own camera.
    for view in (*dataset.train, *dataset.test):
        i = int(view.name)
        np.testing.assert_allclose(view.image, 20 * i / 255, rtol=1e-6)
        np.testing.assert_allclose(view.center, (4 * math.cos(i), 4 * math.sin(i), 1))


def test_test_every_chooses_the_test_views(photographs):
    assert [view.name for view in load(photographs, test_every=5).test] == ["00", "05"]


def test_intrinsics_are_read(photographs):
    view = load(photographs).train[0]
    np.testing.assert_array_equal(view.K, [[9, 0, 3.5], [0, 8, 3.25], [0, 0, 1]])
    assert (view.width, view.height) == (8, 6)


def test_a_frame_overrides_the_intrinsics_at_the_top(photographs):
    edit(photographs / "transforms.json", lambda m: m["frames"][8].update(fl_x=11.0, cx=4.5))
    view = next(view for view in load(photographs).train if view.name == "01")
    np.testing.assert_array_equal(view.K, [[11, 0, 4.5], [0, 8, 3.25], [0, 0, 1]])


def test_angles_replace_missing_focal_lengths(photographs):
    def change(meta):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del meta[key]
        meta.update(camera_angle_x=0.8)

    edit(photographs / "transforms.json", change)
    view = load(photographs).train[0]
    assert view.fx == view.fy == pytest.approx(4 / math.tan(0.4))
    assert (view.cx, view.cy) == (4, 3)
    edit(photographs / "transforms.json", lambda m: m.update(camera_angle_y=0.5))
    assert load(photographs).train[0].fy == pytest.approx(3 / math.tan(0.25))


@pytest.mark.parametrize("place", ["top", "frame"])
def test_lens_distortion_is_read(photographs, place):
    path = photographs / "transforms.json"
    coefficients = {"k1": 0.1, "k2": 0.0, "p1": -0.02}
    # Frames are in reverse order of their names: the first is the last view.
    edit(path, lambda m: (m if place == "top" else m["frames"][0]).update(coefficients))
    dataset = load(photographs)
    assert dataset.train[-1].lens == RadialTangential.of(k1=0.1, p1=-0.02)
    assert dataset.train[0].lens == (dataset.train[-1].lens if place == "top" else None)
    assert dataset.description.endswith("; lens opencv (k1, p1, p2)")
    dataset = load(photographs, ignore_distortion=True)
    assert all(view.lens is None for view in dataset.train)
    assert dataset.description.endswith("; lens opencv (k1, p1, p2) ignored")


@pytest.mark.parametrize("says", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_a_fisheye_lens_is_read(photographs, says):
    edit(photographs / "transforms.json", lambda m: m.update(k1=0.1, k4=-0.01, **says))
    dataset = load(photographs)
    assert dataset.train[0].lens == Fisheye.of(k1=0.1, k4=-0.01)
    assert dataset.description.endswith("; lens fisheye (k1, k2, k3, k4)")


@pytest.mark.parametrize("says", [{"camera_model": "FULL_OPENCV"}, {"k5": 0.125}])
def test_a_fourth_coefficient_that_is_opencvs_is_read(photographs, says):
    edit(photographs / "transforms.json", lambda m: m.update(k1=0.1, k4=0.25, **says))
    given = {k: v for k, v in says.items() if k == "k5"}
    assert load(photographs).train[0].lens == RadialTangential.of(k1=0.1, k4=0.25, **given)


def test_coefficients_do_not_depend_on_the_size_of_the_picture(photographs):
    edit(photographs / "transforms.json", lambda m: m.update(k1=0.1))
    view = load(photographs, image_size=4).train[0]
    assert view.lens == RadialTangential.of(k1=0.1) and view.fx == 4.5


def test_distortion_coefficients_of_zero_are_accepted(photographs):
    edit(photographs / "transforms.json", lambda m: m.update(k1=0, k2=0.0, p1=0))
    dataset = load(photographs)
    assert dataset.train[0].lens is None and "lens" not in dataset.description


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("fl_x"), "fl_x is missing, and there is no camera_angle_x either"),
        (lambda m: m.update(fl_y=-1), "fl_y must be > 0, got -1"),
        (
            lambda m: m.update(fl_x=1e-3),
            "fl_x must be between 0.08 and 80000 px for 8 px, got 0.001",
        ),
        (lambda m: m.update(cy=-700), "cy must be within 600 px of the picture, got -700"),
        (lambda m: m.update(cx="4"), 'cx must be a finite number, got "4"'),
        (
            lambda m: m.update(camera_model="EQUIRECTANGULAR"),
            "camera_model must be one of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, "
            "FULL_OPENCV, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, OPENCV_FISHEYE, got "
            "EQUIRECTANGULAR",
        ),
        (
            lambda m: m.update(is_fisheye=True, p1=0.5),
            "p1: a fisheye lens has the coefficients k1, k2, k3, k4, got p1 = 0.5",
        ),
        (
            lambda m: m.update(camera_model="OPENCV", k1=0.1, k4=0.25),
            "k4 is read as OpenCV's, of a denominator 1 + k4 r^2, where camera_model is "
            "FULL_OPENCV; nerfstudio's, of a term k4 r^8, is not supported. Got k4 = 0.25 and "
            "camera_model OPENCV: set camera_model, or calibrate without k4",
        ),
    ],
)
def test_wrong_intrinsics_are_refused_with_file_and_key(photographs, change, message):
    path = photographs / "transforms.json"
    edit(path, change)
    assert refusal(photographs) == f"{path}: {message}"


def test_a_frames_own_wrong_value_is_named_with_the_frame(photographs):
    path = photographs / "transforms.json"
    edit(path, lambda m: m["frames"][4].update(fl_x=0))
    assert refusal(photographs) == f"{path}: frames[4].fl_x must be > 0, got 0"


def test_an_image_size_that_disagrees_is_refused(photographs):
    path = photographs / "transforms.json"
    edit(path, lambda m: m.update(w=16))
    assert refusal(photographs) == (
        f"{path}: w must be the image's size, 8 px ({photographs}/images/00.png), "
        "got 16; scale the intrinsics or the images"
    )


def test_a_split_name_of_the_other_layout_is_refused(photographs):
    message = refusal(photographs, test_split="val")
    assert message.endswith(
        "this layout has no split val; leave data.test_split out "
        "(data.test_every chooses the test views)"
    )


def test_one_view_is_too_few(photographs):
    edit(photographs / "transforms.json", lambda m: m.update(frames=m["frames"][:1]))
    assert refusal(photographs).endswith("at least 2 views are needed, one of them to test; got 1")


def test_equal_file_names_in_two_folders_stay_apart(photographs):
    (photographs / "more").mkdir()
    iio.imwrite(photographs / "more" / "01.png", np.zeros((6, 8, 3), np.uint8))
    edit(
        photographs / "transforms.json",
        lambda m: m["frames"].append(dict(m["frames"][0], file_path="more/01.png")),
    )
    names = [view.name for view in load(photographs).train]
    assert {"images_01", "more_01"} <= set(names)


# What a frame may have besides its photograph


def frame_of(meta, name="01.png"):
    """The frame of a photograph; frames are in another order than names."""
    return next(f for f in meta["frames"] if f["file_path"].endswith(name))


def give(folder, name="01.png", **values):
    """Values of one photograph's frame."""
    edit(folder / "transforms.json", lambda m: frame_of(m, name).update(values))


def view_named(dataset, name="01"):
    return next(view for view in (*dataset.train, *dataset.test) if view.name == name)


def index_of(folder, name="01.png"):
    """Of a photograph's frame in the file, as errors name it."""
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    return next(k for k, f in enumerate(frames) if f["file_path"].endswith(name))


GREY_MASK = np.array([[0, 127, 128, 255, 1, 254, 200, 100]] * 6, np.uint8)


@pytest.mark.parametrize(
    "pixels",
    [GREY_MASK, np.repeat(GREY_MASK[..., None], 3, axis=2), GREY_MASK.astype(np.uint16) * 257],
    ids=["grey", "rgb", "grey16"],
)
def test_a_mask_counts_pixels_brighter_than_half(photographs, pixels):
    iio.imwrite(photographs / "mask.png", pixels)
    give(photographs, mask_path="mask.png")
    give(photographs, "08.png", mask_path="mask")  # of a test view; .png is added
    dataset = load(photographs)
    expected = np.array([[0, 0, 1, 1, 0, 1, 1, 0]] * 6)
    for name in ("01", "08"):
        mask = view_named(dataset, name).mask
        assert mask.dtype == np.float32
        np.testing.assert_array_equal(mask, expected)
    assert view_named(dataset, "02").mask is None
    assert "ignored" not in dataset.description


def test_a_mask_of_one_bit_is_read(photographs):
    kept = np.random.default_rng(0).integers(0, 2, (6, 8)).astype(bool)
    picture = Image.fromarray(kept)
    assert picture.mode == "1"
    picture.save(photographs / "mask.png")
    give(photographs, mask_path="mask.png")
    np.testing.assert_array_equal(view_named(load(photographs)).mask, kept)


def test_masks_may_be_ignored(photographs):
    iio.imwrite(photographs / "mask.png", GREY_MASK)
    give(photographs, mask_path="mask.png")
    dataset = load(photographs, ignore_masks=True)
    assert all(view.mask is None for view in dataset.train)
    assert dataset.description.endswith("; masks (mask_path) ignored")


def test_a_smaller_mask_counts_pixels_all_of_which_count(photographs):
    mask = np.full((6, 8), 255, np.uint8)
    mask[0, 0], mask[3, 5] = 0, 0
    iio.imwrite(photographs / "mask.png", mask)
    give(photographs, mask_path="mask.png")
    view = view_named(load(photographs, image_size=4))
    expected = np.ones((3, 4))
    expected[0, 0] = expected[1, 2] = 0
    np.testing.assert_array_equal(view.mask, expected)


@pytest.mark.parametrize("kind", ["mask", "depth"])
def test_a_picture_of_another_size_than_the_photograph_is_refused(photographs, kind):
    key = {"mask": "mask_path", "depth": "depth_file_path"}[kind]
    iio.imwrite(photographs / "other.png", np.ones((4, 8), np.uint16))
    give(photographs, **{key: "other.png"})
    assert refusal(photographs) == (
        f"{photographs / 'other.png'}: must be 8 x 6 px, as the photograph is, got 8 x 4; "
        "resize it, or leave it out of the frame"
    )


@pytest.mark.parametrize("key", ["mask_path", "depth_file_path"])
def test_a_missing_mask_or_depth_is_named(photographs, key):
    give(photographs, **{key: "nowhere.png"})
    where = f"{photographs / 'transforms.json'}: frames[{index_of(photographs)}].{key}"
    assert refusal(photographs) == (
        f"{where}: there is no image {photographs / 'nowhere.png'} (or with .png added)"
    )
    give(photographs, **{key: 3})
    assert refusal(photographs) == f"{where} must be text, got 3"


@pytest.mark.parametrize("name", ["01.png", "08.png"], ids=["train", "test"])
def test_a_mask_that_leaves_out_every_pixel_is_refused(photographs, name):
    iio.imwrite(photographs / "mask.png", np.full((6, 8), 127, np.uint8))
    give(photographs, name, mask_path="mask.png")
    assert refusal(photographs) == (
        f"{photographs / 'mask.png'}: must leave pixels that count (brighter than half), got a "
        "mask without any; remove the view from its file, or set data.ignore_masks"
    )
    assert view_named(load(photographs, ignore_masks=True)).mask is None


def test_a_mask_that_leaves_out_every_pixel_of_a_smaller_picture_is_refused(photographs):
    """One of each block of 2 x 2 pixels: none of the larger pixels counts as a whole."""
    mask = np.full((6, 8), 255, np.uint8)
    mask[::2, ::2] = 0
    iio.imwrite(photographs / "mask.png", mask)
    give(photographs, mask_path="mask.png")
    assert view_named(load(photographs)).mask.mean() == 0.75
    assert refusal(photographs, image_size=4) == (
        f"{photographs / 'mask.png'}: must leave pixels that count (brighter than half), got a "
        "mask without any at data.image_size 4; set a larger one, remove the view from its file, "
        "or set data.ignore_masks"
    )


def test_a_broken_mask_is_named(photographs):
    (photographs / "mask.png").write_bytes(b"no picture")
    give(photographs, mask_path="mask.png")
    assert refusal(photographs).startswith(f"{photographs / 'mask.png'}: cannot read the image: ")


STEPS = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000


@pytest.mark.parametrize(
    ("place", "values", "unit"),
    [
        ("frame", {}, 1e-3),
        ("top", {"depth_unit_scale_factor": 0.25}, 0.25),
        ("frame", {"depth_unit_scale_factor": 2}, 2.0),
    ],
    ids=["default", "top", "frame"],
)
def test_depths_of_a_picture_are_in_steps_of_a_unit(photographs, place, values, unit):
    iio.imwrite(photographs / "depth.png", STEPS)
    give(photographs, depth_file_path="depth.png")
    if place == "top":
        edit(photographs / "transforms.json", lambda m: m.update(values))
    else:
        give(photographs, **values)
    dataset = load(photographs)
    depth = view_named(dataset).depth
    assert depth.dtype == np.float32
    # Divided by the largest number of 16 bits and multiplied by it: two roundings, and the unit's.
    np.testing.assert_allclose(depth, STEPS * unit, rtol=4 * 6e-8)
    assert depth[0, 0] == 0  # not known
    assert view_named(dataset, "02").depth is None


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint16])
@pytest.mark.parametrize("shape", [(6, 8), (6, 8, 1)])
@pytest.mark.parametrize(
    ("values", "unit"), [({}, 1.0), ({"depth_unit_scale_factor": 0.25}, 0.25)], ids=["", "stated"]
)
def test_depths_of_an_array_are_in_scene_units_or_in_those_that_are_stated(
    photographs, dtype, shape, values, unit
):
    """What is not finite or not positive is not known."""
    depths = np.random.default_rng(0).uniform(5, 90, (6, 8)).astype(dtype)
    if dtype != np.uint16:
        depths[0, :5] = [np.nan, np.inf, -1, 0, np.finfo(dtype).max]
    np.save(photographs / "depth.npy", depths.reshape(shape))
    give(photographs, depth_file_path="depth.npy", **values)
    dataset = load(photographs)
    # A power of two: no rounding but that to single precision.
    with np.errstate(over="ignore"):
        expected = (depths * unit).astype(np.float32)
    expected[~(np.isfinite(expected) & (expected > 0))] = 0
    assert (expected > 0).sum() >= 43
    np.testing.assert_array_equal(view_named(dataset).depth, expected)
    assert dataset.description.endswith(f"; depth in units of {unit:g}")


def test_the_units_of_all_depths_are_said(photographs):
    iio.imwrite(photographs / "depth.png", STEPS)
    np.save(photographs / "depth.npy", np.ones((6, 8)))
    give(photographs, "01.png", depth_file_path="depth.png")
    give(photographs, "02.png", depth_file_path="depth.npy")
    give(photographs, "03.png", depth_file_path="depth.npy", depth_unit_scale_factor=3)
    dataset = load(photographs)
    assert dataset.description.endswith("; depth in units of 0.001 and 1 and 3")
    assert [float(view_named(dataset, name).depth[5, 7]) for name in ("02", "03")] == [1, 3]


def test_smaller_depths_are_means_of_known_ones(photographs):
    depth = np.random.default_rng(0).uniform(1, 9, (6, 8))
    depth[1, 3] = np.nan
    np.save(photographs / "depth.npy", depth)
    give(photographs, depth_file_path="depth.npy")
    actual = view_named(load(photographs, image_size=4)).depth
    expected = np.nan_to_num(depth.reshape(3, 2, 4, 2).mean(axis=(1, 3)), nan=0)
    np.testing.assert_allclose(actual, expected, rtol=1e-6)
    assert (actual == 0).sum() == 1 and actual[0, 1] == 0


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (
            lambda path: np.save(path, np.ones((6, 8, 3))),
            "depth must be (height, width), got shape",
        ),
        (lambda path: path.write_bytes(b"broken"), "cannot read the depth: "),
        (lambda path: path.write_bytes(b""), "cannot read the depth: "),
        (lambda path: np.save(path, np.full((6, 8), None)), "cannot read the depth: "),
    ],
    ids=["colours", "broken", "empty", "objects"],
)
def test_an_array_that_holds_no_depths_is_refused(photographs, write, message):
    write(photographs / "depth.npy")
    give(photographs, depth_file_path="depth.npy")
    assert refusal(photographs).startswith(f"{photographs / 'depth.npy'}: {message}")


@pytest.mark.parametrize(
    ("pixels", "mode"),
    [(np.full((6, 8), 9, np.uint8), "L"), (np.full((6, 8, 3), 9, np.uint8), "RGB")],
    ids=["8 bits", "colours"],
)
def test_a_picture_of_depths_has_16_bits(photographs, pixels, mode):
    """Of 8 bits its numbers would be read as others."""
    iio.imwrite(photographs / "depth.png", pixels)
    give(photographs, depth_file_path="depth.png")
    assert refusal(photographs) == (
        f"{photographs / 'depth.png'}: must be a grey picture of 16 bits or an .npy file, got one "
        f"of Pillow's mode {mode}; convert it"
    )


def test_depth_may_be_ignored(photographs):
    """Then its file is not opened: there is none."""
    give(photographs, depth_file_path="nowhere.png")
    dataset = load(photographs, ignore_depth=True)
    assert all(view.depth is None for view in dataset.train)
    assert dataset.description.endswith("; depth (depth_file_path) ignored")
    assert dataset.ignored == ("depth",)


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_a_fit_whose_loss_does_not_look_at_depth_does_not_open_it(photographs, weight):
    give(photographs, depth_file_path="nowhere.png")
    fit = FitConfig(data={"path": str(photographs)}, loss={"depth_weight": weight})
    assert load_dataset(fit.data_for_rendering).ignored == ("depth",)
    if weight == 0:
        assert load_dataset(fit.data_for_training).ignored == ("depth",)
    else:
        with pytest.raises(UserError, match="there is no image"):
            load_dataset(fit.data_for_training)


def test_all_that_frames_have_may_be_ignored_and_is_named(photographs):
    edit(photographs / "transforms.json", lambda m: m.update(k1=0.1))
    values = {"mask_path": "nowhere.png", "depth_file_path": "nowhere.png"}
    give(photographs, transform_matrix_close=np.eye(4).tolist(), **values)
    names = ("distortion", "motion", "masks", "depth")
    dataset = load(photographs, **{f"ignore_{name}": True for name in names})
    assert dataset.ignored == names
    for view in (*dataset.train, *dataset.test):
        assert (view.lens, view.motion, view.mask, view.depth) == (None,) * 4


def test_a_mask_for_the_whole_file_is_that_of_every_frame_without_its_own(photographs):
    masks = np.random.default_rng(0).integers(0, 2, (2, 6, 8), np.uint8)
    for name, mask in zip(("all", "one"), masks, strict=True):
        iio.imwrite(photographs / f"{name}.png", 255 * mask)
    edit(photographs / "transforms.json", lambda m: m.update(mask_path="all.png"))
    give(photographs, "02.png", mask_path="one.png")
    dataset = load(photographs)
    for view in (*dataset.train, *dataset.test):
        np.testing.assert_array_equal(view.mask, masks[int(view.name == "02")])


def test_a_unit_of_depth_is_positive(photographs):
    iio.imwrite(photographs / "depth.png", STEPS)
    give(photographs, depth_file_path="depth.png", depth_unit_scale_factor=0)
    where = f"{photographs / 'transforms.json'}: frames[{index_of(photographs)}]."
    assert refusal(photographs) == f"{where}depth_unit_scale_factor must be > 0, got 0"


@pytest.mark.parametrize(
    ("place", "values", "shutter"),
    [
        ("frame", {}, "global"),
        ("frame", {"shutter": "rolling"}, "rolling"),
        ("top", {"shutter": "rolling"}, "rolling"),
    ],
)
def test_a_second_pose_is_read(photographs, place, values, shutter):
    """In the axes of the first."""
    center = (3.9, 0.5, 1.1)
    give(photographs, transform_matrix_close=look_at(center, (0, 0, 0)).tolist())
    if place == "top":
        edit(photographs / "transforms.json", lambda m: m.update(values))
    else:
        give(photographs, **values)
    dataset = load(photographs)
    motion = view_named(dataset).motion
    assert motion.shutter == shutter
    np.testing.assert_allclose(motion.close_to_world[:3, 3], center)
    ahead = motion.close_to_world[:3, :3].T @ (np.zeros(3) - center)
    np.testing.assert_allclose(ahead, [0, 0, np.linalg.norm(center)], atol=1e-12)
    assert view_named(dataset, "02").motion is None
    assert motion.samples == 8
    assert view_named(load(photographs, shutter_samples=3)).motion.samples == 3
    ignored = load(photographs, ignore_motion=True)
    assert view_named(ignored).motion is None
    assert ignored.description.endswith("; motion (transform_matrix_close) ignored")


def test_a_shutter_alone_is_no_motion(photographs):
    edit(photographs / "transforms.json", lambda m: m.update(shutter="rolling"))
    assert all(view.motion is None for view in load(photographs).train)


def test_wrong_motion_is_refused_with_the_key(photographs):
    where = f"{photographs / 'transforms.json'}: frames[{index_of(photographs)}]."
    give(photographs, transform_matrix_close=np.diag([2, 2, 2, 1]).tolist())
    assert refusal(photographs) == (
        f"{where}transform_matrix_close must be rigid (rotation and translation) to 0.0001: "
        "|R R^T - I| is 3, det R is 8"
    )
    give(photographs, transform_matrix_close=np.eye(4).tolist(), shutter="curtain")
    assert refusal(photographs) == (f"{where}shutter must be one of global, rolling, got curtain")


def test_transparency_is_kept(photographs):
    """Of photographs that are transparent; not otherwise."""
    rgba = np.random.default_rng(0).integers(0, 256, (6, 8, 4), np.uint8)
    iio.imwrite(photographs / "images" / "01.png", rgba)
    dataset = load(photographs)
    np.testing.assert_allclose(view_named(dataset).alpha, rgba[..., 3] / 255, rtol=1e-6)
    assert view_named(dataset, "02").alpha is None
    smaller = view_named(load(photographs, image_size=4))
    blocks = (rgba[..., 3] / 255).reshape(3, 2, 4, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(smaller.alpha, blocks, rtol=1e-6)


def test_transparency_of_synthetic_pictures_is_kept(blender):
    """Of those to train on."""
    folder, images = blender
    for width, shape in ((None, (4, 1, 6, 1)), (3, (2, 2, 3, 2))):
        view = load(folder, image_size=width).train[1]
        expected = (images["train", 1][..., 3] / 255).reshape(shape).mean(axis=(1, 3))
        np.testing.assert_allclose(view.alpha, expected, rtol=1e-6)
    assert load(folder).test[1].alpha is None


def test_frames_of_the_synthetic_layout_may_have_the_same(blender):
    """Mask, depth, lens and second pose, of both splits; what is ignored is named."""
    folder, _ = blender
    close = look_at((4, 0.5, 0), (0, 0, 0)).tolist()
    mask = np.ones((4, 6), np.uint8)
    mask[0, 1] = mask[3, 3:] = 0
    iio.imwrite(folder / "mask.png", 255 * mask)
    np.save(folder / "depth.npy", np.arange(24.0).reshape(4, 6))
    values = {"mask_path": "mask.png", "depth_file_path": "depth.npy", "k1": 0.1}
    values |= {"transform_matrix_close": close, "shutter": "rolling"}
    for split in ("train", "val"):
        edit(folder / f"transforms_{split}.json", lambda m: m["frames"][1].update(values))
    dataset = load(folder, ignore_distortion=True)
    assert dataset.ignored == ("distortion",)
    assert dataset.description.endswith("; lens opencv (k1) ignored; depth in units of 1")
    assert load(folder).train[1].lens == RadialTangential.of(k1=0.1)
    for views in (dataset.train, dataset.test):
        np.testing.assert_array_equal(views[1].mask, mask)
        np.testing.assert_array_equal(views[1].depth, np.arange(24.0).reshape(4, 6))
        assert views[1].motion.shutter == "rolling"
        np.testing.assert_allclose(views[1].motion.close_to_world[:3, 3], (4, 0.5, 0))
        for view in (views[0], views[2]):
            assert (view.lens, view.motion, view.mask, view.depth) == (None,) * 4
    smaller = load(folder, image_size=3).train[1]
    np.testing.assert_array_equal(smaller.mask, mask.reshape(2, 2, 3, 2).min(axis=(1, 3)))
    assert smaller.depth.shape == (2, 3)


def test_coarse_views_have_smaller_masks_depths_and_transparency():
    """By blocks of a factor; what is known of a block is known of all its pixels."""
    rng = np.random.default_rng(4)
    depth = rng.uniform(1, 5, (30, 40)).astype(np.float32)
    mask = np.ones((30, 40), np.float32)
    mask[3, 7], depth[8, 9] = 0, 0
    alpha = rng.uniform(0, 1, (30, 40)).astype(np.float32)
    view = view_at((4, 0, 0), (0, 0, 0))
    view = replace(view, alpha=alpha, mask=mask, depth=depth)
    smaller = smaller_view(view, 5)

    def blocks(values):
        return values.reshape(6, 5, 8, 5).transpose(0, 2, 1, 3).reshape(6, 8, 25)

    np.testing.assert_allclose(smaller.alpha, blocks(alpha).mean(axis=2), rtol=1e-5)
    np.testing.assert_array_equal(smaller.mask, blocks(mask).min(axis=2))
    known = (blocks(depth) > 0).all(axis=2)
    expected = np.where(known, blocks(depth).mean(axis=2), 0)
    np.testing.assert_allclose(smaller.depth, expected, rtol=1e-5)
    assert smaller.mask.sum() == known.sum() == 47
    plain = smaller_view(view_at((4, 0, 0), (0, 0, 0)), 5)
    assert plain.alpha is plain.mask is plain.depth is None


def test_memory_of_training_pictures_is_freed_with_all_that_belongs_to_them():
    pixels = np.ones((30, 40), np.float32)
    view = replace(view_at((4, 0, 0), (0, 0, 0)), alpha=pixels, mask=pixels, depth=pixels)
    freed = dataset_of([view]).without_training_images()
    (train,) = freed.train
    assert train.image.size == 0 and (train.alpha, train.mask, train.depth) == (None, None, None)
    assert freed.test[0].mask is pixels and (train.width, train.fx) == (view.width, view.fx)


# Either layout


def test_a_missing_folder_is_an_error_that_says_where_to_get_the_data(tmp_path):
    folder = tmp_path / "none"
    assert refusal(folder, source="our server") == (
        f"data.path: there is no folder {folder}; get it from our server"
    )
    assert refusal(folder) == f"data.path: there is no folder {folder}"


def test_a_folder_of_neither_layout_is_refused(tmp_path):
    assert refusal(tmp_path) == (
        f"{tmp_path}: neither transforms_train.json nor transforms.json is there; data.path must "
        "be a folder in the layout of NeRF-synthetic or of nerfstudio / instant-ngp"
    )


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        (np.full((2, 2), 51, np.uint8), 0.2),
        (np.full((2, 2), 13107, np.uint16), 0.2),
        (np.full((2, 2, 2), (51, 255), np.uint8), 0.2),
    ],
    ids=["grey", "grey16", "grey-alpha"],
)
def test_grey_images_become_rgb(photographs, pixels, expected):
    def change(meta):
        del meta["w"], meta["h"]

    edit(photographs / "transforms.json", change)
    iio.imwrite(photographs / "images" / "01.png", pixels)
    image = load(photographs).train[0].image
    assert image.shape == (2, 2, 3)
    np.testing.assert_allclose(image, expected, rtol=1e-6)


def test_image_size_scales_pictures_and_intrinsics_together(photographs):
    full, half = load(photographs), load(photographs, image_size=4)
    a, b = full.train[0], half.train[0]
    assert (b.width, b.height, b.image.shape) == (4, 3, (3, 4, 3))
    np.testing.assert_allclose(b.K[:2], a.K[:2] / 2)
    assert "4x3" in half.description


def test_images_are_never_enlarged(photographs):
    assert load(photographs, image_size=100).train[0].width == 8


@pytest.mark.parametrize("shape", [(6, 8), (7, 9), (5, 11)])
def test_downscaling_averages_over_each_pixels_area(shape):
    image = np.random.default_rng(1).random((*shape, 3)).astype(np.float32)
    actual = downscale(image, 4)
    height, width = actual.shape[:2]
    assert (height, width) == (round(shape[0] * 4 / shape[1]), 4)
    # Each source pixel repeated until old and new pixel edges coincide, then plain means.
    repeated = image.astype(np.float64).repeat(height, axis=0).repeat(width, axis=1)
    blocks = repeated.reshape(height, shape[0], width, shape[1], 3)
    np.testing.assert_allclose(actual, blocks.mean(axis=(1, 3)), rtol=1e-6)


@given(st.integers(1, 12), st.integers(1, 12), st.integers(1, 12))
def test_downscaling_keeps_a_constant_image(height, width, new_width):
    actual = downscale(np.full((height, width, 3), 0.7, np.float32), new_width)
    assert actual.shape[1] == min(width, new_width)
    np.testing.assert_allclose(actual, 0.7, rtol=1e-6)


def test_scaling_a_composite_equals_compositing_scaled_premultiplied_colours(blender):
    folder, images = blender
    actual = load(folder, image_size=3, background=(0.25, 0.5, 0.75)).train[0].image
    pixels = images["train", 0].astype(np.float64) / 255
    pixels[..., :3] *= pixels[..., 3:]
    small = pixels.reshape(2, 2, 3, 2, 4).mean(axis=(1, 3))
    expected = small[..., :3] + np.array([0.25, 0.5, 0.75]) * (1 - small[..., 3:])
    np.testing.assert_allclose(actual, expected, atol=5e-7)


def test_extent_is_1_1_times_the_largest_distance_from_the_centroid():
    views = [view_at(c, (0, 0, 0)) for c in [(3, 0, 0), (0, 3, 0), (0, 0.1, 6)]]
    # Centroid (1, 1.0333, 2); the farthest is the third.
    expected = 1.1 * math.dist((1, 3.1 / 3, 2), (0, 0.1, 6))
    assert dataset_of(views).extent == pytest.approx(expected)


def test_extent_is_1_where_all_cameras_share_a_centre():
    views = [view_at((1, 2, 3), (0, 0, 0)), view_at((1, 2, 3), (5, 0, 0))]
    assert dataset_of(views).extent == 1


# Starting points


def config(**sections):
    return FitConfig(data={"path": "unused"}, **sections)


def test_random_points_fill_the_reference_box_and_repeat_with_the_seed(blender):
    dataset = load(blender[0])
    a = initial_gaussians(config(init={"num_points": 2000}), dataset)
    b = initial_gaussians(config(init={"num_points": 2000}), dataset)
    c = initial_gaussians(config(init={"num_points": 2000}, seed=1), dataset)
    np.testing.assert_array_equal(a.means, b.means)
    assert not np.array_equal(a.means, c.means)
    assert np.abs(a.means).max() <= 1.3
    # The largest of 6000 uniform numbers falls short of 1.3 by 1.3 / 6000 on average.
    assert np.abs(a.means).max() > 1.3 * (1 - 20 / 6000)


def test_starting_gaussians_have_the_reference_values(blender):
    g = initial_gaussians(config(init={"num_points": 50, "opacity": 0.2}), load(blender[0]))
    assert g.num_gaussians == 50
    assert g.sh_degree == 3
    np.testing.assert_allclose(g.opacities, 0.2, rtol=1e-6)
    np.testing.assert_array_equal(g.quats, np.tile([1, 0, 0, 0], (50, 1)))
    assert not g.sh0.any()  # grey: colour is SH + 0.5
    assert not g.shN.any()
    np.testing.assert_array_equal(g.log_scales, g.log_scales[:, :1].repeat(3, axis=1))


def test_scales_are_the_rms_distance_to_the_three_nearest_points():
    points = np.random.default_rng(0).random((40, 3))
    squared = ((points[:, None] - points[None]) ** 2).sum(-1)
    expected = np.sort(squared, axis=1)[:, 1:4].mean(axis=1)
    np.testing.assert_allclose(mean_squared_neighbour_distance(points), expected, rtol=1e-12)


def points_file(path, rgb=None, positions=None):
    """A PLY of 4 points at the corners of a unit tetrahedron's bounding cube."""
    from plyfile import PlyData, PlyElement

    if positions is None:
        positions = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    names = "xyz" if rgb is None else ["x", "y", "z", "red", "green", "blue"]
    rows = [tuple(p) + (tuple(rgb) if rgb else ()) for p in positions]
    kinds = [(name, "u1" if len(name) > 1 else "f4") for name in names]
    vertex = PlyElement.describe(np.array(rows, kinds), "vertex")
    PlyData([vertex]).write(str(path))
    return path


def test_a_point_cloud_gives_positions_colours_and_scales(tmp_path):
    path = points_file(tmp_path / "p.ply", rgb=(255, 0, 51))
    g = initial_gaussians(
        config(init={"point_cloud": path}, model={"sh_degree": 1}), dataset_of([])
    )
    assert (g.num_gaussians, g.sh_degree) == (4, 1)
    # Colour 0.5 + C0 sh0, C0 = sqrt(1 / (4 pi)).
    colors = 0.5 + math.sqrt(1 / (4 * math.pi)) * g.sh0[:, 0]
    np.testing.assert_allclose(colors, np.tile([1, 0, 0.2], (4, 1)), atol=2e-7)
    # Neighbours of the corner at distance 1, 1, 1; of the others at 1, sqrt(2), sqrt(2).
    np.testing.assert_allclose(g.scales[0], 1, rtol=1e-6)
    np.testing.assert_allclose(g.scales[1:], math.sqrt(5 / 3), rtol=1e-6)


def test_coinciding_points_keep_a_positive_scale(tmp_path):
    path = points_file(tmp_path / "p.ply", positions=[(1, 2, 3)] * 5)
    g = initial_gaussians(config(init={"point_cloud": path}), dataset_of([]))
    np.testing.assert_allclose(g.scales, math.sqrt(1e-7), rtol=1e-6)


def test_a_point_cloud_of_the_wrong_size_is_refused(tmp_path):
    path = points_file(tmp_path / "p.ply", positions=[(0, 0, 0)] * 3)
    with pytest.raises(UserError, match=r"p.ply: at least 4 points, got 3"):
        initial_gaussians(config(init={"point_cloud": path}), dataset_of([]))
    path = points_file(tmp_path / "p.ply", positions=[(0, 0, 0)] * 9)
    with pytest.raises(UserError) as error:
        initial_gaussians(
            config(init={"point_cloud": path}, densify={"max_gaussians": 8}), dataset_of([])
        )
    assert str(error.value) == (
        f"{path}: must hold at most densify.max_gaussians (8) points, got 9"
    )


def test_the_focus_is_what_the_cameras_look_at():
    target = np.array([1.0, -2.0, 0.5])
    centers = [(5, 0, 0), (0, 6, 1), (4, 3, 2)]
    focus, distance = focus_of([view_at(center, target) for center in centers])
    np.testing.assert_allclose(focus, target, atol=1e-12)
    assert distance == pytest.approx(np.median([math.dist(c, target) for c in centers]))


def test_points_in_view_are_seen_and_not_in_front_of_a_lens():
    views = [view_at(c, (1, 0, 0)) for c in [(5, 0, 0), (4, 2, 0), (4, -2, 1)]]
    points = points_in_view(views, 500, np.random.default_rng(0))
    assert points.shape == (500, 3)
    seen = np.zeros(500, bool)
    for view in views:
        camera = (points - view.center) @ view.camera_to_world[:3, :3]
        pixel = camera @ view.K.T
        with np.errstate(divide="ignore"):
            pixel = pixel[:, :2] / pixel[:, 2:]
        inside = (pixel >= 0) & (pixel <= [view.width, view.height])
        seen |= inside.all(axis=1) & (camera[:, 2] > 0)
        assert np.linalg.norm(points - view.center, axis=1).min() >= 0.25 * focus_of(views)[1]
    assert seen.all()


def test_half_extent_wins_over_the_layouts_and_the_cameras_box(blender):
    g = initial_gaussians(config(init={"half_extent": 0.25, "num_points": 99}), load(blender[0]))
    assert np.abs(g.means).max() <= 0.25
    views = [view_at((5, 0, 0), (0, 0, 0)), view_at((0, 5, 0), (0, 0, 0))]
    g = initial_gaussians(config(init={"half_extent": 9.0, "num_points": 99}), dataset_of(views))
    assert 8 < np.abs(g.means).max() <= 9


@pytest.mark.parametrize(
    ("views", "reason"),
    [
        ([view_at((5, y, 0), (0, y, 0)) for y in range(3)], "whose optical axes are parallel"),
        (
            [view_at(c, 2 * np.array(c)) for c in [(1, 0, 0), (0, 1, 0), (-1, -1, 1)]],
            "which look away from each other",
        ),
    ],
    ids=["parallel", "outward"],
)
def test_cameras_that_determine_no_box_are_refused(views, reason):
    with pytest.raises(UserError) as error:
        initial_gaussians(config(), dataset_of(views))
    assert str(error.value) == (
        f"init.half_extent: no start box can be derived from the cameras, {reason}; set "
        "init.half_extent, or give a point cloud (init.point_cloud)"
    )


def test_starting_gaussians_can_be_written(blender, tmp_path):
    g = initial_gaussians(config(init={"num_points": 5}), load(blender[0]))
    g.save(tmp_path / "start.ply")
    assert (tmp_path / "start.ply").is_file()


# The real data


def test_lego_is_read(lego_folder):
    dataset = load(lego_folder, image_size=200)
    assert (len(dataset.train), len(dataset.test), dataset.test_split) == (100, 100, "val")
    view = dataset.train[0]
    assert (view.width, view.height) == (200, 200)
    assert view.fx == pytest.approx(555.5555 / 2, rel=1e-6)
    np.testing.assert_array_equal(view.image[0, 0], 1)  # background
    # All cameras of this scene look at the origin from one distance.
    focus, distance = focus_of(dataset.train)
    np.testing.assert_allclose(focus, 0, atol=1e-5)
    assert distance == pytest.approx(4.0311, abs=1e-3)


def test_fox_is_read(fox_folder):
    dataset = load(fox_folder)
    assert (len(dataset.train), len(dataset.test)) == (43, 7)
    assert (dataset.train[0].width, dataset.train[0].height) == (270, 480)
    named = dataset.train[0].lens.named()
    assert named == {
        "k1": 0.0578421, "k2": -0.0805099, "p1": -0.000980296, "p2": 0.00015575
    }  # fmt: skip
