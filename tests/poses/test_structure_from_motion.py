"""Structure from motion: cameras as images were taken with, or why there are none."""

import itertools
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from conftest import SHARED_DATA
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation
from support.colmap_models import write_dataset
from support.datasets import load, look_at, views_by_name

from drgs.core.child_process import ChildEndedError
from drgs.core.errors import UserError, UserNote
from drgs.core.folders import sole_writer
from drgs.poses import structure_from_motion as sfm
from drgs.poses.structure_from_motion import (
    ALL_PAIRS,
    MODEL_FILES,
    SfmSettings,
    photographs_in,
    reconstruct,
)

NAMES = [f"corner {k}.png" for k in range(7, 14)]  # 10 follows 9, and has a space

FOX = SHARED_DATA / "fox"

SIZE, FOCAL = (320, 240), 300.0  # px

TEXELS_PER_UNIT = 64


def search(folder, replace=False, watch=lambda *step: None, **settings):
    return reconstruct(folder, SfmSettings(**settings), replace, watch)


def save(path, size=(8, 6), **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size).save(path, **options)


def names_in(folder):
    return {path.name for path in folder.iterdir()}


def wall_textures(side=512):
    """Textures of the planes x = 0, y = 0 and z = 0: noise of several sizes."""
    rng = np.random.default_rng(0)
    layers = [gaussian_filter(rng.normal(size=(3, side, side, 3)), (0, s, s, 0)) for s in (1, 3, 9)]
    return np.clip(0.5 + 0.2 * sum(layer / layer.std() for layer in layers), 0, 1)


def image_of(textures, pose):
    """(H, W, 3) uint8 of a pinhole camera; pose: (4, 4) camera to world, OpenGL axes."""
    width, height = SIZE
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x, -y, np.full_like(x, -FOCAL)], axis=-1) @ pose[:3, :3].T
    center, rendered = pose[:3, 3], np.zeros((height, width, 3))
    distances = np.stack([-center[k] / np.minimum(rays[..., k], -1e-9) for k in range(3)])
    nearest = distances.argmin(axis=0)
    for k, channel in np.ndindex(3, 3):
        points = center + distances[k][..., None] * rays
        place = np.moveaxis(np.delete(points, k, axis=-1), -1, 0) * TEXELS_PER_UNIT
        seen = map_coordinates(textures[k, :, :, channel], place, order=1, mode="wrap")
        rendered[..., channel] = np.where(nearest == k, seen, rendered[..., channel])
    return np.round(255 * rendered).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mapper", "steps_of_mapper"),
    [("incremental", ("camera", 7)), ("global", ("global mapping", sfm.GLOBAL_PASSES))],
)
def test_true_cameras_are_recovered_and_only_the_model_is_left(tmp_path, mapper, steps_of_mapper):
    """Up to a similarity. Features are found to a tenth of a pixel: an angle of 3e-4."""
    pycolmap = pytest.importorskip("pycolmap")
    # In front of the corner of a room, along an arc, all looking at about the same place.
    places = [
        ((6 * np.cos(a), 6 * np.sin(a), 2.5 + np.sin(5 * a)), 1.2 + 0.3 * np.sin(7 * a))
        for a in np.linspace(0.35, 1.2, len(NAMES))
    ]
    poses = np.array([look_at(center, (1.2, 1.2, height)) for center, height in places])
    textures, steps = wall_textures(), []
    for name, pose in zip(NAMES, poses, strict=True):
        Image.fromarray(image_of(textures, pose)).save(tmp_path / name)
    # Photographs without a mask are used.
    (tmp_path / "masks").mkdir()
    Image.new("L", SIZE, 255).save(tmp_path / "masks" / f"{NAMES[2]}.png")
    settings = {"camera_model": "PINHOLE", "mapper": mapper}
    found = search(tmp_path, watch=lambda *step: steps.append(step), **settings)
    for what, total in (("photograph", 7), ("pair of photographs", 21), steps_of_mapper):
        assert [step for step in steps if step[0] == what][-1] == (what, total, total)
    assert names_in(tmp_path) == {*NAMES, "sparse", "masks"}
    assert names_in(tmp_path / "sparse" / "0") == {*MODEL_FILES, ".drgs-poses.json"}
    assert found.names == tuple(NAMES) and found.missing == ()
    images = pycolmap.Reconstruction(tmp_path / "sparse" / "0").images
    assert [images[k].name for k in sorted(images)] == sorted(NAMES)  # not as threads ended
    assert 0 < found.error < 0.5 and found.num_points > 500
    views = views_by_name(load(tmp_path))
    views = [views[name.removesuffix(".png")] for name in NAMES]
    for view in views:
        assert (view.width, view.height) == SIZE
        assert [view.fx, view.fy] == pytest.approx([FOCAL, FOCAL], rel=0.01)
    angles, distances = camera_errors(views, poses)
    assert angles.max() < 2e-3 and distances.max() < 0.005


