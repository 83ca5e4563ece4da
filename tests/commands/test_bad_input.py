"""Every kind of wrong input, through the command: status 2, one line, and nothing is written.

What exactly the line says is tested with the module that says it.
"""

import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import yaml
from conftest import REPOSITORY
from PIL import Image
from support.commands import run_in_process

from drgs import fit
from drgs.config.load import dump_config, load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.datasets import load_dataset
from drgs.datasets.fingerprint import Fingerprint
from drgs.gaussians.parameters import Gaussians
from drgs.io.ply import read_points
from drgs.results.folder import claim_output_folder
from drgs.training.checkpoint import Checkpoint, save_checkpoint
from drgs.training.loop import History


def some_gaussians(num):
    shapes = {"means": 3, "quats": 4, "log_scales": 3}
    arrays = {name: np.zeros((num, width), np.float32) for name, width in shapes.items()}
    arrays["means"][:, 0] = np.linspace(-0.1, 0.1, num)
    return Gaussians(
        **arrays,
        logit_opacities=np.zeros(num, np.float32),
        sh0=np.zeros((num, 1, 3), np.float32),
        shN=np.zeros((num, 0, 3), np.float32),
    )


def make_scene(folder):
    """A NeRF-synthetic data set of 3 + 1 views, a point cloud and a configuration for them."""
    for split, angles in (("train", (0, 2, 4)), ("test", (1,))):
        (folder / split).mkdir()
        frames = []
        for i, angle in enumerate(angles):
            c, s = float(np.cos(angle)), float(np.sin(angle))
            pose = [[-s, 0, c, 4 * c], [c, 0, s, 4 * s], [0, 1, 0, 0], [0, 0, 0, 1]]
            frames.append({"file_path": f"{split}/{i}", "transform_matrix": pose})
            pixels = np.random.default_rng(angle).integers(0, 256, (16, 20, 4), np.uint8)
            iio.imwrite(folder / split / f"{i}.png", pixels)
        meta = {"camera_angle_x": 0.7, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(meta))
    some_gaussians(5).save(folder / "points.ply")
    (folder / "a.yml").write_text(yaml.safe_dump(SETTINGS))


SETTINGS = {
    "data": {"path": "."},
    "init": {"point_cloud": "points.ply"},
    "model": {"sh_degree": 0},
    "output": {"dir": "out", "save_renders": False},
    "iterations": 2,
}


@pytest.fixture
def scene(tmp_path):
    make_scene(tmp_path)
    return tmp_path


def fit_in_process(capsys, *arguments):
    """(status, standard error) of the command."""
    with pytest.raises(SystemExit) as exit_info:
        fit.main([str(argument) for argument in arguments])
    return exit_info.value.code, capsys.readouterr().err


def replace(path, old, new):
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))


def edit_transforms(change):
    def apply(folder):
        path = folder / "transforms_train.json"
        meta = json.loads(path.read_text())
        change(meta)
        path.write_text(json.dumps(meta))

    return apply


def edit_settings(**sections):
    def apply(folder):
        values = {**SETTINGS, **sections}
        (folder / "a.yml").write_text(yaml.safe_dump(values))

    return apply


def edit_means(row, value):
    def apply(folder):
        gaussians = some_gaussians(5)
        gaussians.means[row] = value
        gaussians.save(folder / "points.ply")

    return apply


def write_image(shape):
    return lambda folder: iio.imwrite(folder / "train" / "1.png", np.zeros(shape, np.uint8))


def put_folder_in_place_of(name):
    def apply(folder):
        (folder / name).unlink()
        (folder / name).mkdir()

    return apply


def cut(name, size):
    return lambda folder: os.truncate(folder / name, size)


def write(name, content):
    return lambda folder: (folder / name).write_bytes(content)


