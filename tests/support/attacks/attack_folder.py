"""The folder that attacks happen in: every kind of file that the commands read, and a user's own.

It is built once, kept as a copy, and put back after each attack. Its path never changes, since
some of its files hold it.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from unittest.mock import patch

import imageio.v3 as iio
import numpy as np
import yaml

from drgs.capture import __main__ as capture
from drgs.core.files import atomic_path
from drgs.fit import __main__ as fit
from drgs.results.folder import CHECKPOINT, CURVES, ORBIT, REPORT, VIEWER
from support.attacks.attack import Fault, observed
from support.commands import assert_ends_well, run_in_process
from support.datasets import write_points
from support.ksplat import content_of
from support.small_capture import HEIGHT, WIDTH, blobs, make_dataset, pose_around, write_dataset

SETTINGS = {
    "data": {"path": "lego"},
    "init": {"point_cloud": "points.ply"},
    "model": {"sh_degree": 0},
    "densify": {"max_gaussians": 100},
    "output": {"dir": "out", "history_every": 1, "checkpoint_every": 1},
    "iterations": 2,
}

PHOTOGRAPHS = {"data": {"path": "photos", "background": "black"}}
"""Sections of ``photos.yml`` that differ; its masks, depths, lens and motion are all looked at."""

SPLATS = """<scene version="3.0.0">
    <integrator type="splats">
        <string name="filename" value="gaussians.ply"/>
        <rgb name="background" value="1, 1, 1"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="4, 0, 1" target="0, 0, 0" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="32"/><integer name="height" value="24"/>
            <rfilter type="box"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
    </sensor>
</scene>
"""

BALL = """<scene version="3.0.0">
    <emitter type="constant"><rgb name="radiance" value="1"/></emitter>
    <shape type="sphere">
        <float name="radius" value="0.8"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf>
    </shape>
</scene>
"""

CAPTURE = (
    *("ball.xml", "--views", "2", "--test-views", "1", "--spp", "1", "--points", "9"),
    *("--max-depth", "2", "--size", "4", "4"),
)


def _pose(angle: float) -> list[list[float]]:
    return (pose_around(angle, 0.3) * [1, -1, -1, 1]).tolist()  # OpenGL axes


def _noise(seed: int, channels: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, channels), np.uint8)


def write_photos(folder: Path) -> None:
    """The nerfstudio layout, with a lens, a mask, depths of both kinds, and a camera that moves."""
    folder.mkdir()
    frames = [{"file_path": f"{i}.png", "transform_matrix": _pose(1.5 * i)} for i in range(4)]
    frames[1] |= {"mask_path": "mask.png", "transform_matrix_close": _pose(1.51)}
    frames[2] |= {"depth_file_path": "depth.npy"}
    frames[3] |= {"depth_file_path": "depth.png"}
    for i in range(4):
        iio.imwrite(folder / f"{i}.png", _noise(i, 3))
    iio.imwrite(folder / "mask.png", np.where(_noise(5, 1)[:, :, 0] > 20, 255, 0).astype(np.uint8))
    iio.imwrite(folder / "depth.png", np.full((HEIGHT, WIDTH), 4000, np.uint16))
    np.save(folder / "depth.npy", np.full((HEIGHT, WIDTH), 4, np.float32))
    meta = {"fl_x": 27.0, "fl_y": 27.0, "cx": 16.0, "cy": 12.0, "w": WIDTH, "h": HEIGHT}
    meta |= {"camera_model": "OPENCV", "k1": 0.01, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(meta))


def write_inputs(folder: Path) -> None:
    """Everything but what the commands write themselves."""
    write_dataset(folder / "lego", make_dataset(train=3, test=1))
    write_photos(folder / "photos")
    positions, colors = np.random.default_rng(0).uniform(-1, 1, (12, 3)), _noise(6, 3)[0, :12]
    write_points(folder / "points.ply", positions, colors)
    for suffix in (".ply", ".compressed.ply", ".spz", ".glb", ".sog"):
        blobs(12).save(folder / f"gaussians{suffix}")
    replace(blobs(12), shN=np.zeros((12, 0, 3), np.float32)).save(folder / "gaussians.splat")
    (folder / "gaussians.ksplat").write_bytes(content_of([(blobs(12), 1)], 1))
    (folder / "fit.yml").write_text(yaml.safe_dump(SETTINGS))
    (folder / "photos.yml").write_text(yaml.safe_dump(SETTINGS | PHOTOGRAPHS))
    frame = {"transform_matrix": _pose(0.5)}
    camera = {"camera_angle_x": 0.7, "w": WIDTH, "h": HEIGHT, "frames": [frame]}
    (folder / "camera.json").write_text(json.dumps(camera))
    (folder / "splats.xml").write_text(SPLATS)
    (folder / "ball.xml").write_text(BALL)
    iio.imwrite(folder / "sky.png", _noise(9, 3))
    (folder / "mine").mkdir()
    (folder / "mine" / "notes.txt").write_text("not to be touched")


@contextmanager
def current_folder(folder: Path) -> Iterator[None]:
    """The current folder within the block."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


