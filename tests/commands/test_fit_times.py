"""``fit --budget``: what of a time is for iterations. ``output.report: false``."""

import csv
import json
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from support.fit_command import assert_fits, write_project
from support.small_fits import config_of, plain_dataset, true_blobs

from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig
from drgs.core.errors import UserNote
from drgs.results.files import (
    CURVES,
    HISTORY,
    METRICS,
    ORBIT,
    ORBIT_GIF,
    REPORT,
    SIDE_BY_SIDE,
    VIEWER,
)
from drgs.results.report import Seconds
from drgs.training import budget
from drgs.training.viewers import TIME_SHARE


@dataclass(frozen=True)
class Planned:
    config: FitConfig
    end: float = 0.0


@pytest.fixture
def planned(monkeypatch):
    """When iterations end, and for which configuration, by a clock that says 0."""
    monkeypatch.setattr(
        budget, "seconds_of_results", lambda *_: Seconds(6.0, renders=1.0, report=1.0)
    )
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
    """Everything else is there; no test view is measured on the way."""
    config, written = write_project(tmp_path), {}
    for name in ("true", "false"):
        out = tmp_path / name
        assert_fits(config, "--out", out, "--set", f"output.report={name}")
        written[name] = {path.relative_to(out).parts[0] for path in out.rglob("*")}
    pages = {REPORT, CURVES, ORBIT, ORBIT_GIF, SIDE_BY_SIDE, VIEWER}
    assert written["true"] - written["false"] == pages and written["false"] < written["true"]
    first, second = (json.loads((tmp_path / n / METRICS).read_text())["test"] for n in written)
    assert first == second
    first, second = (list(csv.DictReader((tmp_path / n / HISTORY).open())) for n in written)
    assert any(row["test_psnr"] for row in first) and not any(r["test_psnr"] for r in second)
    for with_report, without in zip(first, second, strict=True):
        for name in set(without) - {"wall_s", "test_psnr"}:
            assert with_report[name] == without[name], name