WRONG_INPUTS = {
    "config missing": (lambda f: (f / "a.yml").unlink(), "a.yml: cannot read the configuration"),
    "config is a folder": (put_folder_in_place_of("a.yml"), "a.yml: neither transforms_train.json"),
    "config not UTF-8": (write("a.yml", b"\xff"), "a.yml: cannot read the configuration: not UTF"),
    "config not YAML": (write("a.yml", b"a: ["), "a.yml: line 1: not valid YAML"),
    "config not a mapping": (write("a.yml", b"- 1"), "a.yml: must hold sections"),
    "config empty": (write("a.yml", b""), "a.yml: must hold sections"),
    "alias bomb": (
        write("a.yml", b"a: &a [1,1]\nb: &b [*a,*a]\nc: &c [*b,*b]\n"),
        "a.yml: data is missing: ",
    ),
    "unknown key": (edit_settings(sed=3), "a.yml: unknown key sed; did you mean seed?"),
    "wrong value": (edit_settings(iterations=0), "a.yml: iterations must be >= 1, got 0"),
    "data missing": (edit_settings(data={"path": "none"}), "data.path: there is no folder"),
    "data is a file": (edit_settings(data={"path": "a.yml"}), "cannot open the folder"),
    "data of no layout": (edit_settings(data={"path": "train"}), "but no cameras: find out where"),
    "transforms is a folder": (
        put_folder_in_place_of("transforms_train.json"),
        "transforms_train.json: cannot read the file: Is a directory",
    ),
    "transforms not JSON": (write("transforms_train.json", b"{"), "train.json: not valid JSON"),
    "transforms too deep": (
        write("transforms_train.json", b"[" * 10**5),
        "transforms_train.json: not valid JSON",
    ),
    "transforms a list": (
        write("transforms_train.json", b"[]"),
        "train.json: the content must be an object",
    ),
    "no frames": (edit_transforms(lambda m: m.pop("frames")), "train.json: frames is missing"),
    "frames empty": (
        edit_transforms(lambda m: m["frames"].clear()),
        "frames must have at least one entry",
    ),
    "matrix 3x4": (
        edit_transforms(lambda m: m["frames"][1]["transform_matrix"].pop()),
        "transforms_train.json: frames[1].transform_matrix must be 4 x 4 numbers",
    ),
    "matrix not finite": (
        edit_transforms(lambda m: m["frames"][1]["transform_matrix"][0].__setitem__(3, np.nan)),
        "transforms_train.json: frames[1].transform_matrix[0][3] must be a finite number, got NaN",
    ),
    "matrix not rigid": (
        edit_transforms(lambda m: m["frames"][1]["transform_matrix"][2].__setitem__(1, 1.0002)),
        "transforms_train.json: frames[1].transform_matrix must be rigid",
    ),
    "images missing": (
        lambda f: [(f / "train" / f"{i}.png").unlink() for i in (1, 2)],
        "transforms_train.json: frames[1].file_path: there is no image",
    ),
    "all test images are folders": (
        put_folder_in_place_of("test/0.png"),
        "transforms_test.json: frames[0].file_path: there is no image",
    ),
    "image not an image": (write("train/1.png", b"hello"), "1.png: cannot read the image"),
    "image empty": (write("train/1.png", b""), "1.png: cannot read the image"),
    "image truncated": (cut("train/1.png", 700), "1.png: cannot read the image: image file is tr"),
    "image of another size": (write_image((15, 20, 4)), "1.png: must be 20 x 16 px"),
    "image too large": (write_image((1, (1 << 26) + 1)), "1.png: must have at most 67,108,864 p"),
    "image of four inks": (
        lambda f: Image.new("CMYK", (20, 16)).save(f / "train" / "1.png", "TIFF"),
        "1.png: must be a grey, RGB or RGBA image of 8 or 16 bits, got one of Pillow's mode CMYK",
    ),
    "exact projection of a bent lens": (
        lambda f: (
            edit_settings(model={"sh_degree": 0, "projection": "exact"})(f),
            edit_transforms(lambda m: m["frames"][1].update(k1=0.1))(f),
        ),
        ": model.projection must be ewa or unscented for lenses that are no pinholes, such as that "
        "of view 1 (opencv: k1), got exact; or set data.ignore_distortion",
    ),
    "cameras and colours along rays": (
        edit_settings(cameras={"optimise": True}, model={"sh_direction": "pixel"}),
        "a.yml: model.sh_direction must be mean where cameras.optimise is true",
    ),
    "alpha missing": (write_image((16, 20, 3)), "1.png: must have an alpha channel"),
    "point cloud missing": (lambda f: (f / "points.ply").unlink(), "points.ply: cannot read"),
    "point cloud is a folder": (put_folder_in_place_of("points.ply"), "points.ply: cannot read"),
    "point cloud truncated": (
        cut("points.ply", 500),
        "points.ply: not a valid PLY file: element vertex must have the 5 rows",
    ),
    "point cloud lacks z": (
        lambda f: replace(f / "points.ply", b"float z\n", b"float v\n"),
        "points.ply: not a PLY of points: properties z are missing",
    ),
    "point cloud with NaN": (edit_means(3, np.nan), "points.ply: element vertex, row 3: x must be"),
    "point cloud empty": (
        lambda f: some_gaussians(0).save(f / "points.ply"),
        "points.ply: element vertex must have at least 1 row",
    ),
    "point cloud too long": (
        lambda f: replace(f / "points.ply", b"vertex 5", b"vertex 4"),
        "points.ply: the file must end after the rows that its header promises (4 of vertex)",
    ),
    "point cloud claims 10^12 rows": (
        lambda f: replace(f / "points.ply", b"vertex 5", b"vertex 1000000000000"),
        "points.ply: not a valid PLY file: element vertex must have the 1,000,000,000,000 rows",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(("damage", "message"), WRONG_INPUTS.values(), ids=WRONG_INPUTS)
def test_wrong_input_ends_with_status_2_and_one_line(scene, capsys, damage, message):
    damage(scene)
    status, errors = fit_in_process(capsys, scene / "a.yml")
    assert status == 2
    assert errors.startswith("error: ") and errors.count("\n") == 1, errors
    assert message in errors
    assert str(scene) in errors
    assert not (scene / "out").exists()


@pytest.mark.parametrize(("weight", "first"), [(0.2, "there is no image"), (0, "points.ply")])
def test_fit_opens_depths_if_its_loss_uses_them(scene, capsys, weight, first):
    """Which of two files that are missing is missed first."""
    edit_transforms(lambda m: m["frames"][1].update(depth_file_path="nowhere.png"))(scene)
    (scene / "points.ply").unlink()
    setting = ("--set", f"loss.depth_weight={weight}")
    status, errors = fit_in_process(capsys, scene / "a.yml", *setting)
    assert status == 2 and first in errors


@pytest.mark.parametrize("size", [10**6, 2**31 - 1])
def test_image_header_of_huge_size_allocates_no_memory(scene, size):
    path = scene / "train" / "1.png"
    content = bytearray(path.read_bytes())
    content[16:24] = struct.pack(">II", size, size)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"1.png: cannot read the image: Image size \(\d+ pixels\)"):
        load_dataset(load_config(scene / "a.yml").data)


def run_command(*arguments):
    return run_in_process(fit.main, *arguments)


def contents(folder):
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def assert_refused(result, message):
    assert result.returncode == 2, result.stderr
    assert message in result.stderr
    assert result.stderr.count("\n") == 1, result.stderr


def run_process(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "drgs.fit", *map(str, arguments)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.slow
def test_the_command_itself_refuses_a_damaged_point_cloud(scene):
    os.truncate(scene / "points.ply", 500)
    assert_refused(run_process(scene / "a.yml"), "points.ply: not a valid PLY file")
    assert not (scene / "out").exists()


@pytest.mark.slow
def test_earlier_result_is_kept(scene):
    first = run_command(scene / "a.yml")
    assert first.returncode == 0, first.stderr
    before = contents(scene / "out")
    assert scene / "out" / "point_cloud.ply" in before

    again = run_command(scene / "a.yml")
    assert again.returncode == 0, again.stderr
    assert "this fit is finished" in again.stdout
    resumed = run_command("--resume", scene / "out")
    assert resumed.returncode == 0, resumed.stderr
    assert contents(scene / "out") == before
    other = run_command(scene / "a.yml", "--set", "seed=1")
    assert_refused(other, f"{scene}/out: already holds another run, which differs in seed = 0")
    assert contents(scene / "out") == before

    (scene / "transforms_train.json").write_text("{")
    broken = run_command(scene / "a.yml", "--overwrite")
    assert_refused(broken, "transforms_train.json: not valid JSON")
    assert contents(scene / "out") == before


def test_an_output_folder_that_is_a_file_is_refused(scene):
    (scene / "out").write_text("mine")
    assert_refused(run_command(scene / "a.yml"), f"{scene}/out: cannot be the output folder")
    assert (scene / "out").read_text() == "mine"


# Permissions


NOBODY_UID = 65534
"""The user without rights, by Linux's convention."""


@pytest.fixture
def as_ordinary_user():
    """A scene's folder, with root's rights given up: root may read and write everything."""
    folder = Path(tempfile.mkdtemp(prefix="drgs-"))
    make_scene(folder)
    was_root = os.geteuid() == 0
    if was_root:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, NOBODY_UID, NOBODY_UID)
        os.seteuid(NOBODY_UID)
    yield folder
    if was_root:
        os.seteuid(0)
    for path in (folder, *folder.iterdir()):
        path.chmod(0o700)
    shutil.rmtree(folder)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.yml", "a.yml: cannot read the configuration: Permission denied"),
        ("transforms_train.json", "transforms_train.json: cannot read the file: Permission denied"),
        ("train/1.png", "1.png: cannot read the image: Permission denied"),
        ("train", "transforms_train.json: frames[0].file_path: there is no image"),
        ("points.ply", "points.ply: cannot read the file: Permission denied"),
    ],
)
def test_unreadable_file_is_named(as_ordinary_user, name, message):
    (as_ordinary_user / name).chmod(0)
    with pytest.raises(UserError) as error:
        config = load_config(as_ordinary_user / "a.yml")
        load_dataset(config.data)
        read_points(config.init.point_cloud)
    assert message in str(error.value)


