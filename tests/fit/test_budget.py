"""Fits for a given time: what is planned, when they end, and that their plans can be repeated."""

import time
from argparse import ArgumentTypeError
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.fit_command import assert_fits, run_fit, write_scene
from support.trainers import make_trainer

from drgs.config.changes import with_changes
from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.fit import __main__ as fit
from drgs.fit import budget as plan
from drgs.fit.budget import Curve, Strategy, deadline, load_curves, make_plan, parse_duration
from drgs.fit.loop import History, iterations


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90", 90), ("90s", 90), ("5m", 300), ("1h30m", 5400), ("0.5h", 1800), ("1m30s", 90)],
)
def test_durations_are_parsed(text, seconds):
    assert parse_duration(text) == seconds


@pytest.mark.parametrize(
    "text",
    ["", "0", "m", "5 minutes", "-3s", "nan", "1m2h", "0s", "1h30", "5m5", "\u0665m", "9" * 400],
)
def test_invalid_durations_are_refused(text):
    with pytest.raises(ArgumentTypeError, match="must be a time such as 90s, 5m or 1h30m"):
        parse_duration(text)


# Time grows as n^1.5, PSNR by 2 dB with every doubling.
POWER = Curve((100, 200, 400), (1000.0, 1000 * 2**1.5, 8000.0), (20.0, 22.0, 24.0))


@pytest.mark.parametrize("n", [50, 100, 150, 200, 333, 400, 3200])
def test_power_law_is_interpolated_and_extrapolated(n):
    assert POWER.iterations_in(1000 * (n / 100) ** 1.5) == n
    assert POWER.psnr_at(n) == pytest.approx(20 + 2 * np.log2(n / 100))


SLOW = Curve((1000, 2000), (1000.0, 2000.0), (30.0, 31.0))
FAST = Curve((1000, 2000), (500.0, 1000.0), (29.5, 30.5))
CONFIG = FitConfig(
    data={"path": "."},
    init={"num_points": 50},
    iterations=7000,
    optimizer={"scales_lr": 0.02},
    coarse=[],
)


def curves_of(slow=SLOW, fast=FAST):
    return {plan.STRATEGIES[0].name: slow, plan.STRATEGIES[1].name: fast}


def planned(seconds, side=400, start_s=0.1, **curves):
    return make_plan(CONFIG, 50, side, seconds, start_s, curves_of(**curves))


def test_measured_curves_pass_through_their_points():
    curves = load_curves()
    assert set(curves) == {strategy.name for strategy in plan.STRATEGIES}
    for curve in curves.values():
        assert (np.diff(curve.time) > 0).all()
        for n, seconds, psnr in zip(curve.iterations, curve.time, curve.psnr, strict=True):
            assert curve.iterations_in(seconds) == n
            assert curve.psnr_at(n) == pytest.approx(psnr)


def test_best_strategy_within_the_time_is_chosen():
    """A thousand iterations as they are, or two thousand cheaper ones: 30 or 30.5 dB."""
    result = planned(100)
    assert [(c.iterations, c.psnr) for c in result.candidates] == [(1000, 30.0), (2000, 30.5)]
    assert result.chosen.strategy is plan.STRATEGIES[1]
    assert result.config.iterations == 2000 and result.config.densify.stop == 1500
    assert [(s.until, s.factor) for s in result.config.coarse] == [(500, 2)]
    assert "1,000 iterations, 30.00 dB there: as shipped" in result.reasons
    assert "half size for the first quarter (chosen)" in result.reasons
    worse = planned(100, fast=replace(FAST, psnr=(28.5, 29.5)))
    assert worse.chosen.strategy is plan.STRATEGIES[0] and worse.config.coarse == []
    assert planned(100, start_s=0.05).config.iterations == 4000  # of a faster machine
    assert planned(100, side=50).chosen.strategy is plan.STRATEGIES[0]  # images stay as small
    for seconds in (2, -3):
        message = f"--budget: must leave time for 50 iterations, got {max(seconds, 0)} s"
        with pytest.raises(UserError, match=message):
            planned(seconds)


@pytest.mark.parametrize(
    ("start", "changes", "section", "expected"),
    [
        (50, {}, "budget", 200),
        (300, {}, "budget", 300),
        (50, {"densify.max_gaussians": 160}, "budget", 80),
        (50, {"densify.strategy": "mcmc", "densify.mcmc.gaussians": 600}, "mcmc", 300),
        # A hull may have fewer points than were asked for.
        (310, {"densify.strategy": "mcmc", "densify.mcmc.gaussians": 600}, "mcmc", 320),
    ],
)
def test_fraction_of_gaussians_is_at_least_the_start(start, changes, section, expected):
    values = {"densify.budget.gaussians": 400, "init.num_points": 320 if start == 310 else 50}
    half = Strategy("x", share=0.5).apply(with_changes(CONFIG, values | changes), start)
    assert getattr(half.densify, section).gaussians == expected


