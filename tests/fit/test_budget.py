"""Fits for a given time: what is planned, when they end, and that their plans can be repeated."""

import time
from argparse import ArgumentTypeError
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from support.fit_command import assert_fits, run_fit, write_scene

from drgs.config.changes import with_changes
from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.fit import __main__ as fit
from drgs.fit import budget as plan
from drgs.fit import checkpoint
from drgs.fit.budget import Curve, Deadline, Strategy, load_curves, make_plan, parse_duration
from drgs.fit.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from drgs.fit.fingerprint import Fingerprint
from drgs.fit.loop import History
from drgs.results.folder import load_run_config
from drgs.training.rates import rates_over_time
from drgs.training.trainer import Trainer


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
    """Stages of its own, which stay, few iterations of changes, revisions of an earlier plan."""
    values = {"coarse": [{"until": 10, "factor": 4}, {"until": 20, "factor": 2}]}
    values |= {"densify.start": 500, "densify.stop": 501}
    values |= {"optimizer.means_lr_aims": [{"after": 0, "end": 5}, {"after": 1, "end": 7}]}
    config = with_changes(CONFIG, values)
    result = make_plan(config, 50, 400, 25, 0.1, curves_of())
    assert result.chosen.strategy is plan.STRATEGIES[0]
    assert result.config.iterations == 250 and result.config.optimizer.means_lr_aims == []
    assert (result.config.densify.start, result.config.densify.stop) == (18, 19)
    assert [(s.until, s.factor) for s in result.config.coarse] == [(1, 4)]


@pytest.fixture
def clock(monkeypatch):
    """Instead of time.perf_counter: seconds that a test decides."""
    clock = SimpleNamespace(now=100.0)
    clock.perf_counter = lambda: clock.now
    monkeypatch.setattr(plan, "time", clock)
    return clock


class FakeTrainer:
    """A trainer's count of iterations; an iteration takes ``second``."""

    reschedule, extent, iteration = Trainer.reschedule, 1.0, 0

    def __init__(self, clock, second, **changes):
        self.clock, self.second = clock, second
        values = {"iterations": 1000, "densify.start": 100, "densify.stop": 600}
        self.config = with_changes(CONFIG, {**values, **changes})
        self.rates = rates_over_time(self.config, self.extent)
        self.density = self._density_from = Mock()

    def step(self):
        self.iteration += 1
        self.clock.now += self.second

    def fit(self, seconds):
        """Iterations until the deadline."""
        deadline = Deadline(self, self.clock.now + seconds, LINEAR)
        while deadline.should_continue(self):
            yield deadline
            self.step()


# Time is proportional to iterations.
LINEAR = Curve((100, 200), (100.0, 200.0), (20.0, 21.0))


@pytest.mark.parametrize("second", [0.05, 0.1, 0.2])
def test_fit_ends_in_time_for_any_iteration_cost(clock, second):
    """Planned were 0.1 s. The population changes during six tenths of the iterations.

    An iteration or two more or less: the clock is read between them.
    """
    trainer = FakeTrainer(clock, second)
    for deadline in trainer.fit(100):
        if trainer.iteration in (0, 10):
            expected = 100 / second if trainer.iteration else 1000
            assert deadline.num_iterations(trainer) == expected
    assert 200 <= clock.now < 200 + 2 * second
    n = trainer.iteration
    assert trainer.config.iterations == n == pytest.approx(100 / second, abs=2)
    assert trainer.config.densify.stop == pytest.approx(0.6 * n, abs=2)
    # Two iterations of 500 in five e-folds.
    assert trainer.rates.means(n) == pytest.approx(trainer.rates.means.final, rel=0.02)


def test_density_changes_never_end_before_they_start(clock):
    trainer = FakeTrainer(clock, 1.0, **{"densify.start": 590})
    list(trainer.fit(100))
    assert trainer.config.densify.stop == 591


def test_plan_of_a_slowing_fit_is_revised(clock):
    trainer, rates = FakeTrainer(clock, 0.05), []
    for _ in trainer.fit(100):
        trainer.second = 0.05 if trainer.iteration < 600 else 0.2
        rates.append(trainer.rates.means(trainer.iteration + 1))
    assert trainer.iteration == pytest.approx(600 + 70 / 0.2, abs=2)
    # All rates, also those of iterations before a revision, are what the last configuration says.
    assert rates == [trainer.rates.means(i + 1) for i in range(trainer.iteration)]
    assert len(trainer.config.optimizer.means_lr_aims) == 10
    # Without revisions after the fit became slower, it would have fallen half the way: 1.7e-5.
    assert trainer.rates.means.final < rates[-1] < 2 * trainer.rates.means.final


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
    assert f"Planned: {config.optimizer.means_lr_aims[0].end:,} iterations" in text
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


def test_plan_revised_after_the_last_checkpoint_can_be_continued(tmp_path, monkeypatch):
    """Whatever ends the process while the next one is written: one of both plans goes on."""
    config = FitConfig(data={"path": tmp_path}, iterations=40_000)
    data = Fingerprint(train=[], test=[])
    state = Checkpoint({"iteration": np.array(7)}, *History().arrays(), 1.0, data)
    save_checkpoint(tmp_path, config, state)
    revised = with_changes(config, {"iterations": config.iterations + 10})
    for module, name, saved in (
        (checkpoint.np, "savez", config),
        (checkpoint, "write_run_config", revised),
    ):
        with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
            patched.setattr(module, name, Mock(side_effect=KeyboardInterrupt))
            save_checkpoint(tmp_path, revised, state)
        assert load_run_config(tmp_path) == config
        assert load_checkpoint(tmp_path, config).config == saved
    save_checkpoint(tmp_path, revised, state)
    assert load_run_config(tmp_path) == revised
    moved = with_changes(revised, {"data.path": tmp_path / "moved", "output.history_every": 3})
    for same in (revised, moved):
        assert load_checkpoint(tmp_path, same).config == same
