"""Short fits within a given time, with a clock that is known."""

from types import SimpleNamespace

import pytest
from support.small_capture import make_dataset, write_dataset

import drgs
from drgs.config.load import config_from
from drgs.datasets import load_dataset
from drgs.examine import short_fits
from drgs.examine.short_fits import OutOfTimeError, fit_fold, shorten, split_views
from drgs.fit.budget import Budget
from drgs.fit.session import FitSession


class FinishedError(Exception):
    """All steps were taken."""


def fit_within(monkeypatch, seconds, seconds_of_step):
    """Fit a fold by a trainer whose steps take so long; return the number of steps that it took."""
    clock, steps = [0.0], []

    class Stub:
        iteration = property(lambda self: len(steps))

        def step(self):
            steps.append(clock[0])
            clock[0] += seconds_of_step

        def check(self):
            raise FinishedError

    monkeypatch.setattr(short_fits, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    monkeypatch.setattr(short_fits, "_make_trainer", lambda config, split: Stub())
    config = shorten(config_from({"data": {"path": "."}, "iterations": 3000}, "test"))
    folds, factor = split_views(make_dataset(40))
    with pytest.raises((OutOfTimeError, FinishedError)) as raised:
        fit_fold(config, folds, 0, factor, lambda done, count: None, seconds)
    return len(steps), raised.type is OutOfTimeError


def test_a_short_fit_ends_as_soon_as_there_is_no_time_for_it(monkeypatch):
    assert fit_within(monkeypatch, float("inf"), 0.1) == (400, False)
    # 30 iterations have taken 3 s; 370, which grow, take 59.
    assert fit_within(monkeypatch, 62.5, 0.1) == (400, False)
    assert fit_within(monkeypatch, 62.0, 0.1) == (30, True)
    assert fit_within(monkeypatch, 2.05, 0.1) == (21, True)


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
