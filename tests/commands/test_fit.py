"""``python -m drgs.fit`` from end to end, on a small scene made by the reference renderer."""

import csv
import json
import signal
import subprocess
import sys
import time
from dataclasses import make_dataclass
from datetime import datetime
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest
import yaml
from conftest import REPOSITORY
from support.fit_command import (
    assert_fit_refused,
    assert_fits,
    run_fit,
    without_images,
    write_project,
)
from support.folders import visible
from support.small_capture import write_dataset
from support.small_fits import config_of, make_trainer, plain_dataset, steps, true_blobs
from support.viewer_rendering import VIEWER_RENDERING

from drgs.cli.commands import CommandParser
from drgs.config.changes import with_changes
from drgs.core.errors import UserNote
from drgs.fit import budget
from drgs.fit.__main__ import add_arguments
from drgs.fit.report import Seconds
from drgs.fit.viewers_fit import TIME_SHARE
from drgs.gaussians.parameters import Gaussians
from drgs.training.trainer import Trainer

OUTPUTS = (
    *("point_cloud.ply", "metrics.json", "history.csv", "density.csv", "config.yml"),
    *("curves.png", "orbit.webp", "report.html", "viewer.html", "views.json", "cameras.json"),
    *(f"{kind}/test/r_{i}.png" for kind in ("renders", "side_by_side") for i in range(3)),
)


@pytest.fixture(scope="module")
def configuration(tmp_path_factory):
    folder = tmp_path_factory.mktemp("blobs")
    write_dataset(folder, plain_dataset(), alpha=1.0)
    values = {
        "data": {"path": str(folder), "background": "white"},
        "init": {"num_points": 300, "half_extent": 1.0},
        "model": {"sh_degree": 1, "sh_increase_every": 100, **VIEWER_RENDERING},
        "densify": {
            "strategy": "adc",
            "adc": {"clone_scale": 0.03, "reset_every": 150, "white_background_reset": 80},
            "start": 60,
            "stop": 200,
            "every": 20,
            "max_gaussians": 500,
        },
        "iterations": 300,
    }
    path = folder / "blobs.yml"
    path.write_text(yaml.safe_dump(values))
    return path


def begin(*words):
    """Start the command in a process of its own."""
    command = [sys.executable, "-m", "drgs.fit", *map(str, words)]
    return subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True)


@pytest.fixture(scope="module")
def fitted(configuration, tmp_path_factory):
    """The lines that the command printed, and its folder."""
    out = tmp_path_factory.mktemp("out") / "first"
    process = begin(configuration, "--out", out, "--threads", 2)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    return output.splitlines(), out


def test_fit_writes_its_outputs_and_prints_its_progress(fitted, configuration):
    """Readable without a terminal; the report records command, machine and date."""
    lines, out = fitted
    assert visible(out) == set(OUTPUTS)
    assert lines[-1] == f"open {out / 'report.html'}"
    last = [line for line in lines if line.startswith("iteration")][-1]
    for word in ("iteration 300/300", "loss", "PSNR", "Gaussians", "left"):
        assert word in last
    assert not any("\x1b" in line for line in lines)
    page, metrics = (
        (out / "report.html").read_text(),
        json.loads((out / "metrics.json").read_text()),
    )
    command = f"python -m drgs.fit {configuration} --out {out} --threads 2"
    assert metrics["command"] == command and command in page
    assert metrics["processor"] and metrics["processor"] in page
    assert abs(datetime.fromisoformat(metrics["date"]).timestamp() - time.time()) < 3600
    assert '<a href="point_cloud.ply" download>' in page