def camera_errors(views, poses):
    """Angles (radians) and distances (of the farthest camera's from the middle), aligned.

    poses: (V, 4, 4) camera to world, OpenGL axes: the true ones.
    """
    found, true = np.array([view.camera_to_world for view in views]), poses * [1, -1, -1, 1]
    turns = Rotation.from_matrix(true[:, :3, :3] @ found[:, :3, :3].transpose(0, 2, 1))
    angles = (turns * turns.mean().inv()).magnitude()
    found, true = (each[:, :3, 3] - each[:, :3, 3].mean(axis=0) for each in (found, true))
    found = turns.mean().apply(found)
    scale = np.sum(found * true) / np.sum(found**2)
    distances = np.linalg.norm(scale * found - true, axis=1)
    return angles, distances / np.linalg.norm(true, axis=1).max()


@pytest.mark.slow
@pytest.mark.skipif(not FOX.is_dir(), reason="the shared data folder is not here")
def test_global_mapping_repeats_with_the_lens_that_it_found(tmp_path):
    """COLMAP guesses 576 px where 344 are right: the first pass misplaces one by 0.8."""
    pytest.importorskip("pycolmap")
    frames = json.loads((FOX / "transforms.json").read_text())["frames"]
    poses = {Path(f["file_path"]).stem: np.array(f["transform_matrix"]) for f in frames}
    (tmp_path / "images").mkdir()
    for name in sorted(poses)[::2]:
        (tmp_path / "images" / f"{name}.jpg").symlink_to(FOX / "images" / f"{name}.jpg")
    found = search(tmp_path, mapper="global")
    assert len(found.names) == 25 and found.error < 0.5
    views = views_by_name(load(tmp_path))
    angles, distances = camera_errors(list(views.values()), np.array([poses[n] for n in views]))
    # The dataset's principal point is 4 px from COLMAP's, which is 0.01 of the focal length: all
    # cameras are turned by as much.
    assert angles.max() < 0.02 and distances.max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mapper", "other"), [("incremental", "global"), ("global", "incremental")]
)
def test_plain_images_have_no_cameras_and_leave_no_files(tmp_path, mapper, other):
    pytest.importorskip("pycolmap")
    for k in range(3):
        save(tmp_path / f"{k}.png", (64, 48))
    message = f"no cameras were found; take more photographs, neither .* --mapper {other}$"
    with pytest.raises(UserError, match=message):
        search(tmp_path, mapper=mapper)
    assert names_in(tmp_path) == {"0.png", "1.png", "2.png"}


