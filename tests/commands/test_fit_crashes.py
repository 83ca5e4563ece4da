"""A fit that ends at any moment, before or behind any file that it puts in place, goes on.

The clock of a fit with a budget is replaced: its plan is revised after iterations that are given.
"""

import os
from functools import partial
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from support.fit_command import ITERATIONS, assert_fits, run_fit, without_images, write_project
from support.folders import visible

from drgs.config.load import load_config
from drgs.training import session
from drgs.training.loop import StopCriterion

PLANS = {2: 10, 3: 9, 5: 8}
"""Total number of iterations of the plan revised at each iteration; the clock ends it after 7."""

LAST = 7

RESULTS = {
    *("config.yml", "point_cloud.ply", "history.csv", "density.csv", "views.json"),
    *("metrics.json", "report.html"),
    *(f"{kind}/test/r_{i}.png" for kind in ("renders", "side_by_side") for i in range(2)),
}

BUDGET = ("--budget", "60s")


class Killed(BaseException):
    """An exception that no code handles."""


class Revised(StopCriterion):
    """The length of a fit whose plan changes on the way."""

    def __init__(self, *_):
        pass

    def should_continue(self, trainer):
        done = trainer.iteration
        if done in PLANS or done == LAST:
            trainer.reschedule(PLANS.get(done, LAST), trainer.config.densify.stop)
        return done < LAST


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """No time is spent on plans and reports."""
    without_images(monkeypatch)

    plan = partial(SimpleNamespace, reasons="planned", chosen=Mock(), end=0.0)
    monkeypatch.setattr(session, "plan_fit", lambda config, *_: plan(config=config))
    monkeypatch.setattr(session, "rehearse", lambda *_: (Mock(), 1.0))
    monkeypatch.setattr(session, "Deadline", Revised)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return write_project(tmp_path_factory.mktemp("project"))


def run_crashing_fit(moment, behind, *arguments):
    """Run a fit that is ended at the replacement of a file, before or behind it.

    moment: which, by number; None: none. Returns whether it got so far, and the names of what was
    put in place until then.
    """
    replace, names = os.replace, []

    def replace_or_crash(temporary, path):
        names.append(os.path.basename(path))
        is_here = len(names) - 1 == moment
        if is_here and not behind:
            raise Killed
        replace(temporary, path)
        if is_here:
            raise Killed

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(os, "replace", replace_or_crash)
        try:
            assert_fits(*arguments)
        except Killed:
            return True, names
    return False, names


def assert_done(out):
    """All is there and nothing else, and ``config.yml`` says what was done."""
    assert visible(out) - {"plan.txt"} == RESULTS
    rows = (out / "history.csv").read_text().splitlines()
    assert len(rows) == load_config(out / "config.yml").iterations + 1


@pytest.mark.slow
@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("budget", [(), BUDGET], ids=["plain", "budget"])
def test_fit_killed_at_any_file_resumes(config, tmp_path, budget, behind):
    """Also between the two files of a revised plan, and behind the last file."""
    _, names = run_crashing_fit(None, False, config, "--out", tmp_path / "whole", *budget)
    assert_done(tmp_path / "whole")
    if budget:
        saved = [moment for moment, name in enumerate(names) if name == "checkpoint.npz"]
        # After iterations 2, 4, 6 and 7.
        assert [names[moment + 1] for moment in saved] == ["config.yml"] * 4
    for moment in range(len(names)):
        out, again = tmp_path / f"{moment}", tmp_path / f"again {moment}"
        was_killed, names = run_crashing_fit(moment, behind, config, "--out", out, *budget)
        assert was_killed
        if (out / "config.yml").is_file():
            outcome = assert_fits("--resume", out)
            is_finished = "metrics.json" in (names if behind else names[:-1])
            assert ("this fit is finished" in outcome.stdout) == is_finished, names
            if "history.csv" in names and not is_finished and not budget:  # results, once more
                assert f"continues at iteration {ITERATIONS}\n" in outcome.stdout
                for name in RESULTS - {"history.csv", "metrics.json", "config.yml"}:
                    expected = (tmp_path / "whole" / name).read_bytes()
                    assert (out / name).read_bytes() == expected, name
        else:
            assert_fits(config, "--out", out, *budget)
        assert_done(out)
        assert_fits(out / "config.yml", "--out", again)
        for name in ("point_cloud.ply", "renders/test/r_1.png"):
            assert (out / name).read_bytes() == (again / name).read_bytes(), name


@pytest.mark.slow
def test_half_removed_run_is_not_finished(config, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert_fits(config, "--out", out)
    unlink, removed = os.unlink, []

    def unlink_two(path, *arguments, **options):
        if len(removed) == 2:
            raise Killed
        removed.append(os.path.basename(path))
        unlink(path, *arguments, **options)

    with monkeypatch.context() as patched, pytest.raises(Killed):
        patched.setattr(os, "unlink", unlink_two)
        run_fit(config, "--out", out, "--overwrite")
    assert removed[0] == "metrics.json"
    assert "this fit is finished" not in assert_fits(config, "--out", out).stdout
    assert_done(out)