def test_test_views_are_shown_well_and_measured(fitted, configuration):
    _, out = fitted
    metrics = json.loads((out / "metrics.json").read_text())
    # 300 random points reach 31 dB; a fit that does not learn stays below 15 dB.
    assert metrics["test"]["psnr"] > 29
    assert (metrics["test"]["num_views"], metrics["test"]["split"]) == (3, "test")
    assert (metrics["iterations"], metrics["seed"]) == (300, 0)
    assert metrics["config"]["densify"]["max_gaussians"] == 500
    scores = []
    for i in range(3):
        photo = iio.imread(configuration.parent / "test" / f"r_{i}.png")[:, :, :3] / 255
        image = iio.imread(out / "renders" / "test" / f"r_{i}.png") / 255
        scores.append(-10 * np.log10(np.mean((image - photo) ** 2)))
    # The images are rounded to 8 bits: at 30 dB that moves the PSNR by about 0.01 dB.
    assert np.mean(scores) == pytest.approx(metrics["test"]["psnr"], abs=0.1)


def test_history_has_the_population_and_scores(fitted):
    """The population never exceeds its cap; all three test views are measured on the way."""
    _, out = fitted
    rows = list(csv.DictReader((out / "history.csv").open()))
    assert [int(row["iteration"]) for row in rows] == list(range(10, 301, 10))
    population = [int(row["num_gaussians"]) for row in rows]
    density = list(csv.DictReader((out / "density.csv").open()))
    for change in ("cloned", "split", "pruned"):
        assert sum(int(row[change]) for row in density) > 0, change
    assert len(set(population)) > 1 and max(population) <= 500
    assert Gaussians.load(out / "point_cloud.ply").num_gaussians == population[-1]
    assert float(rows[-1]["loss"]) < 0.5 * float(rows[0]["loss"])
    measured = {row["iteration"]: row["test_psnr"] for row in rows if row["test_psnr"]}
    assert list(measured) == ["100", "200", "300"]
    metrics = json.loads((out / "metrics.json").read_text())
    assert float(measured["300"]) == pytest.approx(metrics["test"]["psnr"], abs=1e-3)


@pytest.mark.slow
def test_the_resolved_configuration_gives_the_same_bytes_on_any_number_of_threads(fitted, tmp_path):
    """One thread, and the first fit's two; Gaussians were cloned, split, pruned and reset."""
    _, first = fitted
    again = tmp_path / "again"
    assert_fits(first / "config.yml", "--out", again, "--threads", 1)
    for folder, threads in ((first, 2), (again, 1)):
        assert json.loads((folder / "metrics.json").read_text())["threads"] == threads
    for name in ("point_cloud.ply", "renders/test/r_0.png"):
        assert (again / name).read_bytes() == (first / name).read_bytes(), name
    page = (first / "viewer.html").read_text().replace("<title>first:", "<title>again:")
    assert (again / "viewer.html").read_text() == page


@pytest.mark.slow
def test_seed_decides_the_order_of_the_views():
    def order(seed):
        trainer = make_trainer(plain_dataset(), seed=seed)
        return [steps(trainer, 1).last_step.views[-1].view.index for _ in range(8)]

    assert order(0) == order(0) != order(1)


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL])
def test_stopped_fit_resumes_to_the_same_bytes(fitted, configuration, tmp_path, sent):
    """Ctrl-C saves and exits with 130; kill -9 loses what came after the last checkpoint."""
    _, first = fitted
    out = tmp_path / "stopped"
    process = begin(configuration, "--out", out, "--set", "output.checkpoint_every=20")
    deadline = time.monotonic() + 120
    while not (out / "checkpoint.npz").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(sent)
    output, _ = process.communicate(timeout=120)
    if sent == signal.SIGINT:
        assert process.returncode == 130
        assert f"python -m drgs.fit --resume {out}" in output
    assert not (out / "metrics.json").exists()

    assert "continues at iteration" in assert_fits("--resume", out).stdout
    for name in ("point_cloud.ply", "renders/test/r_0.png"):
        assert (out / name).read_bytes() == (first / name).read_bytes(), name
    rows = list(csv.DictReader((out / "history.csv").open()))
    assert [int(row["iteration"]) for row in rows] == list(range(10, 301, 10))
    assert not (out / "checkpoint.npz").exists()


