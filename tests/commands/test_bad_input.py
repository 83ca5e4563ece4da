"""Wrong input of ``drgs.fit``: status 2, one line, and nothing is written; and damaged files.

Refusals of a single reader are tested with it. Each damage is made by a generator of random
numbers with its own seed, which a failure prints.
"""

import json
import os
import shutil
import struct
import tempfile
import time
import zlib
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import yaml
from PIL import Image
from plyfile import PlyData
from support.attacks.mutations import (
    mutate_bytes,
    mutate_chunks,
    mutate_header,
    mutate_json,
    mutate_yaml,
)
from support.colmap_models import Model, write_binary
from support.fit_command import assert_fit_refused, write_scene
from support.folders import contents
from support.small_capture import blobs

from drgs.config.load import dump_config, load_config
from drgs.config.schema import DataConfig, FitConfig
from drgs.core.errors import UserError
from drgs.datasets import load_dataset
from drgs.datasets.images import composite
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.start import initial_gaussians
from drgs.io.images import read_image
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
MODE = "r_1.png: must be a grey, RGB or RGBA image of 8 or 16 bits, got one of Pillow's mode CMYK"
NOT_READ = "r_1.png: cannot read the image: Image size ("
WRONG_INPUTS = {
    "a.yml: data is missing: ": edit(CONFIG, lambda _: ALIASES),
    "_train.json: the content must be an object": edit(TRANSFORMS, lambda _: b"[]"),
    "r_1.png: must have at most 67,108,864 p": save_image("L", ((1 << 26) + 1, 1)),
    f"{NOT_READ}1000000000000 pixels)": edit(IMAGE, lambda png: declare_size(png, 10**6)),
    NOT_READ: edit(IMAGE, lambda png: declare_size(png, 2**31 - 1)),
    MODE: save_image("CMYK", (32, 24)),
    "of view r_1, opencv (k1), got exact; or set data.ign": exact_projection_with_distortion,
    "not a PLY of points: properties z are": edit(
        POINTS, lambda ply: ply.replace(b" z\n", b" v\n")
    ),
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
    load_dataset(load_config(folder / CONFIG).data)  # imports what only root may read
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
    (folder / "out").mkdir(mode=0)
    with pytest.raises(UserError, match=f"out: cannot be the output folder: {message}"):
        claim_output_folder(folder / "out", config)
    (folder / "out").chmod(0o700)


# Damaged files give an error that names them, or are read; never another exception, never a hang


def fuzzed(test):
    return pytest.mark.slow(pytest.mark.filterwarnings("ignore::drgs.core.errors.UserNote")(test))


COUNT = 600  # mutations of each format
MAX_SECONDS = 5.0  # of a file, which takes about 5 ms; the rest is for a machine that is busy


@pytest.fixture
def folder(photographs):
    """A nerfstudio folder with a mask and with lists of views."""
    mask = np.full((6, 8, 2), 255, np.uint8)
    mask[:2, :3, 1] = 0  # white, and transparent where pixels do not count
    iio.imwrite(photographs / "mask.png", mask, mode="LA")
    path = photographs / "transforms.json"
    meta = json.loads(path.read_text())
    meta |= {"camera_model": "OPENCV", "camera_angle_x": 0.7, "k1": 0.0}
    meta |= {"train_filenames": ["images/00.png", "./images/03.png", "images/08.png"]}
    meta |= {"test_filenames": ["images/02"]}
    meta["frames"][6]["mask_path"] = "mask.png"  # of 03.png
    path.write_text(json.dumps(meta))
    return photographs


def is_refused(seed, file, read):
    """Whether ``file`` is not read; an error must be the user's, name the file, and fill a line."""
    started, refused = time.process_time(), False
    try:
        read()
    except UserError as error:
        refused = True
        (line,) = str(error).splitlines()
        # Cameras that are valid one by one may determine no start box: that names the key.
        named = str(file.parent) in line or line.startswith("init.half_extent: ")
        assert named and len(line) < 1000, f"seed {seed}: {error}"
    except Exception as error:
        raise AssertionError(f"seed {seed}: {type(error).__name__}: {error}") from error
    seconds = time.process_time() - started
    assert seconds < MAX_SECONDS, f"seed {seed}: {seconds:.1f} s"
    return refused


def check(files, contents, mutate, read, others=mutate_bytes, least=0.3):
    """Read files of changed contents; some must still be valid, many not.

    mutate, others: of a generator and a content, in turn.
    """
    refused = []
    for seed in range(COUNT):
        path, rng = files[seed % len(files)], np.random.default_rng(seed)
        change = mutate if seed % 2 else others
        path.write_bytes(change(rng, contents[seed % len(contents)]))
        refused.append(is_refused(seed, path, lambda path=path: read(path)))
        path.unlink()
    assert least * COUNT < sum(refused) < COUNT


@fuzzed
@pytest.mark.parametrize("read", [Gaussians.load, read_points])
def test_damaged_ply_files_are_read_or_refused(tmp_path, read):
    path, contents = tmp_path / "a.ply", []
    for text in (True, False, False):
        blobs(3).save(path)
        data = PlyData.read(str(path), mmap=False)
        data.text = text
        data.write(str(path))
        contents.append(path.read_bytes())
    check([path], contents, mutate_header, read)


@fuzzed
def test_damaged_transforms_files_are_read_or_refused(folder):
    path, config = (
        folder / "transforms.json",
        FitConfig(data={"path": folder}, init={"num_points": 4}),
    )
    read = lambda path: initial_gaussians(config, load_dataset(config.data))  # noqa: E731
    check([path], [path.read_bytes()], mutate_json, read)


@fuzzed
@pytest.mark.parametrize("layout", ["transforms.json", "COLMAP"])
def test_damaged_masks_are_read_or_refused(folder, layout):
    """A mask contains only 0 and 1, whatever the file is, and its photograph is complete."""
    content, files = (folder / "mask.png").read_bytes(), [folder / "mask.png"]
    if layout == "COLMAP":
        poses = json.loads((folder / "transforms.json").read_text())["frames"]
        (folder / "transforms.json").unlink()
        cameras = [(1, "PINHOLE", 8, 6, (9.0, 9.0, 3.5, 2.5))]
        axes = np.diag([1, -1, -1, 1])
        images = [(f["file_path"][7:], 1, np.array(f["transform_matrix"]) @ axes) for f in poses]
        write_binary(folder / "sparse", Model(cameras, images, []))
        (folder / "masks").mkdir()
        files = [folder / "masks" / name for name in ("03.png.mask.png", "03.PNG", "03_mask.png")]

    def read(path):
        views = load_dataset(DataConfig(path=folder)).train
        masks = [np.asarray(view.mask) for view in views if view.mask is not None]
        assert all(np.isin(mask, (0, 1)).all() and mask.any() for mask in masks)
        assert len(masks) == 1

    check(files, [content], mutate_chunks, read)


@fuzzed
def test_strange_names_are_found_or_reported(folder):
    """Names of photographs, masks, clouds and lists: only files are read, and none twice."""
    path = folder / "transforms.json"
    parts = [
        *("00", "01", "02", "03", "images", "..", ".", "", "C:", "\\", "/", "//", "a" * 300, "\0"),
        *("\ud800", ".png", ".PNG", ".jpg", "é", "e\u0301", "*", "~", " ", "\n", "mask"),
        str(folder),
    ]

    def rename(rng, content):
        meta = json.loads(content)
        places = [(frame, "file_path") for frame in meta["frames"][:4]]
        places += [(meta["frames"][6], "mask_path"), (meta, "ply_file_path")]
        places += [(meta["test_filenames"], 0), (meta["train_filenames"], 1)]
        container, key = places[rng.integers(len(places))]
        chosen = [parts[k] for k in rng.integers(len(parts), size=rng.integers(1, 4))]
        container[key] = ["/", "", "\\"][rng.integers(3)].join(chosen)
        return json.dumps(meta).encode()

    def read(path):
        dataset = load_dataset(DataConfig(path=folder))
        files = [view.files["image"] for view in (*dataset.train, *dataset.test)]
        assert all(file.is_file() for file in files) and len(set(files)) == len(files)

    check([path], [path.read_bytes()], rename, read, rename, least=0.1)


@fuzzed
def test_damaged_images_are_read_or_refused(tmp_path):
    path = tmp_path / "a.png"
    iio.imwrite(path, np.random.default_rng(0).integers(0, 256, (5, 7, 4), np.uint8))
    read = lambda path: composite(read_image(path), (1, 1, 1))  # noqa: E731
    check([path], [path.read_bytes()], mutate_chunks, read)


@fuzzed
def test_damaged_configurations_are_read_or_refused(tmp_path):
    values = FitConfig(data=DataConfig(path="x", background=(0, 0.5, 1))).model_dump(mode="json")

    def read(path):
        config = load_config(path)
        dump_config(config, tmp_path / "again.yml")
        assert load_config(tmp_path / "again.yml") == config

    check([tmp_path / "a.yml"], [yaml.safe_dump(values).encode()], mutate_yaml, read)
    assert [path.name for path in tmp_path.iterdir()] == ["again.yml"]
