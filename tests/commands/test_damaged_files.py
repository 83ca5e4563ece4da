"""Damaged files give an error that names them, or are read; never another exception, never a hang.

Each mutation is made by a generator with its own seed, which a failure prints.
"""

import copy
import io
import json
import os
import time

import imageio.v3 as iio
import numpy as np
import pytest
import yaml
from plyfile import PlyData, PlyElement
from support.attacks.mutations import mutate_bytes, mutate_chunks, mutate_header, mutate_tree
from support.colmap_models import Model, write_binary

from drgs.config.load import dump_config, load_config
from drgs.config.schema import DataConfig, FitConfig
from drgs.core.errors import UserError
from drgs.datasets import load_dataset
from drgs.datasets.images import composite
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.start import initial_gaussians
from drgs.io.images import read_image
from drgs.io.ply import read_points

pytestmark = pytest.mark.filterwarnings("ignore::drgs.core.errors.UserNote")

COUNT = 600
"""Mutations of each format."""

MAX_SECONDS = 5.0
"""Time limit of a single file. Files take about 5 ms; the rest is for a machine that is busy."""


# Valid files


def write_image(path, seed):
    pixels = np.random.default_rng(seed).integers(0, 256, (5, 7, 4), np.uint8)
    iio.imwrite(path, pixels)


def write_mask(path):
    """White, and transparent where pixels do not count."""
    pixels = np.full((5, 7, 2), 255, np.uint8)
    pixels[:2, :3, 1] = 0
    iio.imwrite(path, pixels, mode="LA")


def camera_at(angle):
    """A camera on a circle of radius 4 in OpenGL axes, looking at the origin."""
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return [[-s, 0, c, 4 * c], [c, 0, s, 4 * s], [0, 1, 0, 0], [0, 0, 0, 1]]


@pytest.fixture
def photographs(tmp_path):
    """A valid nerfstudio folder (nerf_synthetic reads its frames by the same functions)."""
    frames = []
    for i in range(4):
        write_image(tmp_path / f"{i}.png", i)
        frames.append({"file_path": f"{i}.png", "transform_matrix": camera_at(i)})
    meta = {"fl_x": 9.0, "fl_y": 9.0, "cx": 3.5, "cy": 2.5, "w": 7, "h": 5, "k1": 0.0}
    meta |= {"camera_model": "OPENCV", "camera_angle_x": 0.7, "frames": frames}
    meta |= {"train_filenames": ["0.png", "1.png", "./3.png"], "test_filenames": ["2"]}
    frames[1]["mask_path"] = "mask.png"
    write_mask(tmp_path / "mask.png")
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    return tmp_path


def gaussians_file(text):
    """Bytes of a PLY of three degree-0 Gaussians with colours, and a face."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1"]
    names += ["scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rows = np.zeros(3, [(n, "f4") for n in names] + [(n, "u1") for n in ("red", "green", "blue")])
    for i, name in enumerate(names):
        rows[name] = 0.1 * i
    faces = np.zeros(1, [("vertex_indices", object)])
    faces["vertex_indices"][0] = np.arange(3, dtype=np.int32)
    stream = io.BytesIO()
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, text=text, byte_order="<").write(stream)
    return stream.getvalue()


def check(seed, file, read):
    """Whether ``file`` is read; an error must be the user's, name the file, and fill one line."""
    started = time.process_time()
    try:
        read()
        refused = False
    except UserError as error:
        refused = True
        lines = str(error).splitlines()
        assert len(lines) == 1, f"seed {seed}: {error}"
        for line in lines:
            # Cameras that are valid one by one may determine no start box: that names the key.
            named = str(file.parent) in line or line.startswith("init.half_extent: ")
            assert named, f"seed {seed}: {error}"
            assert len(line) < 1000, f"seed {seed}: {error}"
    except Exception as error:
        raise AssertionError(f"seed {seed}: {type(error).__name__}: {error}") from error
    seconds = time.process_time() - started
    assert seconds < MAX_SECONDS, f"seed {seed}: {seconds:.1f} s"
    return refused


def assert_both_happen(refused):
    """The mutations reach far enough: some files are still valid, many are not."""
    assert 0.3 * len(refused) < sum(refused) < len(refused)


# Properties


@pytest.mark.slow
def test_damaged_ply_files_are_read_or_refused(tmp_path):
    path = tmp_path / "a.ply"
    refused = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        content = gaussians_file(text=seed % 3 == 0)
        mutate = mutate_header if seed % 2 else mutate_bytes
        path.write_bytes(mutate(rng, content))
        for read in (Gaussians.load, read_points):
            refused.append(check(seed, path, lambda read=read: read(path)))
    assert_both_happen(refused)


