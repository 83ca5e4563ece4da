"""Short fits within a given time, with a clock that is known."""

from itertools import count
from types import SimpleNamespace

import pytest
from support.small_capture import make_dataset, write_dataset

import drgs
from drgs.config.load import config_from
from drgs.datasets import load_dataset
from drgs.examine import short_fits
from drgs.examine.short_fits import OutOfTimeError, plan_short_fits, shorten, split_views
from drgs.fit.budget import Budget
from drgs.fit.session import FitSession
from drgs.initialization.defaults import resolve_defaults


@pytest.fixture
def plan_for(monkeypatch):
    """Return the plan for some seconds, where a look at the clock takes 0.1 s, and nothing else."""
    dataset = make_dataset(40)
    values = {"iterations": 3000, "init": {"num_points": 60, "half_extent": 0.6}}
    config = config_from({"data": {"path": "."}, **values}, "test")
    config, (folds, _) = shorten(resolve_defaults(config, dataset)), split_views(dataset)

    def plan(seconds):
        ticks = count()
        clock = SimpleNamespace(perf_counter=lambda: 0.1 * next(ticks))
        monkeypatch.setattr(short_fits, "time", clock)
        planned, smaller = plan_short_fits(config, folds[0], seconds)
        return planned.iterations, smaller

    return plan


def test_an_examination_is_as_large_as_there_is_time(plan_for):
    assert plan_for(float("inf")) == plan_for(200.0) == (400, "")
    # 10 iterations look at the clock 10 times: 0.16 s each, as they grow; and two short fits.
    iterations, smaller = plan_for(120.0)
    assert iterations == pytest.approx((120 - 3.2) / 2 / 0.16, abs=2)
    assert smaller == f"{iterations} of 400 iterations"


@pytest.mark.parametrize("seconds", [80.0, 0.5])
def test_without_time_for_the_least_there_is_none(plan_for, seconds):
    with pytest.raises(OutOfTimeError):
        plan_for(seconds)


def test_an_examination_that_takes_too_long_is_none_and_says_so():
    found = drgs.examine(make_dataset(40), {"iterations": 1500}, seconds=0.001)
    assert found.decisions == () and found.changes == {}
    assert str(found).startswith("not examined: short fits take longer than the 0 s")


def install(monkeypatch, result):
    """Let an examiner return ``result``; return the seconds that it is given."""
    given = []

    def examine(dataset, config, update, seconds):
        given.append(seconds)
        return result

    found = SimpleNamespace(value=examine)
    registry = SimpleNamespace(names=lambda: ["mine"], get=lambda name: found)
    monkeypatch.setattr("drgs.fit.session.EXAMINERS", registry)
    return given


def test_a_fit_gives_an_examination_a_tenth_of_its_budget(monkeypatch):
    given = install(monkeypatch, SimpleNamespace(changes={}))
    config = config_from({"data": {"path": "."}}, "test")
    for budget in (None, Budget(300.0, 1e12), Budget(300.0, -1e12)):
        FitSession(config, make_dataset(4), budget=budget)._examine(config)
    assert given == [None, 30.0, 0.0]


def test_photographs_that_are_chosen_to_be_left_out_are_left_out(monkeypatch, tmp_path):
    install(monkeypatch, SimpleNamespace(changes={"data.leave_out": ["r_1"]}))
    write_dataset(tmp_path, make_dataset(4))
    config = config_from({"data": {"path": str(tmp_path)}}, "test")
    session = FitSession(config, load_dataset(config.data), folder=SimpleNamespace())
    session._examine(config)
    names = [view.name for view in session.dataset.train]
    assert [name.rpartition("/")[2] for name in names] == ["r_0", "r_2", "r_3"]
    assert session.config.data.leave_out == ["r_1"]
    assert [view.name for view in session._fingerprint.train] == names
