"""Datasets are read as they are, and refused with file and key where they are wrong."""

import math
import os

import imageio.v3 as iio
import numpy as np
import pytest
from support.datasets import CENTERS, edit, load, load_noting, put, refusal, views_by_name

from drgs.cameras.equirectangular import Equirectangular
from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye
from drgs.datasets.transforms import unique_names


@pytest.mark.parametrize("background", ["white", "black", (0.0, 0.5, 1.0)])
def test_rgba_is_composited_over_the_background_in_display_space(blender, background):
    folder, images = blender
    color = {"white": 1.0, "black": 0.0}.get(background, background)
    view = load(folder, background=background).train[1]
    pixels = images["train", 1].astype(np.float64) / 255
    expected = pixels[..., :3] * pixels[..., 3:] + np.array(color) * (1 - pixels[..., 3:])
    # Four float32 roundings of numbers <= 1.
    np.testing.assert_allclose(view.image, expected, atol=4 * 6e-8)
    assert np.asarray(view.image).dtype == np.float32


def test_synthetic_cameras_have_the_horizontal_angle_and_look_at_the_origin(blender):
    put(blender[0] / "transforms_train.json", "frames 0 file_path", "train/r_0.png")
    for number, (view, center) in enumerate(zip(load(blender[0]).train, CENTERS, strict=True)):
        assert view.name == f"r_{number}"
        assert (view.width, view.height, view.cx, view.cy, view.fx) == (6, 4, 3, 2, view.fy)
        assert 2 * math.atan(view.width / 2 / view.fx) == pytest.approx(0.8, abs=1e-12)
        np.testing.assert_allclose(view.center, center)
        # In OpenCV axes the origin lies straight ahead, and world up is at negative y.
        rotation = view.camera_to_world[:3, :3]
        ahead = rotation.T @ (np.zeros(3) - center)
        np.testing.assert_allclose(ahead, [0, 0, np.linalg.norm(center)], atol=1e-12)
        assert (rotation.T @ [0, 0, 1])[1] < 0
        # Entries are below 10: some ten roundings of float64.
        np.testing.assert_allclose(view.viewmat @ view.camera_to_world, np.eye(4), atol=1e-14)


def test_a_test_split_is_preferred_and_test_split_names_another_that_is_there(blender):
    folder, _ = blender
    dataset = load(folder)
    assert dataset.test_split == "val"
    assert "measured on 3 views of split val" in dataset.description
    (folder / "transforms_test.json").write_text((folder / "transforms_train.json").read_text())
    assert load(folder).test_split == "test"
    assert load(folder, test_split="val").test_split == "val"
    for name in ("val", "test"):
        (folder / f"transforms_{name}.json").unlink()
    refused = refusal(folder, test_split="test")
    assert refused.endswith("transforms_test.json: cannot read the file: No such file or directory")
    message = "there are no test views: neither transforms_test.json nor transforms_val.json is"
    assert refusal(folder).startswith(f"{folder}: {message}")


MATRIX = "transform_matrix"
RIGID = "must be rigid (rotation, translation, row 0 0 0 1) to 0.0001: off by "


def diagonal(*values):
    return np.diag(values).tolist()


