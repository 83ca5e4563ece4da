"""Fits that are interrupted, in a given time, and without a report."""

import csv
import json
import signal
from dataclasses import make_dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from support.fit_command import (
    assert_fits,
    run_fit,
    without_images,
    write_project,
)
from support.small_fits import config_of, plain_dataset, true_blobs

from drgs.config.changes import with_changes
from drgs.core.errors import UserNote
from drgs.results.report import Seconds
from drgs.training import budget
from drgs.training.trainer import Trainer
from drgs.training.viewers import TIME_SHARE


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
    """By a clock that stands still, for results of 6 s, 2 of them for report and images."""
    changes = {
        "seconds_of_results": lambda *_: Seconds(6.0, renders=1.0, report=1.0),
        "seconds_of_curves": lambda: 2.0,
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
    assert end == pytest.approx(84 * (1 - TIME_SHARE))
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
