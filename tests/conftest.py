"""Fixtures for more than one test file."""

import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)

# isort: split

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
import yaml

pytest.register_assert_rewrite("support")

REPOSITORY = Path(__file__).resolve().parent.parent
TESTS = str(REPOSITORY / "tests")
"""Folder that contains ``support``, for programs that tests run."""

SHARED_DATA = REPOSITORY.parent / "shared" / "data"

CHOSEN_LLVM = {k: v for k, v in os.environ.items() if k == "DRJIT_LIBLLVM_PATH"}
"""What drgs chose, for ``run_python`` of programs that import Mitsuba before drgs."""


def pytest_configure(config):
    """Dr.Jit computes on one thread in each worker: they share the cores, and idle threads spin."""
    if hasattr(config, "workerinput"):
        import drjit as dr

        dr.set_thread_count(1)


def run_program(*command, cwd=REPOSITORY, **options):
    """Return the standard output of a process that succeeds; options: see subprocess.run."""
    words = [str(word) for word in command]
    result = subprocess.run(words, cwd=cwd, capture_output=True, text=True, **options)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def copy_checkout(folder):
    """Copy what a package is built from to a new folder."""
    for name in ("drgs", "plugins"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / name, folder / name, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, folder / name)
    return folder


def _shared(*parts):
    folder = SHARED_DATA.joinpath(*parts)
    if not folder.is_dir():
        pytest.skip(f"the shared data folder {'/'.join(parts)} is not here")
    return folder


@pytest.fixture(scope="module", autouse=True)
def variant():
    """Select the variant of nearly all tests."""
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture(scope="module")
def gsplat():
    """10,000 Gaussians, their camera, and gsplat's float32 image, cotangent and gradients."""
    from drgs.reference.splatting import Camera, Gaussians

    folder = _shared("gsplat_reference")
    data, pose = np.load(folder / "gauss_10k.npz"), np.load(folder / "cam.npz")
    scales, opacities = data["scales"].astype(float), data["opacities"].astype(float)
    gaussians = Gaussians(
        means=data["means"],
        quats=data["quats"],
        log_scales=np.log(scales),
        logit_opacities=np.log(opacities) - np.log1p(-opacities),
        sh0=data["sh"][:, :1],
        shN=data["sh"][:, 1:],
    )
    viewmat, K = pose["viewmat"].astype(float), pose["K"].astype(float)
    camera = Camera(
        rotation=viewmat[:3, :3],
        center=-np.linalg.solve(viewmat[:3, :3], viewmat[:3, 3]),
        fx=K[0, 0],
        fy=K[1, 1],
        cx=K[0, 2],
        cy=K[1, 2],
        width=int(pose["width"]),
        height=int(pose["height"]),
    )
    return gaussians, camera, np.load(folder / "ref_10k.npy"), np.load(folder / "refgrad_10k.npz")


@pytest.fixture
def run_python():
    """Runs a program in a fresh interpreter: run(code, cwd=checkout, **environment variables)."""

    def run(code, cwd=REPOSITORY, **variables):
        clean = {
            k: v for k, v in os.environ.items() if k not in ("DRJIT_LIBLLVM_PATH", "PYTHONPATH")
        }
        return subprocess.run(
            [sys.executable, "-c", code],
            cwd=cwd,
            env={**clean, **variables},
            capture_output=True,
            text=True,
            timeout=120,
        )

    return run


@pytest.fixture
def blender(tmp_path):
    """A NeRF-synthetic folder of 3 random 6x4 RGBA views a split; returns (folder, images)."""
    from support.datasets import CENTERS, look_at

    rng = np.random.default_rng(0)
    images = {}
    for split in ("train", "val"):
        (tmp_path / split).mkdir()
        frames = []
        for i, center in enumerate(CENTERS):
            images[split, i] = rng.integers(0, 256, (4, 6, 4), np.uint8)
            iio.imwrite(tmp_path / split / f"r_{i}.png", images[split, i])
            matrix = look_at(center, (0, 0, 0)).tolist()
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix})
        meta = {"camera_angle_x": 0.8, "frames": frames}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(meta))
    return tmp_path, images


@pytest.fixture
def photographs(tmp_path):
    """A nerfstudio folder of 10 grey 8x6 photographs, frames in reverse order of names."""
    from support.datasets import look_at

    (tmp_path / "images").mkdir()
    frames = []
    for i in reversed(range(10)):
        iio.imwrite(tmp_path / "images" / f"{i:02d}.png", np.full((6, 8, 3), 20 * i, np.uint8))
        center = (4 * math.cos(i), 4 * math.sin(i), 1)
        matrix = look_at(center, (0, 0, 0)).tolist()
        frames.append({"file_path": f"images/{i:02d}.png", "transform_matrix": matrix})
    meta = {"fl_x": 9.0, "fl_y": 8.0, "cx": 3.5, "cy": 3.25, "w": 8, "h": 6, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    return tmp_path


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """A folder as a fit leaves it, with its dataset."""
    from support.small_capture import blobs, make_dataset, write_dataset

    folder = tmp_path_factory.mktemp("fit")
    write_dataset(folder / "data", make_dataset())
    blobs().save(folder / "run" / "point_cloud.ply")
    config = {"data": {"path": str(folder / "data"), "background": "white"}}
    (folder / "run" / "config.yml").write_text(yaml.safe_dump(config))
    return folder / "run"