@pytest.mark.slow
def test_damaged_transforms_files_are_read_or_refused(photographs):
    path = photographs / "transforms.json"
    content = path.read_bytes()
    config = FitConfig(data={"path": photographs}, init={"num_points": 4})

    def read():
        initial_gaussians(config, load_dataset(config.data))

    refused = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        if seed % 2:
            path.write_text(json.dumps(mutate_tree(rng, json.loads(content))))
        else:
            path.write_bytes(mutate_bytes(rng, content))
        refused.append(check(seed, path, read))
    assert_both_happen(refused)


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["transforms.json", "COLMAP"])
def test_damaged_masks_are_read_or_refused(photographs, layout):
    """A mask contains only 0 and 1, whatever the file is, and its photograph is complete."""
    folder = photographs / "masks" if layout == "COLMAP" else photographs
    if layout == "COLMAP":
        (photographs / "transforms.json").unlink()
        cameras = [(1, "PINHOLE", 7, 5, (9.0, 9.0, 3.5, 2.5))]
        axes = np.diag([1, -1, -1, 1])
        images = [(f"{i}.png", 1, np.array(camera_at(i)) @ axes) for i in range(4)]
        write_binary(photographs / "sparse", Model(cameras, images, []))
        folder.mkdir()
    names = ["mask.png"] if layout != "COLMAP" else ["1.png.mask.png", "1.PNG", "1_mask.png"]
    (photographs / "mask.png").rename(folder / names[0])
    content = (folder / names[0]).read_bytes()

    def read():
        views = load_dataset(DataConfig(path=photographs)).train
        masks = [np.asarray(view.mask) for view in views if view.mask is not None]
        assert all(np.isin(mask, (0, 1)).all() and mask.any() for mask in masks)
        assert len(masks) == 1

    refused = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        path = folder / names[seed % len(names)]
        mutate = mutate_chunks if seed % 2 else mutate_bytes
        path.write_bytes(mutate(rng, content))
        refused.append(check(seed, path, read))
        path.unlink()
    assert_both_happen(refused)


@pytest.mark.slow
def test_strange_names_are_found_or_reported(photographs):
    """Names of photographs, masks, clouds and lists: only files are read, and none twice."""
    path, refused = photographs / "transforms.json", []
    meta = json.loads(path.read_text())
    parts = [
        *"0123",
        "2",
        "images",
        "..",
        ".",
        "",
        "C:",
        "\\",
        "/",
        "//",
        "a" * 300,
        "\0",
        "\ud800",
    ]
    parts += [".png", ".PNG", ".jpg", "é", "e\u0301", "*", "~", " ", "\n", str(photographs), "mask"]

    def read():
        dataset = load_dataset(DataConfig(path=photographs))
        files = [view.files["image"] for view in (*dataset.train, *dataset.test)]
        assert all(file.is_file() for file in files) and len(set(files)) == len(files)

    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        changed = copy.deepcopy(meta)
        places = [(frame, "file_path") for frame in changed["frames"]]
        places += [(changed["frames"][1], "mask_path"), (changed, "ply_file_path")]
        places += [(changed["test_filenames"], 0), (changed["train_filenames"], 1)]
        container, key = places[rng.integers(len(places))]
        chosen = [parts[k] for k in rng.integers(len(parts), size=rng.integers(1, 4))]
        container[key] = ["/", "", "\\"][rng.integers(3)].join(chosen)
        path.write_text(json.dumps(changed))
        refused.append(check(seed, path, read))
    assert 0.1 * COUNT < sum(refused) < 0.9 * COUNT


@pytest.mark.slow
def test_damaged_images_are_read_or_refused(tmp_path):
    path = tmp_path / "a.png"
    write_image(path, 0)
    content = path.read_bytes()
    refused = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        mutate = mutate_chunks if seed % 2 else mutate_bytes
        path.write_bytes(mutate(rng, content))
        refused.append(check(seed, path, lambda: composite(read_image(path), (1, 1, 1))))
    assert_both_happen(refused)


@pytest.mark.slow
def test_damaged_configurations_are_read_or_refused(tmp_path):
    path = tmp_path / "a.yml"
    values = FitConfig(data=DataConfig(path="x", background=(0, 0.5, 1))).model_dump(mode="json")

    def read():
        config = load_config(path)
        dump_config(config, tmp_path / "again.yml")
        assert load_config(tmp_path / "again.yml") == config

    refused = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        if seed % 2:
            text = yaml.safe_dump(mutate_tree(rng, values), sort_keys=False)
            path.write_bytes(text.encode(errors="surrogatepass"))
        else:
            path.write_bytes(mutate_bytes(rng, yaml.safe_dump(values).encode()))
        refused.append(check(seed, path, read))
    assert_both_happen(refused)
    assert sorted(os.listdir(tmp_path)) == ["a.yml", "again.yml"]
