"""Every kind of wrong input, through the command: status 2, one line, and nothing is written.

What exactly the line says is tested with the module that says it.
"""

import json
import os
import shutil
import struct
import subprocess
import tempfile
import zlib
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image
from support.fit_command import assert_fit_refused, assert_fits, write_scene
from support.folders import contents
from support.small_capture import blobs

from drgs.config.load import load_config
from drgs.core.errors import UserError
from drgs.datasets import load_dataset
from drgs.gaussians.parameters import Gaussians
from drgs.io.ply import read_points
from drgs.results.folder import claim_output_folder

SETTINGS = {
    "init": {"point_cloud": "points.ply"},
    "model": {"sh_degree": 0},
    "output": {"dir": "out", "save_renders": False},
    "iterations": 2,
}


def make_scene(folder):
    """A data set of 3 + 1 views, a point cloud and a configuration for them."""
    blobs(5).save(folder / "points.ply")
    write_scene(folder, **SETTINGS)
    return folder


@pytest.fixture
def scene(tmp_path):
    return make_scene(tmp_path)


CONFIG, POINTS, IMAGE = "a.yml", "points.ply", "data/train/r_1.png"
TRANSFORMS = "data/transforms_train.json"


def settings(**sections):
    """Another configuration."""

    def apply(folder):
        shutil.rmtree(folder / "data")
        write_scene(folder, **{**SETTINGS, **sections})

    return apply


def transforms(change):
    def apply(folder):
        meta = json.loads((folder / TRANSFORMS).read_text())
        change(meta)
        (folder / TRANSFORMS).write_text(json.dumps(meta))

    return apply


def matrix(change):
    return transforms(lambda meta: change(meta["frames"][1]["transform_matrix"]))


def write(name, content):
    return lambda folder: (folder / name).write_bytes(content)


def replace(old, new):
    """In the point cloud."""

    def apply(folder):
        content = (folder / POINTS).read_bytes()
        assert old in content
        (folder / POINTS).write_bytes(content.replace(old, new))

    return apply


def image_of(shape):
    return lambda folder: iio.imwrite(folder / IMAGE, np.zeros(shape, np.uint8))


def image_header_of(size):
    def apply(folder):
        content = bytearray((folder / IMAGE).read_bytes())
        content[16:24] = struct.pack(">II", size, size)
        content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
        (folder / IMAGE).write_bytes(content)

    return apply


def folder_in_place_of(name):
    def apply(folder):
        (folder / name).unlink()
        (folder / name).mkdir()

    return apply


def without(*names):
    return lambda folder: [(folder / name).unlink() for name in names]


def cut(name):
    return lambda folder: os.truncate(folder / name, (folder / name).stat().st_size - 100)


def points_with_nan(folder):
    gaussians = blobs(5)
    gaussians.means[3] = np.nan
    gaussians.save(folder / POINTS)


def bent_lens_and_exact_projection(folder):
    settings(model={"sh_degree": 0, "projection": "exact"})(folder)
    transforms(lambda meta: meta["frames"][1].update(k1=0.1))(folder)


