"""Wrong input of ``drgs.fit``: status 2, one line, and nothing is written.

Refusals of a single reader are tested with it, and damaged files by the attacks.
"""

import json
import os
import shutil
import struct
import tempfile
import zlib
from pathlib import Path

import pytest
from PIL import Image
from support.fit_command import assert_fit_refused, write_scene
from support.folders import contents
from support.small_capture import blobs

from drgs.config.load import load_config
from drgs.core.errors import UserError
from drgs.datasets import load_dataset
from drgs.io.ply import read_points
from drgs.results.folder import claim_output_folder

CONFIG, POINTS, IMAGE = "a.yml", "points.ply", "data/train/r_1.png"
TRANSFORMS = "data/transforms_train.json"


def make_scene(folder):
    """A data set of 3 + 1 views, a point cloud and a configuration for them."""
    blobs(5).save(folder / POINTS)
    model, output = {"sh_degree": 0}, {"dir": "out", "save_renders": False}
    write_scene(folder, init={"point_cloud": POINTS}, model=model, output=output, iterations=2)
    return folder


@pytest.fixture
def scene(tmp_path):
    return make_scene(tmp_path)


def edit(name, change):
    """Return a function of a scene's folder that changes the content of a file."""
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def change_frame(content, **values):
    meta = json.loads(content)
    meta["frames"][1].update(values)
    return json.dumps(meta).encode()


def declare_size(content, size):
    """Give a PNG another width and height, with a checksum that is right."""
    header = content[12:16] + struct.pack(">II", size, size) + content[24:29]
    return content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:]


def exact_projection_with_distortion(folder):
    edit(CONFIG, lambda text: text.replace(b"model:", b"model:\n  projection: exact"))(folder)
    edit(TRANSFORMS, lambda text: change_frame(text, k1=0.1))(folder)


def save_image(mode, size):
    return lambda folder: Image.new(mode, size).save(folder / IMAGE, "TIFF")


ALIASES = b"a: &a [1,1]\nb: &b [*a,*a]\nc: &c [*b,*b]\n"
NOT_READ = "r_1.png: cannot read the image: Image size ("
WRONG_INPUTS = {
    "a.yml: data is missing: ": edit(CONFIG, lambda _: ALIASES),
    "_train.json: the content must be an object": edit(TRANSFORMS, lambda _: b"[]"),
    "r_1.png: must have at most 67,108,864 p": save_image("L", ((1 << 26) + 1, 1)),
    f"{NOT_READ}1000000000000 pixels)": edit(IMAGE, lambda png: declare_size(png, 10**6)),
    NOT_READ: edit(IMAGE, lambda png: declare_size(png, 2**31 - 1)),
    "r_1.png: must be a grey, RGB or RGBA": save_image("CMYK", (32, 24)),
    "of view r_1 (opencv: k1), got exact; or set data.ign": exact_projection_with_distortion,
    "properties z are": edit(POINTS, lambda ply: ply.replace(b"float z\n", b"float v\n")),
}


@pytest.mark.slow
@pytest.mark.parametrize("message", WRONG_INPUTS)
def test_wrong_input_ends_with_status_2_and_one_line(scene, message):
    WRONG_INPUTS[message](scene)
    assert_fit_refused(scene / CONFIG, folder=scene, message=message)


@pytest.mark.parametrize(("weight", "first"), [(0.2, "there is no image"), (0, POINTS)])
def test_fit_opens_depths_if_its_loss_uses_them(scene, weight, first):
    """Which of two files that are missing is missed first."""
    edit(TRANSFORMS, lambda text: change_frame(text, depth_file_path="nowhere.png"))(scene)
    (scene / POINTS).unlink()
    words = (scene / CONFIG, "--set", f"loss.depth_weight={weight}")
    assert_fit_refused(*words, folder=scene, message=first)


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
    shutil.rmtree(folder)


UNREADABLE = {
    CONFIG: "a.yml: cannot read the configuration: Permission denied",
    TRANSFORMS: "transforms_train.json: cannot read the file: Permission denied",
    IMAGE: "r_1.png: cannot read the image: Permission denied",
    "data/train": "transforms_train.json: frames[0].file_path: there is no image",
    "data": "data.path: cannot open the folder",
    POINTS: "points.ply: cannot read the file: Permission denied",
}


def test_files_and_folders_without_permission_are_named(as_ordinary_user):
    folder = as_ordinary_user
    config, before = load_config(folder / CONFIG), contents(folder)
    for name, message in UNREADABLE.items():
        mode = (folder / name).stat().st_mode
        (folder / name).chmod(0)
        with pytest.raises(UserError) as error:
            load_config(folder / CONFIG)
            load_dataset(config.data)
            read_points(config.init.point_cloud)
        (folder / name).chmod(mode)
        assert message in str(error.value)
    folder.chmod(0o500)
    message = "Permission denied; choose a folder that you may write to"
    with pytest.raises(UserError, match=f"points.ply: cannot write the file: {message}"):
        blobs(7).save(folder / POINTS)
    with pytest.raises(UserError, match=f"out: cannot be the output folder: {message}"):
        claim_output_folder(folder / "out", config)
    folder.chmod(0o700)
    assert contents(folder) == before