REFUSED_FRAMES = [
    ("frames", [], "frames must have at least 1 item after validation, not 0, got []"),
    ("frames", 3, "frames must be a list, got 3"),
    ("frames", None, "frames is missing"),
    ("frames 1", 7, "frames[1] must be an object, got 7"),
    ("camera_angle_x", None, "camera_angle_x is missing"),
    ("camera_angle_x", 1e-5, "camera_angle_x must be >= 9.999999992e-05, got 1e-05"),
    ("camera_angle_x", 10**400, f"camera_angle_x must be a number, got 1{56 * '0'}..."),
    ("camera_angle_x", 40, "camera_angle_x must be <= 3.101597986, got 40"),
    ("frames 1 file_path", None, "frames[1].file_path is missing"),
    (f"frames 1 {MATRIX}", None, f"frames[1].{MATRIX} is missing"),
    (f"frames 1 {MATRIX}", [[1, 2], [3]], f"frames[1].{MATRIX} must be 4 x 4 numbers, got [[1, 2"),
    (f"frames 1 {MATRIX} 3", None, f"frames[1].{MATRIX} must be 4 x 4 numbers, got [["),
    (f"frames 1 {MATRIX} 0 0", "1", f'frames[1].{MATRIX}[0][0] must be a number, got "1"'),
    (f"frames 1 {MATRIX} 2 3", -2e9, f"frames[1].{MATRIX}[2][3] must be >= -1000000000, got -2000"),
    (f"frames 2 {MATRIX} 0 3", math.nan, f"frames[2].{MATRIX}[0][3] must be a finite number, got"),
    (f"frames 0 {MATRIX}", diagonal(2, 2, 2, 1), f"frames[0].{MATRIX} {RIGID}3, det R is 8, got"),
    (f"frames 0 {MATRIX}", diagonal(1, 1, -1, 1), f"frames[0].{MATRIX} {RIGID}0, det R is -1"),
    (f"frames 0 {MATRIX}", diagonal(1, 1, 1, 2), f"frames[0].{MATRIX} {RIGID}1, det R is 1"),
]


@pytest.mark.parametrize(("keys", "value", "message"), REFUSED_FRAMES)
def test_wrong_frames_are_refused_with_file_and_key(blender, keys, value, message):
    path = blender[0] / "transforms_train.json"
    put(path, keys, value)
    assert refusal(blender[0]).startswith(f"{path}: {message}")


def test_pose_must_be_rigid_within_1e_4(blender):
    # R = [[1, shear, 0], [0, 1, 0], [0, 0, 1]] has |R R^T - I| = shear (and its square).
    path, place = blender[0] / "transforms_train.json", f"frames 0 {MATRIX}"
    put(path, place, np.eye(4).tolist())
    put(path, f"{place} 0 1", 0.9e-4)
    load(blender[0])
    put(path, f"{place} 0 1", 1.1e-4)
    assert RIGID in refusal(blender[0])


def image_file(*shape):
    return iio.imwrite("<bytes>", np.zeros(shape, np.uint8), extension=".png")


REFUSED_FILES = [
    ("val/r_2.png", image_file(4, 6, 3), "must have an alpha channel (RGBA), as the NeRF-synthet"),
    ("train/r_2.png", image_file(6, 4, 4), "must be 6 x 4 px, as r_0.png is, got 4 x 6; scale the"),
    ("train/r_1.png", b"not an image", "cannot read the image: "),
    ("transforms_train.json", b'{"frames": [\n', "not valid JSON: Expecting value: line 2"),
]


@pytest.mark.parametrize(("name", "content", "message"), REFUSED_FILES)
def test_wrong_files_are_refused_by_name(blender, name, content, message):
    (blender[0] / name).write_bytes(content)
    assert refusal(blender[0]).startswith(f"{blender[0] / name}: {message}")


def test_missing_image_is_left_out_and_reported_unless_most_are_missing(blender):
    folder, path = blender[0], blender[0] / "transforms_train.json"
    (folder / "train" / "r_1.png").unlink()
    dataset, notes = load_noting(folder)
    assert [view.name for view in dataset.train] == ["r_0", "r_2"]
    assert notes == [f"{path}: not there: 1 of 3 photographs (./train/r_1); left out"]
    (folder / "train" / "r_0.png").unlink()
    refused = refusal(folder)
    assert refused.startswith(f"{path}: frames[0].file_path: there is no image {folder}/train/r_0")
    assert refused.endswith("; not there: 2 of 3 photographs")


def test_every_eighth_view_by_file_name_is_test(photographs):
    dataset = load(photographs)
    assert [view.name for view in dataset.test] == ["00", "08"]
    assert [view.name for view in dataset.train] == ["01", "02", "03", "04", "05", "06", "07", "09"]
    assert dataset.test_split == "test"
    # Each view kept its own image and its own camera.
    for view in (*dataset.train, *dataset.test):
        i = int(view.name)
        np.testing.assert_allclose(view.image, 20 * i / 255, rtol=1e-6)
        np.testing.assert_allclose(view.center, (4 * math.cos(i), 4 * math.sin(i), 1))
    dataset = load(photographs, test_every=5, background="white")
    assert [view.name for view in dataset.test] == ["00", "05"]


