"""Structure from motion: cameras as images were taken with, or why there are none."""

import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from support.colmap_models import write_dataset
from support.datasets import load
from support.textured_corner import FOCAL, SIZE, write_photographs

from drgs.core.child_process import ChildEndedError
from drgs.core.errors import UserError, UserNote
from drgs.core.folders import sole_writer
from drgs.poses import structure_from_motion as sfm
from drgs.poses.structure_from_motion import SfmSettings, photographs_in, reconstruct

NAMES = [f"corner {k}.png" for k in range(7, 14)]  # 10 follows 9, and has a space


def ignore_progress(*_):
    """Ignore the progress."""


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    """A folder, what was found in it, the poses, and what was watched."""
    pytest.importorskip("pycolmap")
    folder = tmp_path_factory.mktemp("corner")
    poses = write_photographs(folder, NAMES)
    watched = []
    found = reconstruct(
        folder, SfmSettings(camera_model="PINHOLE"), False, lambda *step: watched.append(step)
    )
    return folder, found, poses, watched


@pytest.mark.slow
def test_true_cameras_are_recovered(placed):
    """Up to a similarity. Features are found to a tenth of a pixel: an angle of 3e-4."""
    folder, found, poses, _ = placed
    assert found.names == tuple(NAMES) and found.missing == ()
    assert 0 < found.error < 0.5 and found.num_points > 500
    dataset = load(folder)
    views = {view.name: view for view in (*dataset.train, *dataset.test)}
    views = [views[name.removesuffix(".png")] for name in NAMES]
    for view in views:
        assert (view.width, view.height) == SIZE
        assert [view.fx, view.fy] == pytest.approx([FOCAL, FOCAL], rel=0.01)
    true = np.array([pose[:3, 3] for pose in poses])
    centers = np.array([view.camera_to_world[:3, 3] for view in views])
    true_rotations = [pose[:3, :3] @ np.diag([1, -1, -1]) for pose in poses]
    turns = [a @ v.camera_to_world[:3, :3].T for a, v in zip(true_rotations, views, strict=True)]
    turn = Rotation.from_matrix(turns).mean()
    angles = (Rotation.from_matrix(turns) * turn.inv()).magnitude()
    assert angles.max() < 2e-3
    around = turn.apply(centers - centers.mean(axis=0))
    true = true - true.mean(axis=0)
    scale = np.sum(around * true) / np.sum(around**2)
    assert np.abs(scale * around - true).max() < 0.005 * np.linalg.norm(true, axis=1).max()


@pytest.mark.slow
def test_progress_of_every_step_is_reported(placed):
    _, _, _, watched = placed
    for what, total in (("photograph", 7), ("pair of photographs", 21), ("camera", 7)):
        steps = [step for step in watched if step[0] == what]
        assert steps[-1] == (what, total, total)


@pytest.mark.slow
def test_only_the_model_is_left(placed):
    folder, _, _, _ = placed
    assert {path.name for path in folder.iterdir()} == {*NAMES, "sparse"}
    files = {path.name for path in (folder / "sparse" / "0").iterdir()}
    assert files == {*sfm.MODEL_FILES, ".drgs-poses.json"}


@pytest.mark.slow
def test_plain_images_have_no_cameras_and_leave_no_files(tmp_path):
    pytest.importorskip("pycolmap")
    for k in range(3):
        Image.new("RGB", (64, 48), (40 * k, 20, 90)).save(tmp_path / f"{k}.png")
    with pytest.raises(UserError, match="no cameras were found; take more photographs, neither"):
        reconstruct(tmp_path, SfmSettings(), False, ignore_progress)
    assert {path.name for path in tmp_path.iterdir()} == {"0.png", "1.png", "2.png"}


