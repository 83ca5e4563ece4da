"""Fits that are interrupted twice, and fits with odd names."""

import json
import os
import signal
import warnings

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from support.commands import run_in_process
from support.fit_command import write_scene

from drgs import fit
from drgs.training import fit_folder
from drgs.training.trainer import Trainer


@pytest.fixture
def scene(tmp_path):
    often = {"checkpoint_every": 1}
    return write_scene(tmp_path, model={"sh_degree": 1}, iterations=3, output=often).parent


@pytest.fixture
def interrupts(monkeypatch):
    """How often Ctrl-C is pressed during the second iteration."""
    before = signal.getsignal(signal.SIGINT)
    counts, step = [1], Trainer.step

    def step_and_interrupt(trainer):
        report = step(trainer)
        for _ in range(counts[0] if trainer.iteration == 2 else 0):
            signal.raise_signal(signal.SIGINT)
        return report

    monkeypatch.setattr(Trainer, "step", step_and_interrupt)
    yield counts
    signal.signal(signal.SIGINT, before)


def test_the_first_interrupt_saves_and_the_second_ends_without_a_traceback(scene, interrupts):
    once = run_in_process(fit.main, scene / "a.yml", "--out", scene / "once")
    assert (once.returncode, once.stderr) == (130, "")
    assert once.stdout.splitlines()[-1].startswith("stopped; continue with: ")
    interrupts[0] = 2
    twice = run_in_process(fit.main, scene / "a.yml", "--out", scene / "twice")
    assert (twice.returncode, twice.stderr) == (130, "interrupted\n")
    for name, iteration in (("once", 2), ("twice", 1)):
        assert not list((scene / name).glob(".*.tmp*"))
        with np.load(scene / name / "checkpoint.npz") as checkpoint:
            assert checkpoint["trainer.iteration"] == iteration


def rename_view(folder, split, name):
    """Give the image of the split's first view another name."""
    path = folder / "data" / f"transforms_{split}.json"
    meta = json.loads(path.read_text())
    old = folder / "data" / f"{meta['frames'][0]['file_path']}.png"
    old.rename(old.with_name(f"{name}.png"))
    meta["frames"][0]["file_path"] = f"./{split}/{name}"
    path.write_text(json.dumps(meta))


def test_images_with_long_names_are_written_under_shorter_ones(scene, monkeypatch):
    monkeypatch.setattr(fit_folder, "write_results", lambda *arguments: None)
    for split in ("train", "test"):
        rename_view(scene, split, "\u4e2d" * 83)  # 249 bytes
    outcome = run_in_process(fit.main, scene / "a.yml", "--out", scene / "out")
    assert outcome.returncode == 0, outcome.stderr
    (rendered,) = os.listdir(scene / "out" / "renders" / "test")
    assert rendered.startswith("0000_\u4e2d") and len(os.fsencode(rendered)) < 220


@pytest.mark.slow
def test_a_configuration_whose_name_is_not_utf_8_is_fitted(scene, monkeypatch):
    """After the whole fit, its report was not written."""
    monkeypatch.chdir(scene)
    name = os.fsdecode(b"b\xff")
    (scene / "a.yml").rename(scene / f"{name}.yml")
    outcome = run_in_process(fit.main, f"{name}.yml")
    assert outcome.returncode == 0, outcome.stderr
    assert "b\\udcff" in (scene / "out" / name / "report.html").read_text()


@pytest.mark.parametrize("option", ["--out", "--data"])
def test_folders_whose_names_are_not_utf_8_are_refused_before_the_fit(scene, option):
    name = os.fsdecode(b"\xff")
    outcome = run_in_process(
        fit.main, scene / "a.yml", "--out", scene / "out", option, scene / name
    )
    assert outcome.returncode == 2
    assert "must be a path in UTF-8, got " in outcome.stderr and outcome.stderr.count("\n") == 1
    assert sorted(os.listdir(scene)) == ["a.yml", "data"]


def test_cloud_of_coinciding_and_distant_points_is_fitted(scene, monkeypatch):
    """Without a line of NumPy's about scales that are beyond float32."""
    monkeypatch.setattr(fit_folder, "write_results", lambda *arguments: None)
    points = np.zeros(18, [(axis, "f4") for axis in "xyz"])
    points[17] = (3e38, -1e30, 1)
    PlyData([PlyElement.describe(points, "vertex")]).write(str(scene / "points.ply"))
    cloud = f"init.point_cloud={scene / 'points.ply'}"
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        outcome = run_in_process(fit.main, scene / "a.yml", "--out", scene / "out", "--set", cloud)
    assert (outcome.returncode, outcome.stderr) == (0, "")