class FakeModel:
    """A reconstruction: ``shared[a, b]`` points are seen by the photographs a and b alone."""

    def __init__(self, count, shared):
        self.placed, tracks = set(range(5, 5 + count)), []
        for pair, number in shared.items():
            seen = [SimpleNamespace(image_id=5 + k) for k in (*pair, pair[0])]
            tracks += [SimpleNamespace(track=SimpleNamespace(elements=seen))] * number
        self.points3D = dict(enumerate(tracks))

    def reg_image_ids(self):
        return list(self.placed)

    def num_reg_images(self):
        return len(self.placed)

    def image(self, number):
        return SimpleNamespace(frame_id=10 * number)

    def deregister_frame(self, number):
        self.placed.remove(number // 10)


@pytest.mark.parametrize(
    ("shared", "expected"),
    [
        ({(0, 1): 30, (1, 2): 30, (3, 4): 90}, {0, 1, 2}),
        ({(0, 1): 30, (1, 2): 29, (3, 4): 90, (2, 4): 30}, {2, 3, 4}),
        ({(0, 1): 30, (1, 2): 30, (0, 3): 30, (3, 4): 30}, {0, 1, 2, 3, 4}),
    ],
)
def test_photographs_that_share_few_points_with_the_others_are_left_out(shared, expected):
    model = FakeModel(5, shared)
    assert sfm._keep_connected(model) == len(expected)  # private, as above
    assert model.placed == {5 + k for k in expected}


def steps_of(folder, names, **settings):
    reconstruction = sfm._Reconstruction  # private: a whole search takes minutes
    folders = folder / "work", folder, folder
    return reconstruction(*folders, names, SfmSettings(**settings))


def test_colmap_gets_the_masks_of_a_fit(tmp_path):
    """Black or white, of larger photographs scaled; white where there are none."""
    grey = np.repeat([[100, 150]], 6, axis=0).repeat(4, axis=1).astype(np.uint8)
    larger = np.repeat([[255], [0]], 6, axis=0).repeat(16, axis=1).astype(np.uint8)
    names = ["a.jpg", "b.jpg", "c.jpg"]
    for name in names:
        save(tmp_path / name)
    (tmp_path / "masks").mkdir()
    for name, mask in (("a.jpg.png", grey), ("a.png", 0 * grey), ("b.png", larger)):
        Image.fromarray(mask).save(tmp_path / "masks" / name)
    given = steps_of(tmp_path, names)._masks_for_all()  # private: a step of a search
    first, second, third = (np.asarray(Image.open(given / f"{name}.png")) for name in names)
    np.testing.assert_array_equal(first, np.where(grey > 127, 255, 0))
    np.testing.assert_array_equal(second, larger[::2, ::2])
    assert third.shape == (6, 8) and (third == 255).all()


def test_photographs_of_one_size_and_lens_share_a_camera(tmp_path):
    focals, exif = {"a.jpg": 35.0, "b.jpg": 35.0, "c.jpg": 70.0, "d.jpg": 35.0}, Image.Exif()
    names = list(focals)
    for name, focal in focals.items():
        exif.get_ifd(0x8769)[0x920A] = focal
        save(tmp_path / name, (48, 64) if name == "d.jpg" else (64, 48), exif=exif)

    def groups(names, share):
        return steps_of(tmp_path, names, share=share)._groups()  # private: a step of a search

    assert groups(names, "alike") == [["a.jpg", "b.jpg"], ["c.jpg"], ["d.jpg"]]
    assert groups(names[:3], "one") == [names[:3]]
    assert groups(names, "each") == [[name] for name in names]
    with pytest.raises(UserError, match=r"one size, got 48 x 64 and 64 x 48 px; use --share alike"):
        groups(names, "one")


def test_few_photographs_are_matched_exhaustively_and_many_selectively(tmp_path):
    def pairs(count, compare="auto"):
        steps = steps_of(tmp_path, range(count), compare=compare)
        return set(steps._pairs())  # private: a step of a search

    many = ALL_PAIRS + 1
    assert len(pairs(ALL_PAIRS)) == ALL_PAIRS * (ALL_PAIRS - 1) // 2
    assert len(pairs(many, "all")) == many * (many - 1) // 2
    expected = {
        (i, j)
        for i, j in itertools.combinations(range(many), 2)
        if j - i <= 10 or j - i in (16, 32, 64) or i % 8 == j % 8 == 0
    }
    assert pairs(many) == pairs(many, "neighbours") == expected


@pytest.mark.parametrize(
    ("settings", "count", "options"),
    [
        (SfmSettings(), ALL_PAIRS, "--share one or --camera-model SIMPLE_RADIAL or "),
        (SfmSettings(), ALL_PAIRS + 1, "--compare all or --share one"),
        (SfmSettings("SIMPLE_RADIAL", "all", "one"), 999, "--camera-model OPENCV_FISHEYE (a fish"),
    ],
)
def test_offered_options_differ_from_the_given_ones(settings, count, options):
    assert settings.alternative_options(count).startswith(options)


def test_names_are_sorted_by_number_and_masks_are_not_photographs(tmp_path):
    for name in ("2.png", "10.png", "1.JPG", "b/3.png", "2_mask.png", "10.png.mask.png"):
        save(tmp_path / "images" / name, format="PNG")
    (tmp_path / "images" / "notes.txt").touch()
    images, names = photographs_in(tmp_path)
    assert images == tmp_path / "images" and names == ["1.JPG", "2.png", "10.png", "b/3.png"]


def test_files_that_colmap_does_not_read_are_left_out_with_a_note(tmp_path):
    for name in ("b.jpg", "a.tif", "c.webp"):
        save(tmp_path / name)
    for name in ("a.heic", "b.DNG", "._b.jpg"):
        (tmp_path / name).touch()
    message = r"left out, as COLMAP does not read them: a\.heic, b\.DNG, c"
    with pytest.warns(UserNote, match=message):
        assert photographs_in(tmp_path)[1] == ["a.tif", "b.jpg"]
    (tmp_path / "a.tif").unlink()
    (tmp_path / "b.jpg").unlink()
    with pytest.raises(UserError, match=r"got a\.heic, .*, which COLMAP does not read; convert"):
        photographs_in(tmp_path)


UNREADABLE = {
    "a\udcff.png": (lambda path: save(path), r"COLMAP knows names in UTF-8 only; rename it"),
    "a.png": (lambda path: path.write_bytes(b"no image"), r"a\.png: cannot read the image"),
    "a.jpg": (lambda path: Image.new("CMYK", (8, 8)).save(path), r"Pillow's mode CMYK; convert it"),
    "a.tif": (
        lambda path: Image.new("1", (8193, 8192)).save(path, compression="group4"),
        r"at most 67,108,864 pixels, got 8193 x 8192",
    ),
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_unreadable_photograph_is_refused_before_the_search(tmp_path, name):
    write, message = UNREADABLE[name]
    write(tmp_path / name)
    with pytest.raises(UserError, match=message):
        photographs_in(tmp_path)


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (None, r"needs pycolmap, which is not installed; pip install 'drgs\[colmap\]'"),
        ("installed", r"COLMAP reports: \[reader.cc:1\] no such image; if memory"),
    ],
)
def test_errors_of_colmap_are_one_line(tmp_path, monkeypatch, module, message):
    if module is None:
        monkeypatch.setitem(sys.modules, "pycolmap", None)
    else:
        pytest.importorskip("pycolmap")
    # The function of the child process, which would not have what is set here.
    steps = sfm._Reconstruction  # private, as above
    error = RuntimeError("[reader.cc:1]\nno such image")
    monkeypatch.setattr(steps, "largest", Mock(side_effect=error))
    task = steps(tmp_path, tmp_path, tmp_path, [], SfmSettings())
    with pytest.raises(UserError, match=message) as error:
        task.run(lambda *step: None)
    assert "\n" not in str(error.value)