def test_unreadable_data_folder_is_named(as_ordinary_user):
    config = load_config(as_ordinary_user / "a.yml")
    as_ordinary_user.chmod(0)
    with pytest.raises(UserError, match=r"data.path: cannot open the folder .*: Permission denied"):
        load_dataset(config.data)


def test_write_protected_folder_keeps_its_files(as_ordinary_user):
    folder = as_ordinary_user
    config = load_config(folder / "a.yml")
    before = contents(folder)
    folder.chmod(0o500)
    message = "Permission denied; choose a folder that you may write to"
    with pytest.raises(UserError, match=f"points.ply: cannot write the file: {message}"):
        some_gaussians(7).save(folder / "points.ply")
    with pytest.raises(UserError, match=f"out: cannot be the output folder: {message}"):
        claim_output_folder(folder / "out", config)
    assert contents(folder) == before


# A disk that is full


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


def save_large_checkpoint(path):
    state = Checkpoint(
        {"means": np.zeros((9999, 3))}, *History().arrays(), 0.0, Fingerprint(train=[], test=[])
    )
    save_checkpoint(path.parent, FitConfig(data={"path": "x"}), state)


WRITERS = {
    "point_cloud.ply": lambda path: some_gaussians(5000).save(path),
    "checkpoint.npz": save_large_checkpoint,
    "config.yml": lambda path: dump_config(
        FitConfig(data={"path": "x", "source": "y" * 10**5}), path
    ),
}


@pytest.mark.parametrize(("name", "write_large"), WRITERS.items(), ids=WRITERS)
def test_a_full_disk_keeps_the_earlier_file(small_disk, name, write_large):
    path = small_disk / name
    path.write_text("earlier")
    with pytest.raises(UserError) as error:
        write_large(path)
    assert str(error.value) == (
        f"{path}: cannot write the file: No space left on device; free some space, or choose "
        "another disk"
    )
    assert path.read_text() == "earlier"
    assert os.listdir(small_disk) == [name]


def test_file_that_fits_on_a_small_disk_is_written(small_disk):
    some_gaussians(9).save(small_disk / "a.ply")
    assert Gaussians.load(small_disk / "a.ply").num_gaussians == 9