@pytest.mark.slow
def test_photographs_without_a_mask_are_used(tmp_path):
    pytest.importorskip("pycolmap")
    names = ["a.png", "b.png", "c.png", "d.png"]
    write_photographs(tmp_path, names)
    (tmp_path / "masks").mkdir()
    Image.new("L", SIZE, 255).save(tmp_path / "masks" / "b.png.png")
    assert reconstruct(tmp_path, SfmSettings(), False, ignore_progress).names == tuple(names)


def masks_for_colmap(folder, masks):
    """Return COLMAP's masks of photographs of 8 x 6 px; masks: (H, W) by name of the file."""
    (folder / "masks").mkdir(exist_ok=True)
    for name, mask in masks.items():
        Image.fromarray(np.uint8(mask)).save(folder / "masks" / name)
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        Image.new("RGB", (8, 6)).save(folder / name)
    some = work(folder, ["a.jpg", "b.jpg", "c.jpg"])
    some.folder = folder / "work"
    given = some._masks_for_all()
    return [np.asarray(Image.open(given / f"{name}.png")) for name in some.names]


def test_masks_are_found_under_common_names(tmp_path):
    """Fits find them by the same names; transparent pixels do not count."""
    alpha = Image.new("LA", (8, 6), (255, 255))
    alpha.putpixel((3, 2), (255, 0))
    (tmp_path / "masks").mkdir()
    alpha.save(tmp_path / "masks" / "c_mask.png")
    first, second, third = np.zeros((3, 6, 8))
    first[0], second[1], third[2] = 255, 255, 255
    masks = masks_for_colmap(tmp_path, {"a.jpg.png": first, "a.png": second, "b.png": third})
    expected = np.full((6, 8), 255)
    expected[2, 3] = 0
    np.testing.assert_array_equal(masks, [first, third, expected])


def test_masks_are_read_like_in_a_fit(tmp_path):
    """Black or white, and of larger photographs scaled: COLMAP would look elsewhere in them."""
    grey = np.repeat([[100, 150]], 6, axis=0).repeat(4, axis=1)
    larger = np.zeros((12, 16))
    larger[:6] = 255
    masks = masks_for_colmap(tmp_path, {"a.jpg.png": grey, "b.jpg.png": larger})
    np.testing.assert_array_equal(masks[0], np.where(grey > 127, 255, 0))
    np.testing.assert_array_equal(masks[1], larger[::2, ::2])


def test_a_mask_of_another_shape_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"b\.jpg\.png: must be 8 x 6 px, as the ph.*, got 6 x 8"):
        masks_for_colmap(tmp_path, {"b.jpg.png": np.zeros((8, 6))})


def test_photographs_of_two_sizes_share_no_camera(tmp_path):
    for k, size in enumerate([(64, 48), (48, 64), (64, 48)]):
        Image.new("RGB", size).save(tmp_path / f"{k}.png")
    with pytest.raises(UserError, match=r"one size, got 48 x 64 and 64 x 48 px; use --share alike"):
        work(tmp_path, ["0.png", "1.png", "2.png"], share="one")._groups()


def test_missing_pycolmap_is_reported_with_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(
        UserError, match=r"needs pycolmap, which is not installed; pip install 'drgs\[colmap\]'"
    ) as error:
        sfm._reconstruct_in_child(SfmSettings(), tmp_path, tmp_path, [], tmp_path, ignore_progress)
    assert "\n" not in str(error.value)


