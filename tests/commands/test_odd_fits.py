"""Fits with odd names and clouds, interrupted twice, in a given time, and without a report."""

import csv
import json
import os
import signal
import warnings
from dataclasses import make_dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from support.fit_command import (
    assert_fit_refused,
    assert_fits,
    run_fit,
    without_images,
    write_project,
    write_scene,
)
from support.small_fits import config_of, plain_dataset, true_blobs

from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig
from drgs.core.errors import UserNote
from drgs.results.report import Seconds
from drgs.training import budget
from drgs.training.trainer import Trainer
from drgs.training.viewers import TIME_SHARE


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


Planned = make_dataclass("Planned", [("config", FitConfig), ("end", float, 0.0)])


@pytest.fixture
def planned(monkeypatch):
    """When iterations end, and for which configuration, by a clock that says 0."""
    seconds = Seconds(6.0, renders=1.0, report=1.0)
    monkeypatch.setattr(budget, "seconds_of_results", lambda *_: seconds)
    monkeypatch.setattr(budget, "seconds_of_curves", lambda: 2.0)
    monkeypatch.setattr(budget, "make_plan", lambda config, *_: Planned(config))
    monkeypatch.setattr(budget, "time", SimpleNamespace(perf_counter=lambda: 0.0))

    def plan(config, seconds):
        plan = budget.plan_fit(config, plain_dataset(), true_blobs(), seconds, None, 0.1)
        return plan.end, plan.config

    return plan


def test_budget_reserves_time_for_the_viewers_file(planned):
    """And for measuring it."""
    end, _ = planned(config_of(), 100.0)
    assert end == 90
    end, _ = planned(with_changes(config_of(), {"model.antialiased": True}), 100.0)
    assert end == pytest.approx(84 * (1 - TIME_SHARE))


def test_short_budget_skips_report_and_images(planned):
    end, config = planned(config_of(), 13.0)
    assert end == 3 and config.output.report and config.output.save_renders
    with pytest.warns(UserNote, match=r"no report, orbit and images are written"):
        end, config = planned(config_of(), 12.0)
    assert end == 6 and not config.output.report and not config.output.save_renders
    end, config = planned(with_changes(config_of(), {"output.report": False}), 12.0)
    assert end == 5 and config.output.save_renders
    nothing = with_changes(config_of(), {"output.report": False, "output.save_renders": False})
    assert planned(nothing, 7.0) == (1, nothing)


@pytest.mark.slow
def test_fit_without_a_report_writes_everything_else(tmp_path):
    """No test view is measured on the way."""
    config, written, metrics, histories = write_project(tmp_path), [], [], []
    for name in ("true", "false"):
        out = tmp_path / name
        assert_fits(config, "--out", out, "--set", f"output.report={name}")
        written.append({path.relative_to(out).parts[0] for path in out.rglob("*")})
        metrics.append(json.loads((out / "metrics.json").read_text())["test"])
        histories.append(list(csv.DictReader((out / "history.csv").open())))
    pages = {"curves.png", "orbit.webp", "orbit.gif", "report.html", "side_by_side", "viewer.html"}
    assert written[0] - written[1] == pages and written[1] < written[0]
    assert metrics[0] == metrics[1]
    for name in set(histories[0][0]) - {"wall_s", "test_psnr"}:
        first, second = ([row[name] for row in rows] for rows in histories)
        assert first == second, name
    measured = [any(row["test_psnr"] for row in rows) for rows in histories]
    assert measured == [True, False]


@pytest.mark.slow
def test_fit_with_all_effects_writes_their_files(tmp_path, monkeypatch):
    without_images(monkeypatch)
    config = write_project(
        tmp_path,
        model={"sh_degree": 1, "sh_increase_every": 2, "smoothing": True},
        colors={"lr": 0.02},
        cameras={"optimise": True, "focal_lr": 1e-4, "principal_lr": 1e-4},
    )
    assert_fits(config, "--out", tmp_path / "out")
    assert (tmp_path / "out" / "cameras.json").is_file()
