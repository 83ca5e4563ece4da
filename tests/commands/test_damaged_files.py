"""Damaged files give an error that names them, or are read; never another exception, never a hang.

Each mutation is made by a generator with its own seed, which a failure prints.
"""

import json
import time

import imageio.v3 as iio
import numpy as np
import pytest
import yaml
from plyfile import PlyData
from support.attacks.mutations import (
    mutate_bytes,
    mutate_chunks,
    mutate_header,
    mutate_json,
    mutate_yaml,
)
from support.colmap_models import Model, write_binary
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

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::drgs.core.errors.UserNote")]

COUNT = 600
"""Mutations of each format."""

MAX_SECONDS = 5.0
"""Time limit of a single file. Files take about 5 ms; the rest is for a machine that is busy."""


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


def test_damaged_transforms_files_are_read_or_refused(folder):
    path, config = (
        folder / "transforms.json",
        FitConfig(data={"path": folder}, init={"num_points": 4}),
    )
    read = lambda path: initial_gaussians(config, load_dataset(config.data))  # noqa: E731
    check([path], [path.read_bytes()], mutate_json, read)


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


def test_damaged_images_are_read_or_refused(tmp_path):
    path = tmp_path / "a.png"
    iio.imwrite(path, np.random.default_rng(0).integers(0, 256, (5, 7, 4), np.uint8))
    read = lambda path: composite(read_image(path), (1, 1, 1))  # noqa: E731
    check([path], [path.read_bytes()], mutate_chunks, read)


def test_damaged_configurations_are_read_or_refused(tmp_path):
    values = FitConfig(data=DataConfig(path="x", background=(0, 0.5, 1))).model_dump(mode="json")

    def read(path):
        config = load_config(path)
        dump_config(config, tmp_path / "again.yml")
        assert load_config(tmp_path / "again.yml") == config

    check([tmp_path / "a.yml"], [yaml.safe_dump(values).encode()], mutate_yaml, read)
    assert [path.name for path in tmp_path.iterdir()] == ["again.yml"]
