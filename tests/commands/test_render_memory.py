"""Images that cannot be held are refused with the limit and the estimate, before anything is."""

import json
import os

import pytest
from support.commands import run_in_process
from support.datasets import look_at
from support.small_capture import blobs

from drgs import render
from drgs.core import memory
from drgs.core.constants import MAX_SHUTTER_SAMPLES

POSE = look_at((4, 0, 1), (0, 0, 0)).tolist()


@pytest.fixture(autouse=True)
def eight_gigabytes(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 8 * 10**9)


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.ply"
    blobs().save(path)
    return path


def cameras(folder, **values):
    path = folder / "cameras.json"
    path.write_text(json.dumps({"frames": [{"transform_matrix": POSE}], **values}))
    return path


def refused(main, out, *arguments):
    """The line that the command prints; nothing is written."""
    outcome = run_in_process(main, *arguments, "--out", out)
    assert outcome.returncode == 2, outcome
    assert outcome.stderr.startswith("error: ") and outcome.stderr.count("\n") == 1
    assert not os.path.lexists(out)
    return outcome.stderr.removeprefix("error: ").rstrip()


def gigabytes(pixels):
    return memory.format_bytes(pixels * memory.IMAGE_BYTES)


def test_size_larger_than_memory_is_refused(model, tmp_path):
    """With what it needs, what there is, and what fits."""
    camera = ("--origin", 0, -4, 1)
    most = 8 * 10**9 // memory.IMAGE_BYTES
    assert refused(render.main, tmp_path / "out", model, *camera, "--size", 20000, 20000) == (
        f"view camera: 20000 x 20000 px need about {gigabytes(4e8)} of memory, of which 8 GB are "
        f"available; at most {most:,} pixels fit; give a smaller --size"
    )
    line = refused(render.main, tmp_path / "out", model, *camera, "--size", 70000, 70000)
    assert "are too many for Dr.Jit, whose arrays end at 2^32 entries" in line


@pytest.mark.parametrize("width", [1e9, 1e300])
def test_camera_file_with_size_beyond_limits_is_refused(model, tmp_path, width):
    path = cameras(tmp_path, camera_angle_x=0.7, w=width, h=width)
    line = refused(render.main, tmp_path / "out", model, "--camera", path)
    assert line.startswith(f"{path}: w must be <= 16777216, got ")
    assert len(line) < 300


def test_shutter_samples_count_towards_memory(photographs, model, tmp_path):
    """An image that would fit once does not a thousand times; more times are refused."""
    path = cameras(tmp_path, camera_angle_x=0.7, w=800, h=800)
    values = json.loads(path.read_text())
    values["frames"][0]["transform_matrix_close"] = look_at((4, 0.1, 1), (0, 0, 0)).tolist()
    path.write_text(json.dumps(values))
    config = tmp_path / "a.yml"
    config.write_text(f"data: {{path: {photographs}, shutter_samples: {MAX_SHUTTER_SAMPLES}}}")
    arguments = (model, "--scene", config, "--camera", path)
    line = refused(render.main, tmp_path / "out", *arguments)
    assert "800 x 800 px with 1,000 samples each need about " in line
    line = refused(render.main, tmp_path / "out", *arguments, "--set", "data.shutter_samples=1001")
    assert "data.shutter_samples must be <= 1000, got 1001" in line