@pytest.mark.parametrize(("count", "kept"), [(1, 2), (2, 1)])
def test_the_first_interrupt_saves_and_the_second_ends_without_a_traceback(
    tmp_path, monkeypatch, count, kept
):
    """Ctrl-C is pressed so often in the second iteration; kept: the checkpoint's iteration."""
    out, step = tmp_path / "out", Trainer.step
    config = write_project(tmp_path, iterations=3, output={"checkpoint_every": 1})

    def step_and_interrupt(trainer):
        report = step(trainer)
        for _ in range(count if trainer.iteration == 2 else 0):
            signal.raise_signal(signal.SIGINT)
        return report

    monkeypatch.setattr(Trainer, "step", step_and_interrupt)
    before = signal.getsignal(signal.SIGINT)
    outcome = run_fit(config, "--out", out)
    signal.signal(signal.SIGINT, before)
    assert (outcome.returncode, outcome.stderr) == (130, "" if count == 1 else "interrupted\n")
    assert ("stopped; continue with: " in outcome.stdout) == (count == 1)
    assert not list(out.glob(".*.tmp*"))
    with np.load(out / "checkpoint.npz") as checkpoint:
        assert checkpoint["trainer.iteration"] == kept


def test_budget_reserves_time_for_results_or_skips_them(monkeypatch):
    """The clock stands still; results take 6 s, report and images 4 s, a file for viewers 4 s."""
    changes = {
        "seconds_of_results": lambda *_: Seconds(6.0, viewers=4.0, renders=1.0, report=3.0),
        "make_plan": lambda config, *_: make_dataclass("Plan", ["config", "end"])(config, 0.0),
        "time": SimpleNamespace(perf_counter=lambda: 0.0),
    }
    for name, value in changes.items():
        monkeypatch.setattr(budget, name, value)

    def planned(seconds, **values):
        config = with_changes(config_of(), {k.replace("__", "."): v for k, v in values.items()})
        plan = budget.plan_fit(config, plain_dataset(), true_blobs(), seconds, None, 0.1)
        return plan.end, plan.config.output

    assert planned(100.0)[0] == 90
    end, _ = planned(100.0, model__antialiased=True)  # and a file for viewers
    assert end == pytest.approx(86 * (1 - TIME_SHARE))
    end, output = planned(13.0)
    assert end == 3 and output.report and output.save_renders
    with pytest.warns(UserNote, match=r"no report, orbit and images are written"):
        end, output = planned(12.0)
    assert end == 6 and not output.report and not output.save_renders
    end, output = planned(12.0, output__report=False)
    assert end == 5 and output.save_renders
    end, output = planned(7.0, output__report=False, output__save_renders=False)
    assert end == 1 and not output.report and not output.save_renders


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
    pages = {"curves.png", "orbit.webp", "report.html", "side_by_side", "viewer.html"}
    assert written[0] - written[1] == pages and written[1] < written[0]
    assert metrics[0] == metrics[1]
    for name in set(histories[0][0]) - {"wall_s", "test_psnr"}:
        first, second = ([row[name] for row in rows] for rows in histories)
        assert first == second, name
    measured = [any(row["test_psnr"] for row in rows) for rows in histories]
    assert measured == [True, False]


def test_most_gaussians_are_a_setting():
    parser = CommandParser(prog="drgs fit")
    add_arguments(parser)
    args = parser.parse_args(["a.yml", "--max-gaussians", "50", "--set", "iterations=9"])
    assert args.overrides == ["densify.max_gaussians=50", "iterations=9"]


def test_photographs_that_are_left_out_are_not_fitted(tmp_path, monkeypatch):
    without_images(monkeypatch)
    project, out = write_project(tmp_path), tmp_path / "out"
    text = assert_fits(project, "--out", out, "--leave-out", "train/r_1").stdout
    assert "; 1 left out" in text and "2 views to train on, 2 of split 'test'" in text
    assert yaml.safe_load((out / "config.yml").read_text())["data"]["leave_out"] == ["train/r_1"]
    message = "data.leave_out: "
    words = (project, "--out", tmp_path / "other", "--leave-out")
    assert_fit_refused(*words, "r_1.jpg", folder=tmp_path, message=message)
    message = "--set, --leave-out, --budget and --overwrite"
    assert_fit_refused("--resume", out, "--leave-out", "r_1", folder=tmp_path, message=message)