@pytest.fixture
def write_model(tmp_path, monkeypatch):
    """Searches a folder of three photographs: finds a model whose files hold ``content``.

    act: is called with the temporary folder before the model is written.
    """
    for k in range(3):
        save(tmp_path / f"{k}.png")

    def found(content, replace=False, act=lambda temporary: None):
        def run(function, task, **_):
            act(task.folder)
            (task.folder / "model").mkdir()
            for name in MODEL_FILES:
                (task.folder / "model" / name).write_text(content)
            return content

        monkeypatch.setattr(sfm, "run_in_child", run)
        return search(tmp_path, replace)

    return found


def model_in(folder):
    """Names and texts of ``sparse/0``, without the record."""
    files = (folder / "sparse" / "0").iterdir()
    return {path.name: path.read_text() for path in files if path.name != ".drgs-poses.json"}


def model(content):
    return dict.fromkeys(MODEL_FILES, content)


def test_a_model_is_replaced_only_on_request_and_other_files_are_kept(write_model, tmp_path):
    own = {"notes.txt": "mine", "project.ini": "COLMAP's", "cameras.txt": "a copy"}
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    for name, text in own.items():
        (tmp_path / "sparse" / "0" / name).write_text(text)
    assert write_model("first") == "first"
    with pytest.raises(UserError, match=r"sparse/0: is there already; .*--overwrite writes "):
        write_model("second")
    assert model_in(tmp_path) == own | model("first")
    write_model("second", replace=True)
    assert model_in(tmp_path) == own | model("second")