def test_a_frame_overrides_the_intrinsics_at_the_top(photographs):
    edit(photographs / "transforms.json", lambda m: m["frames"][8].update(fl_x=11.0, cx=4.5))
    views = views_by_name(load(photographs))
    np.testing.assert_array_equal(views["02"].K, [[9, 0, 3.5], [0, 8, 3.25], [0, 0, 1]])
    np.testing.assert_array_equal(views["01"].K, [[11, 0, 4.5], [0, 8, 3.25], [0, 0, 1]])


def test_angles_replace_missing_focal_lengths(photographs):
    path = photographs / "transforms.json"
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        put(path, key, None)
    put(path, "camera_angle_x", 0.8)
    view = load(photographs).train[0]
    assert view.fx == view.fy == pytest.approx(4 / math.tan(0.4))
    assert (view.cx, view.cy) == (4, 3)
    put(path, "camera_angle_y", 0.5)
    assert load(photographs).train[0].fy == pytest.approx(3 / math.tan(0.25))


PRISM, PANORAMA = "THIN_PRISM_FISHEYE", "EQUIRECTANGULAR"

LENSES = [
    ({"k1": 0.1, "k2": 0.0, "p1": -0.02}, RadialTangential, ["k1", "p1"]),
    ({"k1": 0, "k2": 0.0, "p1": 0}, None, []),
    ({"k1": 0.1, "k4": 0.2, "camera_model": "FULL_OPENCV"}, RadialTangential, ["k1", "k4"]),
    ({"k1": 0.1, "k4": 0.25, "k5": 0.125}, RadialTangential, ["k1", "k4", "k5"]),
    ({"k1": 0.1, "k4": -0.01, "camera_model": "OPENCV_FISHEYE"}, Fisheye, ["k1", "k4"]),
    ({"k1": 0.1, "k4": -0.01, "is_fisheye": True}, Fisheye, ["k1", "k4"]),
    ({"k1": 0.1, "sy1": -0.02, "camera_model": PRISM}, ThinPrismFisheye, ["k1", "sy1"]),
    ({"k1": 0.1, "p1": 0, "sx1": 0.0, "camera_model": PRISM}, Fisheye, ["k1"]),  # costs less
]


@pytest.mark.parametrize(("values", "kind", "names"), LENSES)
def test_lens_is_read_and_does_not_depend_on_the_image_size(photographs, values, kind, names):
    edit(photographs / "transforms.json", lambda m: m.update(values))
    dataset = load(photographs)
    lens = kind and kind.from_coefficients(**{name: values[name] for name in names})
    assert dataset.train[0].lens == load(photographs, image_size=4).train[0].lens == lens
    if lens is None:
        assert "; lens" not in dataset.description
    else:
        names = ", ".join(lens.coefficients())
        assert dataset.description.endswith(f"; lens {lens.kind} ({names})")
    assert load(photographs, ignore_distortion=True).train[0].lens is None


@pytest.mark.parametrize("place", ["", "frames 1 "])
def test_coefficients_may_be_a_list_of_nerfstudio(photographs, place):
    path = photographs / "transforms.json"
    put(path, "k1", 7.0)
    put(path, f"{place}distortion_params", [0.1, 0.02, 0.0, 0.0, -0.03, 0.04])
    lenses = [view.lens for view in (*load(photographs).train, *load(photographs).test)]
    expected = RadialTangential.from_coefficients(k1=0.1, k2=0.02, p1=-0.03, p2=0.04)
    assert lenses.count(expected) == (1 if place else len(lenses))
    put(path, f"{place}distortion_params", [0.1])
    assert "distortion_params must have at least 6" in refusal(photographs)