@contextmanager
def stub_results() -> Iterator[None]:
    """Within the block a fit writes its drawings, but does not draw: that takes seconds."""

    def write(out: Path, *others: object) -> None:
        for name in (CURVES, ORBIT, REPORT, VIEWER):
            with atomic_path(out / name) as temporary:
                temporary.write_text("a sketch")

    with patch("drgs.fit.fit_folder.write_results", write):
        yield


class AttackFolder:
    """See this module. ``folder`` is where attacks happen."""

    def __init__(self, base: Path, with_results: bool = True) -> None:
        """with_results: whether there are folders that the commands have written."""
        self.folder, self._kept = base / "workshop", base / "kept"
        self.undisturbed: dict[tuple, dict[str, str]] = {}  # files of commands without faults
        self.folder.mkdir(parents=True)
        write_inputs(self.folder)
        if with_results:
            with current_folder(self.folder), stub_results():
                self._run_commands()
        shutil.copytree(self.folder, self._kept)

    def _run_commands(self) -> None:
        """``stopped/``: a fit with a checkpoint; ``run/``: one that has ended; ``captured/``."""
        with observed(self.folder, _CtrlCAtCheckpoint("interrupt", 0)):
            outcome = run_in_process(fit.main, "fit.yml", "--out", "stopped")
        assert outcome.returncode == 130, outcome
        shutil.copytree("stopped", "run")
        assert_ends_well(fit.main, "--resume", "run")
        assert_ends_well(capture.main, *CAPTURE, "--out", "captured")

    def restore_files(self) -> None:
        """Undo what an attack did."""
        for path in self.folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
        shutil.copytree(self._kept, self.folder, dirs_exist_ok=True)


class _CtrlCAtCheckpoint(Fault):
    def strike(self, number: int, event: str, path: str) -> None:
        if event == "os.rename" and path.endswith(CHECKPOINT):
            signal.raise_signal(signal.SIGINT)


MAX_READ_BYTES = 1 << 26
"""Larger files are sparse, and nobody writes a part of them."""


def contents(folder: Path) -> dict[str, str]:
    """Return kind, target or digest of everything below ``folder``, by relative path."""
    paths = [
        os.path.join(parent, name)
        for parent, folders, files in os.walk(folder)
        for name in (*folders, *files)
    ]
    return {os.path.relpath(path, folder): _digest_or_kind(path) for path in paths}


def _digest_or_kind(path: str) -> str:
    status = os.lstat(path)
    if stat.S_ISLNK(status.st_mode):
        return f"link to {os.readlink(path)}"
    if not stat.S_ISREG(status.st_mode):
        return f"special {stat.S_IFMT(status.st_mode)}"
    if status.st_size > MAX_READ_BYTES:
        return f"{status.st_size} bytes"
    with open(path, "rb") as file:
        return blake2b(file.read(), digest_size=16).hexdigest()
