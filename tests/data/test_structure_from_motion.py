"""Structure from motion: cameras as pictures were taken with, or why there are none."""

import _thread
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from support.colmap_models import write_dataset
from support.corner import FOCAL, SIZE, write_photographs
from support.datasets import load

from drgs.core.errors import UserError, UserNote
from drgs.data import structure_from_motion as sfm
from drgs.data.structure_from_motion import Search, pictures_in, place

NAMES = [f"corner {k}.png" for k in range(7, 14)]  # 10 follows 9, and has a space


def said(*_):
    """Watches, and says nothing."""


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    """A folder, what was found in it, the poses, and what was watched."""
    pytest.importorskip("pycolmap")
    folder = tmp_path_factory.mktemp("corner")
    poses = write_photographs(folder, NAMES)
    watched = []
    found = place(folder, Search(camera_model="PINHOLE"), False, lambda *step: watched.append(step))
    return folder, found, poses, watched


def test_cameras_are_those_that_pictures_were_taken_with(placed):
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


def test_steps_are_watched(placed):
    _, _, _, watched = placed
    for what, total in (("photograph", 7), ("pair of photographs", 21), ("camera", 7)):
        steps = [step for step in watched if step[0] == what]
        assert steps[-1] == (what, total, total)


def test_nothing_but_the_model_is_left_behind(placed):
    folder, _, _, _ = placed
    assert {path.name for path in folder.iterdir()} == {*NAMES, "sparse"}


def test_a_model_is_replaced_only_when_that_is_asked_for(placed, monkeypatch):
    folder, _, _, _ = placed
    model = folder / "sparse" / "0"
    before = (model / "images.bin").read_bytes()
    with pytest.raises(UserError, match=r"sparse/0: is there already; .*--overwrite replaces it"):
        place(folder, Search(), False, said)
    assert (model / "images.bin").read_bytes() == before

    class Found:
        def write_binary(self, path):
            (path / "images.bin").write_bytes(b"new")

    monkeypatch.setattr(sfm._Work, "model", lambda self: (Found(), 1))
    monkeypatch.setattr(sfm, "_described", lambda *_: None)
    place(folder, Search(), True, said)
    try:
        assert [path.name for path in model.iterdir()] == ["images.bin"]
        assert (model / "images.bin").read_bytes() == b"new"
    finally:
        (model / "images.bin").write_bytes(before)


def test_pictures_of_nothing_have_no_cameras_and_leave_nothing_behind(tmp_path):
    pytest.importorskip("pycolmap")
    for k in range(3):
        Image.new("RGB", (64, 48), (40 * k, 20, 90)).save(tmp_path / f"{k}.png")
    with pytest.raises(
        UserError, match="no cameras were found: 3 of 3 photographs have hardly any"
    ):
        place(tmp_path, Search(), False, said)
    assert {path.name for path in tmp_path.iterdir()} == {"0.png", "1.png", "2.png"}


def test_photographs_without_a_mask_are_looked_at_as_well(tmp_path):
    pytest.importorskip("pycolmap")
    names = ["a.png", "b.png", "c.png", "d.png"]
    write_photographs(tmp_path, names)
    (tmp_path / "masks").mkdir()
    Image.new("L", SIZE, 255).save(tmp_path / "masks" / "b.png.png")
    assert place(tmp_path, Search(), False, said).names == tuple(names)


def test_masks_are_found_by_either_name(tmp_path):
    """COLMAP gets black and white, whatever their files are."""
    (tmp_path / "masks").mkdir()
    alpha = Image.new("LA", (8, 8), (255, 255))
    alpha.putpixel((3, 2), (255, 0))
    alpha.save(tmp_path / "masks" / "b_mask.png")
    for name, level in (("a.jpg.png", 200), ("a.png", 20)):
        Image.new("L", (8, 8), level).save(tmp_path / "masks" / name)
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        Image.new("RGB", (8, 8)).save(tmp_path / name)
    some = work(tmp_path, ["a.jpg", "b.jpg", "c.jpg"])
    some.folder = tmp_path / "work"
    masks = some._masks_for_all()
    written = [np.asarray(Image.open(masks / f"{name}.png")) for name in some.names]
    expected = np.full((3, 8, 8), 255)
    expected[1, 2, 3] = 0
    np.testing.assert_array_equal(written, expected)


def test_photographs_of_two_sizes_share_no_camera(tmp_path):
    for k, size in enumerate([(64, 48), (48, 64), (64, 48)]):
        Image.new("RGB", size).save(tmp_path / f"{k}.png")
    with pytest.raises(UserError, match=r"one size, got 48 x 64 and 64 x 48 px; use --share alike"):
        work(tmp_path, ["0.png", "1.png", "2.png"], share="one")._groups()


def test_without_pycolmap_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(
        UserError, match=r"needs pycolmap, which is not installed; pip install 'drgs\[colmap\]'"
    ) as error:
        place(tmp_path, Search(), False, said)
    assert "\n" not in str(error.value)