@pytest.mark.parametrize("below", ["sparse", "colmap/sparse/0"])
def test_a_model_elsewhere_in_the_folder_is_reported(tmp_path, below):
    folder = tmp_path / "my photos"
    write_dataset(folder, below=below)
    message = rf"{below}: is there already; drgs fit '.*my photos' uses it, --overwrite writes "
    with pytest.raises(UserError, match=message):
        search(folder)


def test_a_model_of_another_program_is_not_replaced(write_model, tmp_path):
    folder = tmp_path / "sparse" / "0"
    theirs = dict.fromkeys(("cameras.bin", "images.bin"), "COLMAP's")
    folder.mkdir(parents=True)
    for name, text in theirs.items():
        (folder / name).write_text(text)
    with pytest.raises(UserError, match=r"sparse/0: holds cameras\.bin, images\.bin, which .*move"):
        write_model("new", replace=True)
    assert model_in(tmp_path) == theirs
    for name in theirs:
        (folder / name).unlink()
    write_model("new")
    (folder / "points3D.bin").write_text("refined")
    with pytest.raises(UserError, match=r"sparse/0: holds points3D\.bin, which .*changed since"):
        write_model("newer", replace=True)


@pytest.mark.parametrize("name", ["sparse", "sparse/0"])
def test_file_in_place_of_the_model_is_refused_before_the_search(write_model, tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match=rf"{name}: must be a folder, got something else; move"):
        write_model("new", replace=True, act=lambda temporary: pytest.fail("searched"))
    assert (tmp_path / name).read_text() == "mine"


def test_temporary_files_of_a_killed_run_are_removed(write_model, tmp_path):
    for below in (".", "sparse", "sparse/0"):
        (tmp_path / below / ".drgs-poses-abc" / "masks").mkdir(parents=True)
    (tmp_path / ".poses-notes").mkdir()  # somebody's
    message = "another command is writing to this folder"
    with sole_writer(tmp_path), pytest.raises(UserError, match=message):
        write_model("new")
    assert len(list(tmp_path.rglob(".drgs-poses-abc"))) == 3
    write_model("new")
    assert not list(tmp_path.rglob(".drgs-poses-*/"))
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == {"sparse", ".poses-notes"}


def test_run_killed_while_moving_files_leaves_no_mixed_model(write_model, tmp_path, monkeypatch):
    write_model("first")
    replace, replaced = Path.replace, []

    def killed(self, target):
        if len(replaced) == 2:
            raise MemoryError
        replaced.append(target)
        return replace(self, target)

    with monkeypatch.context() as context, pytest.raises(MemoryError):
        context.setattr(Path, "replace", killed)
        write_model("second", replace=True)
    assert "images.bin" not in model_in(tmp_path)
    write_model("third")
    assert model_in(tmp_path) == model("third")


def test_a_crash_is_reported_and_leaves_no_files(write_model, tmp_path):
    def crash(temporary):
        (temporary / "database.db").touch()
        raise ChildEndedError("SIGKILL")

    with pytest.raises(UserError, match=r"structure from motion was ended: SIGKILL; if memory"):
        write_model("new", act=crash)
    assert names_in(tmp_path) == {"0.png", "1.png", "2.png"}


def test_temporary_files_are_on_the_same_disk_as_the_model(write_model, tmp_path):
    """``sparse`` may be a link to another one, to which nothing can be moved."""
    elsewhere = tmp_path / "other disk"
    elsewhere.mkdir()
    (tmp_path / "sparse").symlink_to(elsewhere)
    places = []
    write_model("new", act=lambda temporary: places.append(temporary.resolve()))
    assert [path.parent for path in places] == [elsewhere]
    assert model_in(tmp_path) == model("new")