WRONG_INPUTS = [
    (without(CONFIG), "a.yml: cannot read the configuration"),
    (folder_in_place_of(CONFIG), "a.yml: neither transforms_train.json"),
    (write(CONFIG, b"\xff"), "a.yml: cannot read the configuration: not UTF"),
    (write(CONFIG, b"a: ["), "a.yml: line 1: not valid YAML"),
    (write(CONFIG, b"a: &a [1,1]\nb: &b [*a,*a]\nc: &c [*b,*b]\n"), "a.yml: data is missing: "),
    (settings(data={"path": "a.yml"}), "cannot open the folder"),
    (settings(data={"path": "data/train"}), "but no cameras: find out where"),
    (folder_in_place_of(TRANSFORMS), "_train.json: cannot read the file: Is a directory"),
    (write(TRANSFORMS, b"{"), "_train.json: not valid JSON"),
    (write(TRANSFORMS, b"[" * 10**5), "_train.json: not valid JSON"),
    (write(TRANSFORMS, b"[]"), "_train.json: the content must be an object"),
    (transforms(lambda meta: meta.pop("frames")), "_train.json: frames is missing"),
    (transforms(lambda meta: meta["frames"].clear()), "frames must have at least one entry"),
    (matrix(list.pop), "_train.json: frames[1].transform_matrix must be 4 x 4 numbers"),
    (matrix(lambda m: m[0].__setitem__(3, np.nan)), "[0][3] must be a finite number, got NaN"),
    (matrix(lambda m: m[2].__setitem__(1, 1.0002)), "frames[1].transform_matrix must be rigid"),
    (without(IMAGE, "data/train/r_2.png"), "_train.json: frames[1].file_path: there is no image"),
    (folder_in_place_of("data/test/r_0.png"), "_test.json: frames[0].file_path: there is no image"),
    (write(IMAGE, b"hello"), "r_1.png: cannot read the image"),
    (write(IMAGE, b""), "r_1.png: cannot read the image"),
    (cut(IMAGE), "r_1.png: cannot read the image: image file is tr"),
    (image_of((23, 32, 4)), "r_1.png: must be 32 x 24 px"),
    (image_of((24, 32, 3)), "r_1.png: must have an alpha channel"),
    (image_of((1, (1 << 26) + 1)), "r_1.png: must have at most 67,108,864 p"),
    (image_header_of(10**6), "r_1.png: cannot read the image: Image size (1000000000000 pixels)"),
    (image_header_of(2**31 - 1), "r_1.png: cannot read the image: Image size ("),
    (
        lambda folder: Image.new("CMYK", (32, 24)).save(folder / IMAGE, "TIFF"),
        "r_1.png: must be a grey, RGB or RGBA image of 8 or 16 bits, got one of Pillow's mode CMYK",
    ),
    (bent_lens_and_exact_projection, "of view r_1 (opencv: k1), got exact; or set data.ignore_"),
    (settings(model={"near": 3.0}), "model.near must be less than half of the distance from the"),
    (
        settings(init={"num_points": 9, "half_extent": 1e-5}),
        "init.half_extent: the start box",
    ),
    (without(POINTS), "points.ply: cannot read"),
    (folder_in_place_of(POINTS), "points.ply: cannot read"),
    (cut(POINTS), "points.ply: not a valid PLY file: element vertex must have the 5 rows"),
    (replace(b"float z\n", b"float v\n"), "points.ply: not a PLY of points: properties z are"),
    (points_with_nan, "points.ply: element vertex, row 3: x must be"),
    (
        lambda folder: blobs(0).save(folder / POINTS),
        "points.ply: element vertex must have at least 1 row",
    ),
    (replace(b"vertex 5", b"vertex 4"), "rows that its header promises (4 of vertex)"),
    (replace(b"vertex 5", b"vertex 1000000000000"), "must have the 1,000,000,000,000 rows"),
    (lambda folder: (folder / "out").write_text("mine"), "out: cannot be the output folder"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("damage", "message"), WRONG_INPUTS, ids=[m for _, m in WRONG_INPUTS])
def test_wrong_input_ends_with_status_2_and_one_line(scene, damage, message):
    damage(scene)
    line = assert_fit_refused(scene / "a.yml", folder=scene, message=message)
    assert str(scene) in line or line.startswith(("error: model.near ", "error: init.half_extent"))


@pytest.mark.parametrize(("weight", "first"), [(0.2, "there is no image"), (0, "points.ply")])
def test_fit_opens_depths_if_its_loss_uses_them(scene, weight, first):
    """Which of two files that are missing is missed first."""
    transforms(lambda meta: meta["frames"][1].update(depth_file_path="nowhere.png"))(scene)
    (scene / POINTS).unlink()
    words = (scene / "a.yml", "--set", f"loss.depth_weight={weight}")
    assert_fit_refused(*words, folder=scene, message=first)


@pytest.mark.slow
def test_earlier_result_is_kept(scene):
    config, out = scene / "a.yml", scene / "out"
    assert_fits(config)
    before = contents(out)
    assert "point_cloud.ply" in before
    for again in ([config], ["--resume", out]):
        assert "this fit is finished" in assert_fits(*again).stdout
        assert contents(out) == before
    message = f"{out}: already holds another run, which differs in seed = 0"
    assert_fit_refused(config, "--set", "seed=1", folder=scene, message=message)
    (scene / TRANSFORMS).write_text("{")
    message = "transforms_train.json: not valid JSON"
    assert_fit_refused(config, "--overwrite", folder=scene, message=message)


NOBODY_UID = 65534
"""The user without rights, by Linux's convention."""


@pytest.fixture
def as_ordinary_user():
    """A scene's folder, with root's rights given up: root may read and write everything."""
    folder = make_scene(Path(tempfile.mkdtemp(prefix="drgs-")))
    was_root = os.geteuid() == 0
    if was_root:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, NOBODY_UID, NOBODY_UID)
        os.seteuid(NOBODY_UID)
    yield folder
    if was_root:
        os.seteuid(0)
    for path in (folder, folder / "data", *folder.glob("data/*")):
        path.chmod(0o700)
    shutil.rmtree(folder)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.yml", "a.yml: cannot read the configuration: Permission denied"),
        (TRANSFORMS, "transforms_train.json: cannot read the file: Permission denied"),
        (IMAGE, "r_1.png: cannot read the image: Permission denied"),
        ("data/train", "transforms_train.json: frames[0].file_path: there is no image"),
        ("data", "data.path: cannot open the folder"),
        (POINTS, "points.ply: cannot read the file: Permission denied"),
    ],
)
def test_unreadable_file_is_named(as_ordinary_user, name, message):
    (as_ordinary_user / name).chmod(0)
    with pytest.raises(UserError) as error:
        config = load_config(as_ordinary_user / "a.yml")
        load_dataset(config.data)
        read_points(config.init.point_cloud)
    assert message in str(error.value)


def test_write_protected_folder_keeps_its_files(as_ordinary_user):
    folder = as_ordinary_user
    config, before = load_config(folder / "a.yml"), contents(folder)
    folder.chmod(0o500)
    message = "Permission denied; choose a folder that you may write to"
    with pytest.raises(UserError, match=f"points.ply: cannot write the file: {message}"):
        blobs(7).save(folder / "points.ply")
    with pytest.raises(UserError, match=f"out: cannot be the output folder: {message}"):
        claim_output_folder(folder / "out", config)
    assert contents(folder) == before


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 64 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(mount, capture_output=True).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("a small file system cannot be mounted here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_keeps_the_earlier_file(small_disk):
    path = small_disk / "point_cloud.ply"
    path.write_text("earlier")
    with pytest.raises(UserError) as error:
        blobs(5000).save(path)
    assert str(error.value) == (
        f"{path}: cannot write the file: No space left on device; free some space, or choose "
        "another disk"
    )
    assert path.read_text() == "earlier"
    assert os.listdir(small_disk) == [path.name]
    blobs(9).save(small_disk / "a.ply")  # what fits is written
    assert Gaussians.load(small_disk / "a.ply").num_gaussians == 9