def test_ctrl_c_ends_a_step_that_runs_in_cpp(monkeypatch):
    class Token(threading.Event):
        cancel = threading.Event.set

    ended = []

    def step(cancellation_token):
        _thread.interrupt_main()
        ended.append(cancellation_token.wait(60))

    with pytest.raises(KeyboardInterrupt):
        sfm._until_done(SimpleNamespace(CancellationToken=Token), step)
    assert ended == [True]


def test_what_colmap_refuses_is_said_in_one_line():
    def step(cancellation_token):
        raise RuntimeError("[reader.cc:1]\nno such image")

    with pytest.raises(UserError, match=r"COLMAP says: \[reader.cc:1\] no such image$"):
        sfm._until_done(SimpleNamespace(CancellationToken=threading.Event), step)


# ----------------------------------------------------------------------------------------------
# What is compared, and what shares a camera
# ----------------------------------------------------------------------------------------------


def work(folder, names, **search):
    return sfm._Work(None, folder, folder, folder, names, Search(**search), said)


def test_names_are_in_the_order_of_their_numbers(tmp_path):
    for name in ("2.png", "10.png", "1.JPG", "b/3.png", "notes.txt"):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 8)).save(tmp_path / "images" / name, format="PNG")
    pictures, names = pictures_in(tmp_path)
    assert pictures == tmp_path / "images" and names == ["1.JPG", "2.png", "10.png", "b/3.png"]
    (tmp_path / "images" / "10.png").write_bytes(b"not a picture")
    with pytest.raises(UserError, match=r"10\.png: cannot read the image"):
        pictures_in(tmp_path)


def test_what_colmap_does_not_read_is_left_out_with_a_word(tmp_path):
    for name in ("b.jpg", "a.tif", "c.webp"):
        Image.new("RGB", (8, 8)).save(tmp_path / name)
    for name in ("a.heic", "b.DNG", "._b.jpg"):
        (tmp_path / name).write_bytes(b"")
    with pytest.warns(
        UserNote, match=r"left out, as COLMAP does not read them: a\.heic, b\.DNG, c"
    ):
        assert pictures_in(tmp_path)[1] == ["a.tif", "b.jpg"]
    (tmp_path / "a.tif").unlink()
    (tmp_path / "b.jpg").unlink()
    with pytest.raises(UserError, match=r"got a\.heic, .*, which COLMAP does not read; convert"):
        pictures_in(tmp_path)


@pytest.mark.parametrize(("mode", "size", "message"), [
    ("CMYK", (8, 8), r"Pillow's mode CMYK; convert it"),
    ("1", (8193, 8192), r"at most 67,108,864 pixels, got 8193 x 8192"),
])  # fmt: skip
def test_what_a_fit_refuses_is_refused_before_the_search(tmp_path, mode, size, message):
    Image.new(mode, size).save(tmp_path / "a.tif", compression="group4" if mode == "1" else None)
    with pytest.raises(UserError, match=message):
        pictures_in(tmp_path)


@pytest.mark.parametrize("below", ["sparse", "colmap/sparse/0"])
def test_a_model_elsewhere_in_the_folder_is_said_and_not_doubled(tmp_path, below, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", SimpleNamespace())
    folder = tmp_path / "my photos"
    write_dataset(folder, below=below)
    message = rf"{below}: is there already; drgs fit '.*my photos' uses it, --overwrite writes "
    with pytest.raises(UserError, match=message):
        place(folder, Search(), False, said)


def test_an_empty_folder_is_no_model_and_another_one_is_not_written_over(tmp_path):
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    sfm._check_free(tmp_path, model)
    (model / "notes.txt").touch()
    with pytest.raises(UserError, match=r"sparse/0: is there already, and holds no model"):
        sfm._check_free(tmp_path, model)


def test_options_that_are_offered_are_others():
    few, many = sfm.ALL_PAIRS, sfm.ALL_PAIRS + 1
    assert "--compare all" not in Search().others(few) + Search(compare="all").others(many)
    assert "--compare all" in Search().others(many) + Search(compare="neighbours").others(few)
    assert "--share one" in Search().others(9) and "--camera-model SIMPLE" in Search().others(9)
    assert Search("SIMPLE_RADIAL", "all", "one").others(9) == (
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


def test_few_photographs_are_compared_with_all_and_many_with_some(tmp_path):
    few, many = sfm.ALL_PAIRS, sfm.ALL_PAIRS + 1
    assert len(list(work(tmp_path, range(few))._pairs())) == few * (few - 1) // 2
    pairs = set(work(tmp_path, range(many))._pairs())
    assert pairs == set(work(tmp_path, range(few + 1), compare="neighbours")._pairs())
    assert len(set(work(tmp_path, range(many), compare="all")._pairs())) == many * (many - 1) // 2
    for i in range(many):
        for j in range(i + 1, many):
            expected = j - i <= 10 or j - i in (16, 32, 64) or i % 8 == j % 8 == 0
            assert ((i, j) in pairs) == expected