def test_errors_of_colmap_are_one_line(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")

    def refuse(self):
        raise RuntimeError("[reader.cc:1]\nno such image")

    monkeypatch.setattr(sfm._Reconstruction, "largest", refuse)
    with pytest.raises(
        UserError, match=r"COLMAP reports: \[reader.cc:1\] no such image; if memory"
    ):
        sfm._reconstruct_in_child(SfmSettings(), tmp_path, tmp_path, [], tmp_path, ignore_progress)


# ----------------------------------------------------------------------------------------------
# Replaced and leftover files
# ----------------------------------------------------------------------------------------------


@pytest.fixture
def search(tmp_path, monkeypatch):
    """Searches a folder of three photographs: finds a model whose files hold ``content``.

    act: is called with the temporary folder before the model is written.
    """
    for k in range(3):
        Image.new("RGB", (8, 8)).save(tmp_path / f"{k}.png")

    def found(content, replace=False, act=lambda temporary: None):
        def run(function, search, images, folder, names, temporary, **_):
            act(temporary)
            (temporary / "model").mkdir()
            for name in sfm.MODEL_FILES:
                (temporary / "model" / name).write_text(content)
            return content

        monkeypatch.setattr(sfm, "run_in_child", run)
        return reconstruct(tmp_path, SfmSettings(), replace, ignore_progress)

    return found


def model_in(folder):
    """Names and texts of ``sparse/0``, without the record."""
    files = (folder / "sparse" / "0").iterdir()
    return {path.name: path.read_text() for path in files if path.name != ".drgs-poses.json"}


def test_a_model_is_replaced_only_on_request(search, tmp_path):
    assert search("first") == "first"
    with pytest.raises(UserError, match=r"sparse/0: is there already; .*--overwrite writes "):
        search("second")
    assert model_in(tmp_path) == dict.fromkeys(sfm.MODEL_FILES, "first")
    search("second", replace=True)
    assert model_in(tmp_path) == dict.fromkeys(sfm.MODEL_FILES, "second")


def test_other_files_beside_a_model_are_kept(search, tmp_path):
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    own = {"notes.txt": "mine", "project.ini": "COLMAP's", "cameras.txt": "a copy"}
    for name, text in own.items():
        (model / name).write_text(text)
    for content in ("first", "second"):
        search(content, replace=True)
        assert model_in(tmp_path) == own | dict.fromkeys(sfm.MODEL_FILES, content)


def test_a_model_of_another_program_is_not_replaced(search, tmp_path):
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    for name in ("cameras.bin", "images.bin"):
        (model / name).write_text("COLMAP's")
    with pytest.raises(UserError, match=r"drgs fit .* uses it, --overwrite writes"):
        search("new")
    with pytest.raises(UserError, match=r"sparse/0: holds cameras\.bin, images\.bin, which .*move"):
        search("new", replace=True)
    assert model_in(tmp_path) == dict.fromkeys(("cameras.bin", "images.bin"), "COLMAP's")
    for name in ("cameras.bin", "images.bin"):
        (model / name).unlink()
    search("new")
    (model / "points3D.bin").write_text("refined")
    with pytest.raises(UserError, match=r"sparse/0: holds points3D\.bin, which .*changed since"):
        search("newer", replace=True)


@pytest.mark.parametrize("name", ["sparse", "sparse/0"])
def test_file_in_place_of_the_model_is_refused_before_the_search(search, tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match=rf"{name}: must be a folder, got something else; move"):
        search("new", replace=True, act=lambda temporary: pytest.fail("searched"))
    assert (tmp_path / name).read_text() == "mine"


def test_temporary_files_of_a_killed_run_are_removed(search, tmp_path):
    for below in (".", "sparse", "sparse/0"):
        (tmp_path / below / ".drgs-poses-abc" / "masks").mkdir(parents=True)
    (tmp_path / ".poses-notes").mkdir()  # somebody's
    message = "another command is writing to this folder"
    with sole_writer(tmp_path), pytest.raises(UserError, match=message):
        search("new")
    assert len(list(tmp_path.rglob(".drgs-poses-abc"))) == 3
    search("new")
    assert not list(tmp_path.rglob(".drgs-poses-*/"))
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == {"sparse", ".poses-notes"}


def test_a_second_search_in_the_same_folder_is_refused(search, tmp_path):
    def second(temporary):
        with pytest.raises(UserError, match="another command is writing to this folder; wait"):
            reconstruct(tmp_path, SfmSettings(), True, ignore_progress)
        assert temporary.is_dir()

    search("first", act=second)
    assert model_in(tmp_path) == dict.fromkeys(sfm.MODEL_FILES, "first")


def test_interrupt_while_moving_files_leaves_a_complete_model(search, tmp_path, monkeypatch):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    replace = Path.replace

    def interrupted(self, target):
        signal.raise_signal(signal.SIGINT)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", interrupted)
    try:
        with pytest.raises(KeyboardInterrupt):
            search("new")
    finally:
        signal.signal(signal.SIGINT, before)
    assert model_in(tmp_path) == dict.fromkeys(sfm.MODEL_FILES, "new")
    assert not list(tmp_path.glob(".drgs-*"))


def test_run_killed_while_moving_files_leaves_no_mixed_model(search, tmp_path, monkeypatch):
    search("first")
    replace, replaced = Path.replace, []

    def killed(self, target):
        if len(replaced) == 2:
            raise MemoryError
        replaced.append(target)
        return replace(self, target)

    with monkeypatch.context() as context, pytest.raises(MemoryError):
        context.setattr(Path, "replace", killed)
        search("second", replace=True)
    assert "images.bin" not in model_in(tmp_path)
    search("third")
    assert model_in(tmp_path) == dict.fromkeys(sfm.MODEL_FILES, "third")


def test_a_crash_is_reported_and_leaves_no_files(search, tmp_path):
    def crash(temporary):
        (temporary / "database.db").touch()
        raise ChildEndedError("SIGKILL")

    with pytest.raises(UserError, match=r"structure from motion was ended: SIGKILL; if memory"):
        search("new", act=crash)
    assert {path.name for path in tmp_path.iterdir()} == {"0.png", "1.png", "2.png"}


def test_temporary_files_are_on_the_same_disk_as_the_model(search, tmp_path):
    """``sparse`` may be a link to another one, to which nothing can be moved."""
    elsewhere = tmp_path / "other disk"
    elsewhere.mkdir()
    (tmp_path / "sparse").symlink_to(elsewhere)
    places = []
    search("new", act=lambda temporary: places.append(temporary.resolve()))
    assert [path.parent for path in places] == [elsewhere]
    assert model_in(tmp_path) == dict.fromkeys(sfm.MODEL_FILES, "new")


# ----------------------------------------------------------------------------------------------
# Matched pairs and shared cameras
# ----------------------------------------------------------------------------------------------


def work(folder, names, **search):
    return sfm._Reconstruction(
        None, folder, folder, folder, names, SfmSettings(**search), ignore_progress
    )


def test_masks_beside_photographs_are_not_photographs(tmp_path):
    for name in ("a.jpg", "a_mask.png", "b.jpg", "b.jpg.mask.png", "face_mask.jpg"):
        Image.new("RGB", (8, 6)).save(tmp_path / name)
    assert photographs_in(tmp_path)[1] == ["a.jpg", "b.jpg", "face_mask.jpg"]


def test_names_are_sorted_by_number(tmp_path):
    for name in ("2.png", "10.png", "1.JPG", "b/3.png", "notes.txt"):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 8)).save(tmp_path / "images" / name, format="PNG")
    images, names = photographs_in(tmp_path)
    assert images == tmp_path / "images" and names == ["1.JPG", "2.png", "10.png", "b/3.png"]
    (tmp_path / "images" / "10.png").write_bytes(b"not an image")
    with pytest.raises(UserError, match=r"10\.png: cannot read the image"):
        photographs_in(tmp_path)