def test_panoramas_need_no_focal_length(photographs):
    """The whole image is a turn, whatever nerfstudio writes; and no pinhole could replace it."""
    path = photographs / "transforms.json"
    edit(path, lambda m: m.update(camera_model=PANORAMA, fl_x=None, cx=1.0))
    assert "must be twice as wide as high, got 8 x 6 px" in refusal(photographs)
    for file in photographs.rglob("*.png"):
        iio.imwrite(file, iio.imread(file)[1:5])
    edit(path, lambda m: m.pop("h", None))
    for options, width, height in (({}, 8, 4), ({"image_size": 4}, 4, 2)):
        for ignored in (False, True):
            dataset = load(photographs, ignore_distortion=ignored, **options)
            view = dataset.train[0]
            assert view.lens == Equirectangular() and (view.width, view.height) == (width, height)
            assert (2 * np.pi * view.fx, np.pi * view.fy) == pytest.approx((width, height))
            assert (view.cx, view.cy) == (width / 2, height / 2)
            assert dataset.description.endswith("; lens equirectangular")


REFUSED_INTRINSICS = [
    ({"fl_x": None}, "fl_x is missing, and there is no camera_angle_x either"),
    ({"fl_y": -1}, "fl_y must be > 0, got -1"),
    ({"fl_x": 1e-3}, "fl_x must be between 0.08 and 80000 px for 8 px, got 0.001"),
    ({"cy": -700}, "cy must be within 600 px of the image, got -700"),
    ({"cx": "4"}, 'cx must be a number, got "4"'),
    ({"frames 4 fl_x": 0}, "frames[4].fl_x must be > 0, got 0"),
    ({"w": 16}, "w must be the image's size, 8 px ({0}/images/00.png), got 16; scale the intrins"),
    ({"camera_model": "EQUI"}, "camera_model must be one of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADI"),
    ({"is_fisheye": True, "p1": 0.5}, "p1: a lens of the kind fisheye has the coefficients k1, k2"),
    ({"k1": 0.5, "camera_model": PANORAMA}, "k1: a lens of the kind equirectangular has the coeff"),
    ({"sx1": 0.5}, "sx1: a lens of the kind opencv has the coefficients k1, k2, k3, k4, k5, k6, p"),
    ({"k4": 0.25, "camera_model": "OPENCV"}, "k4 is read as OpenCV's, of a denominator 1 + k4 r^"),
]


@pytest.mark.parametrize(("values", "message"), REFUSED_INTRINSICS)
def test_wrong_intrinsics_are_refused_with_file_and_key(photographs, values, message):
    path = photographs / "transforms.json"
    for keys, value in values.items():
        put(path, keys, value)
    assert refusal(photographs).startswith(f"{path}: {message.format(photographs)}")


@pytest.mark.parametrize(
    ("count", "options", "message"),
    [
        (1, {}, "at least 2 views are needed, one of them to test; got 1"),
        (10, {"test_split": "val"}, "this layout has no split val; leave data.test_split out"),
    ],
)
def test_too_few_views_are_refused(photographs, count, options, message):
    edit(photographs / "transforms.json", lambda m: m.update(frames=m["frames"][:count]))
    assert message in refusal(photographs, **options)


def test_unread_keys_are_reported_once(photographs):
    path = photographs / "transforms.json"
    edit(path, lambda m: m.update(skew=0.5, from_na=True, aabb_scale=4))
    for index in range(2):
        edit(path, lambda m, k=index: m["frames"][k].update(sharpness=3.0, exposure=1.5))
    _, notes = load_noting(photographs)
    assert notes == [f"{path}: keys that are not read: from_na, skew, frames[].exposure"]


def test_keys_of_other_layouts_are_reported_as_unread(blender):
    path = blender[0] / "transforms_train.json"
    edit(path, lambda m: m.update(cx=2.5, w=6, h=4, ply_file_path="a.ply", near=1))
    edit(path, lambda m: m.update(train_filenames=["a"], frames=[{**m["frames"][0], "fl_x": 9.0}]))
    dataset, notes = load_noting(blender[0])
    keys = "near, fl_x, cx, w, h, ply_file_path, train_filenames"
    assert notes[0] == f"{path}: keys that are not read: {keys}"
    assert dataset.train[0].cx == 3