def test_fraction_is_planned_only_with_a_target_number():
    """The population of adc comes out of a threshold."""
    half = next(strategy for strategy in plan.STRATEGIES if strategy.share == 0.5)
    curves = {plan.STRATEGIES[0].name: SLOW, half.name: replace(FAST, psnr=(31.0, 32.0))}
    growing = with_changes(CONFIG, {"densify.budget.gaussians": 400})
    adc = with_changes(CONFIG, {"densify.strategy": "adc"})
    for config, start, strategies, number in (
        (growing, 50, [plan.STRATEGIES[0], half], "200"),
        (growing, 900, [plan.STRATEGIES[0], half], "900"),
        (adc, 50, [plan.STRATEGIES[0]], "1,000,000"),
    ):
        result = make_plan(config, start, 400, 100, 0.1, curves)
        assert [candidate.strategy for candidate in result.candidates] == strategies
        assert f"at most {number} Gaussians" in result.reasons


def test_configuration_that_cannot_shrink_gets_a_plan():
    """Stages of its own, which stay, few iterations of changes, the end of an earlier plan."""
    values = {"coarse": [{"until": 10, "factor": 4}, {"until": 20, "factor": 2}]}
    values |= {"densify.start": 500, "densify.stop": 501}
    config = with_changes(CONFIG, values | {"stop_after": 7})
    result = make_plan(config, 50, 400, 25, 0.1, curves_of())
    assert result.chosen.strategy is plan.STRATEGIES[0]
    assert result.config.iterations == result.config.last_iteration == 250
    assert (result.config.densify.start, result.config.densify.stop) == (18, 19)
    assert [(s.until, s.factor) for s in result.config.coarse] == [(1, 4)]


@pytest.mark.parametrize("last", [4, 6, 9])
def test_clock_ends_a_fit_and_its_configuration_gives_the_same_bytes(monkeypatch, last):
    """A fit that was planned for 6 iterations; the others run at the final rates."""
    clock = SimpleNamespace(now=100.0)
    clock.perf_counter = lambda: clock.now
    monkeypatch.setattr(plan, "time", clock)
    trainer = make_trainer(iterations=6)
    for done in iterations(trainer, History(), deadline(100.0 + last, trainer.comm)):
        clock.now += 1.0
        assert done.is_last == (trainer.iteration == last + 1)
    assert trainer.config.iterations == 6 and trainer.config.last_iteration == last + 1
    again = make_trainer(**trainer.config.model_dump())
    assert len(list(iterations(again, History()))) == last + 1
    expected, state = trainer.state(), again.state()
    assert all(np.array_equal(state[name], values) for name, values in expected.items())


@pytest.mark.parametrize("is_time_left", [True, False])
def test_other_ranks_follow_the_clock_of_rank_0(is_time_left):
    continues = deadline(0.0, SimpleNamespace(broadcast_numbers=lambda own: is_time_left))
    assert continues(SimpleNamespace(iteration=3)) == is_time_left


@pytest.mark.slow
def test_fit_ends_in_its_budget_and_its_plan_gives_the_same_bytes(tmp_path, monkeypatch):
    """Without a clock."""
    sections = {"init": {"num_points": 300, "half_extent": 1.0}}
    sections |= {"densify": {"every": 50, "max_gaussians": 600}}
    scene = write_scene(tmp_path, test=2, train=6, **sections)
    again = tmp_path / "again"
    monkeypatch.setattr(fit, "LOADING_SECONDS", 0.0)  # modules are loaded
    for attempt in ("first", "second"):  # other tests on the machine may end during a fit
        out, start = tmp_path / attempt, time.perf_counter()
        assert_fits(scene, "--out", out, "--budget", "30")
        seconds = time.perf_counter() - start
        if seconds == pytest.approx(30, rel=0.1):
            break
    assert seconds == pytest.approx(30, rel=0.1)
    text, config = (out / "plan.txt").read_text(), load_config(out / "config.yml")
    assert text.startswith("--budget 30s\n") and "(chosen)" in text
    assert f"Planned: {config.iterations:,} iterations" in text
    assert_fits(out / "config.yml", "--out", again)
    name = "point_cloud.ply"
    assert (out / name).read_bytes() == (again / name).read_bytes()
    assert load_config(again / "config.yml") == with_changes(config, {"output.dir": again})
    for folder, seconds, message in (
        (out, "30", "must be new or empty for a fit with --budget"),
        (tmp_path / "short", "1s", "--budget: must leave time"),
    ):
        outcome = run_fit(scene, "--out", folder, "--budget", seconds)
        assert outcome.returncode == 2 and message in outcome.stderr
    assert not (tmp_path / "short").exists()