def test_non_utf_8_name_is_refused(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    (tmp_path / "a.png").rename(tmp_path / "a\udcff.png")
    with pytest.raises(UserError, match=r"COLMAP knows names in UTF-8 only; rename it"):
        photographs_in(tmp_path)


def test_files_that_colmap_does_not_read_are_left_out_with_a_note(tmp_path):
    for name in ("b.jpg", "a.tif", "c.webp"):
        Image.new("RGB", (8, 8)).save(tmp_path / name)
    for name in ("a.heic", "b.DNG", "._b.jpg"):
        (tmp_path / name).write_bytes(b"")
    with pytest.warns(
        UserNote, match=r"left out, as COLMAP does not read them: a\.heic, b\.DNG, c"
    ):
        assert photographs_in(tmp_path)[1] == ["a.tif", "b.jpg"]
    (tmp_path / "a.tif").unlink()
    (tmp_path / "b.jpg").unlink()
    with pytest.raises(UserError, match=r"got a\.heic, .*, which COLMAP does not read; convert"):
        photographs_in(tmp_path)


@pytest.mark.parametrize(("mode", "size", "message"), [
    ("CMYK", (8, 8), r"Pillow's mode CMYK; convert it"),
    ("1", (8193, 8192), r"at most 67,108,864 pixels, got 8193 x 8192"),
])  # fmt: skip
def test_unreadable_images_are_refused_before_reconstruction(tmp_path, mode, size, message):
    Image.new(mode, size).save(tmp_path / "a.tif", compression="group4" if mode == "1" else None)
    with pytest.raises(UserError, match=message):
        photographs_in(tmp_path)


@pytest.mark.parametrize("below", ["sparse", "colmap/sparse/0"])
def test_a_model_elsewhere_in_the_folder_is_reported(tmp_path, below):
    folder = tmp_path / "my photos"
    write_dataset(folder, below=below)
    message = rf"{below}: is there already; drgs fit '.*my photos' uses it, --overwrite writes "
    with pytest.raises(UserError, match=message):
        reconstruct(folder, SfmSettings(), False, ignore_progress)


def test_offered_options_differ_from_the_given_ones():
    few, many = sfm.ALL_PAIRS, sfm.ALL_PAIRS + 1
    assert "--compare all" not in SfmSettings().alternative_options(few) + SfmSettings(
        compare="all"
    ).alternative_options(many)
    assert "--compare all" in SfmSettings().alternative_options(many) + SfmSettings(
        compare="neighbours"
    ).alternative_options(few)
    assert "--share one" in SfmSettings().alternative_options(
        9
    ) and "--camera-model SIMPLE" in SfmSettings().alternative_options(9)
    assert SfmSettings("SIMPLE_RADIAL", "all", "one").alternative_options(9) == (
        "--camera-model OPENCV_FISHEYE (a fisheye)"
    )


def test_photographs_of_one_size_and_lens_share_a_camera(tmp_path):
    def write(name, size, focal=None):
        exif = Image.Exif()
        if focal is not None:
            exif.get_ifd(0x8769)[0x920A] = focal
        Image.new("RGB", size).save(tmp_path / name, exif=exif)

    write("a.jpg", (64, 48), 35.0)
    write("b.jpg", (64, 48), 35.0)
    write("c.jpg", (64, 48), 70.0)
    write("d.jpg", (48, 64), 35.0)
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    assert work(tmp_path, names)._groups() == [["a.jpg", "b.jpg"], ["c.jpg"], ["d.jpg"]]
    assert work(tmp_path, names[:3], share="one")._groups() == [names[:3]]
    assert work(tmp_path, names, share="each")._groups() == [[name] for name in names]


def test_few_photographs_are_matched_exhaustively_and_many_selectively(tmp_path):
    few, many = sfm.ALL_PAIRS, sfm.ALL_PAIRS + 1
    assert len(list(work(tmp_path, range(few))._pairs())) == few * (few - 1) // 2
    pairs = set(work(tmp_path, range(many))._pairs())
    assert pairs == set(work(tmp_path, range(few + 1), compare="neighbours")._pairs())
    assert len(set(work(tmp_path, range(many), compare="all")._pairs())) == many * (many - 1) // 2
    for i in range(many):
        for j in range(i + 1, many):
            expected = j - i <= 10 or j - i in (16, 32, 64) or i % 8 == j % 8 == 0
            assert ((i, j) in pairs) == expected