def test_equal_and_empty_photographs_are_reported(photographs):
    images = photographs / "images"
    (images / "05.png").write_bytes((images / "03.png").read_bytes())
    (images / "08.png").write_bytes((images / "02.png").read_bytes())  # 08 is measured on
    iio.imwrite(images / "07.png", np.zeros((6, 8, 4), np.uint8))
    dataset, notes = load_noting(photographs)
    assert len(dataset.train) == 8
    assert notes == [
        f"{photographs}: photographs that are transparent everywhere: 1 (images/07.png)",
        f"{photographs}: the same photograph more than once: 2 (images/02.png = images/08.png, "
        "images/03.png = images/05.png); 1 of them both trained and measured on",
    ]


def test_transforms_file_may_begin_with_a_bom(photographs):
    path = photographs / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(load(photographs).train) == 8
    path.write_bytes(path.read_text("utf-8-sig").encode("utf-16"))
    assert refusal(photographs).startswith(f"{path}: cannot read the file: not UTF-8 text")


@pytest.mark.parametrize("name", ["POINTS.PLY", "/home/me/scan/points.ply", "images\\points.ply"])
def test_point_cloud_is_found_under_a_similar_name(photographs, name):
    cloud = photographs / ("images/points.ply" if "images" in name else "points.ply")
    cloud.touch()
    put(photographs / "transforms.json", "ply_file_path", name)
    dataset, (note,) = load_noting(photographs)
    assert dataset.point_cloud == cloud
    assert note.endswith(f"nearly the same name: 1 point cloud, such as {cloud} for {name}")


@pytest.mark.parametrize(
    ("file_path", "folder"),
    [
        ("../scan/images/{0}.png", "images"),
        ("{0}", "images"),
        ("/home/me/scan/images/{0}.png", "images"),
        ("images\\{0}.png", "Images"),
    ],
)
def test_photographs_that_were_moved_are_found(photographs, file_path, folder):
    for index in range(10):
        name = file_path.format(f"{9 - index:02d}")
        put(photographs / "transforms.json", f"frames {index} file_path", name)
    (photographs / "images").rename(photographs / folder)
    dataset, (note,) = load_noting(photographs)
    for view in (*dataset.train, *dataset.test):
        assert view.files["image"] == photographs / folder / f"{view.name}.png"
        np.testing.assert_allclose(view.image, 20 * int(view.name) / 255, rtol=1e-6)
    assert ": taken under nearly the same name: 10 photographs" in note


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["./train/r_0", "images/b.png"], ["r_0", "b"]),
        (["a/0.png", "b\\0.png"], ["a_0", "b_0"]),
        (["a.png", "a.jpg"], ["0000_a", "0001_a"]),
        (["/data/a/0.png", "/data/b/0.png"], ["data_a_0", "data_b_0"]),
    ],
)
def test_views_are_named_after_their_files_with_folders_if_needed(files, names):
    assert unique_names(files) == names


@pytest.mark.parametrize(
    "file",
    ["\u4e2d" * 80 + "{0}.png", "/".join(["x" * 100] * 5) + "/{0}/a.png", "\udcff" * 240 + "{0}"],
)
def test_long_view_names_are_shortened(file):
    """255 bytes are the limit, of which numbers, suffixes and temporary names take some."""
    names = unique_names([file.format(i) for i in range(2)])
    assert len(set(names)) == 2
    assert all(len(os.fsencode(name)) <= 220 and "/" not in name for name in names)


@pytest.mark.parametrize("factor", [2, 4])
def test_photographs_that_are_there_in_a_smaller_size_alone_are_used(photographs, factor):
    """The folders of nerfstudio; cameras are scaled as the photographs are."""
    path = photographs / "transforms.json"
    edit(path, lambda m: m.update(w=8 * factor, h=6 * factor, fl_x=9.0, fl_y=None, cx=5.0, cy=3.0))
    (photographs / "images").rename(photographs / f"images_{factor}")
    dataset, notes = load_noting(photographs)
    view = dataset.train[0]
    assert (view.width, view.height) == (8, 6)
    assert (view.fx, view.fy) == pytest.approx((9 / factor, 9 / factor))
    assert (view.cx, view.cy) == pytest.approx((5 / factor, 3 / factor))
    assert any(f"images_{factor}/09.png for images/09.png" in note for note in notes), notes
    (photographs / f"images_{factor}").rename(photographs / "images")
    assert "w must be the image's size, 8 px" in refusal(photographs)
