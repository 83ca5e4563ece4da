"""Fits that are interrupted twice, and fits with odd names."""

import json
import os
import signal
import warnings

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from support.fit_command import (
    assert_fit_refused,
    assert_fits,
    run_fit,
    without_images,
    write_scene,
)

from drgs.training.trainer import Trainer


@pytest.fixture
def scene(tmp_path):
    often = {"checkpoint_every": 1}
    return write_scene(tmp_path, model={"sh_degree": 1}, iterations=3, output=often).parent


@pytest.mark.parametrize(("count", "kept"), [(1, 2), (2, 1)])
def test_the_first_interrupt_saves_and_the_second_ends_without_a_traceback(
    scene, monkeypatch, count, kept
):
    """Ctrl-C is pressed so often in the second iteration; kept: the checkpoint's iteration."""
    step = Trainer.step

    def step_and_interrupt(trainer):
        report = step(trainer)
        for _ in range(count if trainer.iteration == 2 else 0):
            signal.raise_signal(signal.SIGINT)
        return report

    monkeypatch.setattr(Trainer, "step", step_and_interrupt)
    before = signal.getsignal(signal.SIGINT)
    outcome = run_fit(scene / "a.yml", "--out", scene / "out")
    signal.signal(signal.SIGINT, before)
    assert (outcome.returncode, outcome.stderr) == (130, "" if count == 1 else "interrupted\n")
    assert ("stopped; continue with: " in outcome.stdout) == (count == 1)
    assert not list((scene / "out").glob(".*.tmp*"))
    with np.load(scene / "out" / "checkpoint.npz") as checkpoint:
        assert checkpoint["trainer.iteration"] == kept


def rename_view(folder, split, name):
    """Give the image of the split's first view another name."""
    path = folder / "data" / f"transforms_{split}.json"
    meta = json.loads(path.read_text())
    old = folder / "data" / f"{meta['frames'][0]['file_path']}.png"
    old.rename(old.with_name(f"{name}.png"))
    meta["frames"][0]["file_path"] = f"./{split}/{name}"
    path.write_text(json.dumps(meta))


def test_images_with_long_names_are_written_under_shorter_ones(scene, monkeypatch):
    without_images(monkeypatch)
    for split in ("train", "test"):
        rename_view(scene, split, "\u4e2d" * 83)  # 249 bytes
    assert_fits(scene / "a.yml", "--out", scene / "out")
    (rendered,) = os.listdir(scene / "out" / "renders" / "test")
    assert rendered.startswith("0000_\u4e2d") and len(os.fsencode(rendered)) < 220


@pytest.mark.slow
def test_a_configuration_whose_name_is_not_utf_8_is_fitted(scene, monkeypatch):
    """After the whole fit, its report was not written."""
    monkeypatch.chdir(scene)
    name = os.fsdecode(b"b\xff")
    (scene / "a.yml").rename(scene / f"{name}.yml")
    assert_fits(f"{name}.yml")
    assert "b\\udcff" in (scene / "out" / name / "report.html").read_text()


@pytest.mark.parametrize("option", ["--out", "--data"])
def test_folders_whose_names_are_not_utf_8_are_refused_before_the_fit(scene, option):
    words = (scene / "a.yml", "--out", scene / "out", option, scene / os.fsdecode(b"\xff"))
    assert_fit_refused(*words, folder=scene, message="must be a path in UTF-8, got ")


def test_cloud_of_coinciding_and_distant_points_is_fitted(scene, monkeypatch):
    """Without a line of NumPy's about scales that are beyond float32."""
    without_images(monkeypatch)
    points = np.zeros(18, [(axis, "f4") for axis in "xyz"])
    points[17] = (3e38, -1e30, 1)
    PlyData([PlyElement.describe(points, "vertex")]).write(str(scene / "points.ply"))
    cloud = f"init.point_cloud={scene / 'points.ply'}"
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        outcome = assert_fits(scene / "a.yml", "--out", scene / "out", "--set", cloud)
    assert outcome.stderr == ""
