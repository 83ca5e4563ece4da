"""The trainer with any strategy, and small fits by each: they resume to the same bytes."""

import sys
from dataclasses import dataclass, field, replace
from importlib import import_module
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits
from support.small_capture import blobs
from support.small_fits import everything_of, steps
from support.trainers import make_trainer

from drgs.config import extensions
from drgs.config.density import DensifyConfig
from drgs.config.schema import FitConfig
from drgs.gaussians.parameters import Gaussians
from drgs.training import trainer as trainer_module
from drgs.training.density.phases import Phases, density_strategy
from drgs.training.density.strategy import DensityReport, DensityStrategy
from drgs.training.rates import revised_stops
from drgs.training.trainer import Trainer


def trainer_with(monkeypatch, strategy, **changes):
    monkeypatch.setattr(trainer_module, "density_strategy", lambda *_: strategy)
    return make_trainer(**changes)


def strategy_with(**methods):
    """A strategy with these methods, which take the first argument alone."""
    own = {k: lambda self, first, *_, act=act: act(first) for k, act in methods.items()}
    return type("Own", (DensityStrategy,), own)()


def red(image, photograph):
    height, width, _ = image.shape
    assert photograph.shape == image.shape
    return dr.gather(mi.Float, image.array, 3 * dr.arange(mi.UInt32, height * width))


@dataclass
class Recorded(DensityStrategy):
    """Writes down what it is asked, and acts after each second iteration."""

    calls: list = field(default_factory=list)

    def begin(self, population):
        self.calls.append(("begin", population.num_rows))

    def needs_statistics(self, iteration):
        return iteration != 3

    def pixel_weights(self, iteration):
        return {"red": red}

    def update_statistics(self, step):
        assert dr.width(step.visible) == dr.width(step.weighted_sums["red"]) == 40
        self.calls.append(("gather", step.iteration))

    def perturb(self, population, iteration, means_lr):
        self.calls.append(("perturb", iteration, means_lr))

    def is_due(self, iteration):
        return iteration % 2 == 0

    def refine(self, population, iteration):
        self.calls.append(("act", iteration))


def test_iteration_updates_statistics_then_perturbs_then_refines(monkeypatch):
    strategy = Recorded()
    trainer = trainer_with(monkeypatch, strategy)
    rates = []
    for _ in range(3):
        report = trainer.step()
        rates.append(report.means_lr)
        assert report.density is None
    assert strategy.calls == [
        ("begin", 40),
        ("gather", 1),
        ("perturb", 1, rates[0]),
        ("gather", 2),
        ("perturb", 2, rates[1]),
        ("act", 2),
        ("perturb", 3, rates[2]),
    ]


def test_penalties_are_terms_of_the_loss(monkeypatch):
    """Adam's first step is as long as the rate, with the sign of the weighted gradient."""
    plain = make_trainer()
    trainer = trainer_with(
        monkeypatch,
        strategy_with(penalties=lambda params: [1e6 * dr.mean(params["logit_opacities"].array)]),
    )
    logits = trainer.gaussians().logit_opacities
    expected = plain.step().loss + 1e6 * logits.astype(np.float64).mean()
    assert trainer.step().loss == pytest.approx(expected, rel=1e-5)
    moved = trainer.gaussians().logit_opacities - logits
    np.testing.assert_allclose(moved, -trainer.config.optimizer.opacities_lr, rtol=1e-4)


def test_learning_rates_are_scaled_in_the_given_iterations(monkeypatch):
    quick = strategy_with(rate_factors=lambda i: dict.fromkeys(("means", "sh0"), 1 + (i == 1)))
    trainers = [make_trainer(), trainer_with(monkeypatch, quick)]
    before = trainers[0].gaussians()
    for fit in trainers:
        fit.step()
    plain, quick = (fit.gaussians() for fit in trainers)
    for name, factor in (("means", 2), ("sh0", 2), ("log_scales", 1)):
        start = getattr(before, name).astype(np.float64)
        moves = [np.abs(getattr(g, name) - start).max() for g in (plain, quick)]
        # Values of order 1 in single precision, steps of 1.6e-4 and more.
        assert moves[1] == pytest.approx(factor * moves[0], rel=2e-3), name
    rates = []
    for fit in trainers:
        fit.step()
        rates.append([entry[2] for entry in fit.optimizer.state.values()])
    assert rates[0] == rates[1]


@dataclass
class Phase(DensityStrategy):
    """Acts after some iterations; counts what it has seen since it began."""

    name: str
    when: set
    num: int = 10
    seen: int = 0

    def begin(self, population):
        self.seen = 0

    def needs_statistics(self, iteration):
        return iteration <= max(self.when)

    def update_statistics(self, step):
        self.seen += 1

    def rate_factors(self, iteration):
        return {"means": 2.0, self.name: 3.0}

    def penalties(self, parameters, num_rows):
        yield self.name

    def is_due(self, iteration):
        return iteration in self.when

    def refine(self, population, iteration):
        return DensityReport(self.num, num_added=self.num, cloned=2, pruned=1)

    def max_num_gaussians(self, start, iterations):
        return start + self.num


def test_phases_act_as_one_strategy_and_restart_after_row_changes():
    first, last = Phase("first", {2, 4}), Phase("last", {4, 6}, num=7)
    phases = Phases((first, last))
    assert [i for i in range(1, 9) if phases.is_due(i)] == [2, 4, 6]
    assert [i for i in range(1, 9) if phases.needs_statistics(i)] == [1, 2, 3, 4, 5, 6]
    assert phases.rate_factors(1) == {"means": 4.0, "first": 3.0, "last": 3.0}
    assert list(phases.penalties({}, 5)) == ["first", "last"]
    assert phases.max_num_gaussians(100, 8) == 117
    for iteration in range(1, 6):
        phases.update_statistics(SimpleNamespace(iteration=iteration))
    assert (first.seen, last.seen) == (4, 5)
    assert phases.refine(None, 2) == DensityReport(10, num_added=10, cloned=2, pruned=1)
    assert (first.seen, last.seen) == (4, 0)
    assert phases.refine(None, 4) == DensityReport(7, num_added=17, cloned=4, pruned=2)
    assert phases.refine(None, 5) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "densify",
    [
        {"strategy": "adc", "adc": {"grad_threshold": 1e-6, "reset_every": 12}},
        {"strategy": "budget", "budget": {"gaussians": 90, "error_every": 1}},
    ],
    ids=lambda densify: densify["strategy"],
)
def test_revised_plan_equals_the_same_plan_from_the_start(densify):
    """Growth ends later, then earlier; with the statistics of the views in between."""
    densify = {"start": 2, "stop": 20, "every": 4, **densify}
    revised = make_trainer(densify=densify, iterations=40)
    for iteration in range(1, 18):
        revised.step()
        if iteration in (6, 11):
            revised.reschedule(45, {6: 36, 11: 16}[iteration])
    assert revised.num_gaussians > 40
    again = make_trainer(**revised.config.model_dump())
    assert everything_of(steps(again, 17)) == everything_of(revised)


def test_earlier_stops_of_a_plan_are_kept_for_past_iterations():
    config = FitConfig(data={"path": "."}, densify={"start": 2, "stop": 20})
    assert revised_stops(config, 0, 30) == []
    assert revised_stops(config, 6, 20) == []
    aims = revised_stops(config, 6, 36)
    densify = {"start": 2, "stop": 36, "stop_aims": aims}
    config = FitConfig(data={"path": "."}, densify=densify)
    assert [config.densify.stop_at_iteration(i) for i in (1, 6, 7, 30)] == [20, 20, 36, 36]
    assert revised_stops(config, 6, 36) == revised_stops(config, 9, 36) == aims
    assert revised_stops(config, 6, 9) == [{"after": 0, "stop": 20}, {"after": 6, "stop": 9}]
    with pytest.raises(ValueError, match="must begin after iteration 0, with growing after"):
        DensifyConfig(stop_aims=[{"after": 3, "stop": 9}])


MODULES = {"adc", "budget", "mcmc", "pruning"}

MCMC = {
    "densify__strategy": "mcmc",
    "densify__mcmc__gaussians": 60,
    "densify__mcmc__growth": 0.1,
    "init__num_points": 48,
}

BUDGET = {"densify__strategy": "budget", "densify__budget__gaussians": 60}
SELECTION = {"densify__prune__to": 20}

STRATEGIES = {
    "mcmc": MCMC,
    "selection": SELECTION,
    "budget and selection": BUDGET | SELECTION,
    "mcmc and selection": MCMC | SELECTION,
}


def many_blobs(count=48) -> Gaussians:
    """Return the start of a fit whose population changes: half of the blobs are transparent."""
    logits = np.where(np.arange(count) % 2, -6.0, 0.0).astype(np.float32)
    return replace(blobs(count, seed=5), logit_opacities=logits)


def trainer_of(name, **changes):
    schedule = {
        "densify__start": 2,
        "densify__stop": 14,
        "densify__every": 4,
        "densify__prune__every": 3,
        "densify__prune__stop": 24,
        "iterations": 30,
    }
    values = schedule | STRATEGIES[name] | changes
    return fits.make_trainer(fits.plain_dataset(), many_blobs(), **values)


@pytest.mark.slow
@pytest.mark.parametrize("pause", [5, 16])
@pytest.mark.parametrize("name", STRATEGIES)
def test_fit_resumes_to_the_same_bytes_from_any_iteration(name, pause):
    whole = trainer_of(name)
    sizes = []
    for iteration in range(1, 28):
        sizes.append(whole.step().num_gaussians)
        if iteration == pause:
            state = whole.state()
    resumed = trainer_of(name)
    resumed.restore(state)
    steps(resumed, 27 - pause)
    expected, got = everything_of(whole), everything_of(resumed)
    assert got.keys() == expected.keys()
    assert [key for key in expected if got[key] != expected[key]] == []
    assert len(set(sizes)) > 2
    if "mcmc" in name or "budget" in name:
        assert max(sizes) <= 60
    if name != "mcmc":
        assert sizes[23:] == [20] * 4


@pytest.mark.slow
def test_revised_plan_keeps_a_phase_that_has_begun():
    trainer = steps(trainer_of("selection", densify__prune__stop=None), 17)
    assert trainer.config.densify.prune_window(30) == (14, 22)
    trainer.reschedule(60, 14)
    assert trainer.config.densify.prune_window(60) == (14, 22)
    assert steps(trainer, 5).num_gaussians == 20
    early = steps(trainer_of("selection", densify__prune__stop=24), 5)
    early.reschedule(60, 30)
    assert early.config.densify.prune_window(60) == (30, 48)


@pytest.mark.slow
def test_revised_plan_with_a_future_phase_equals_a_plan_from_the_start():
    """The phase would have begun before the revision, had it been planned so."""
    window = {"densify__prune__start": 20, "densify__prune__stop": 26}
    revised = trainer_of("selection", **window)
    for iteration in range(1, 25):
        revised.step()
        if iteration == 18:
            revised.reschedule(24, 14)
    assert revised.config.densify.prune_window(24)[0] == 18
    again = steps(replanned(revised), 24)
    assert everything_of(again) == everything_of(revised)


@pytest.mark.slow
def test_phase_without_time_is_skipped():
    trainer = steps(trainer_of("selection", densify__prune__start=20), 16)
    trainer.reschedule(16, 14)
    again = steps(replanned(trainer), 16)
    assert again.num_gaussians == trainer.num_gaussians > 20


def replanned(trainer):
    """A trainer that knows the plan from the start."""
    return Trainer(trainer.config, fits.plain_dataset(), many_blobs())


def test_unused_strategies_are_not_imported(monkeypatch):
    names = {f"drgs.training.density.{module}" for module in MODULES}
    for name in names:  # registered once, whatever ran before: the patches end with these
        import_module(name)
    for strategy in ("adc", "budget", "mcmc"):
        for name in names & set(sys.modules):
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setattr(extensions.STRATEGIES, "_extensions", {})  # private: not registered yet
        densify = {"strategy": strategy, "remove_floaters": False}
        density_strategy(FitConfig(data={"path": "."}, densify=densify))
        imported = {name.rpartition(".")[2] for name in names & set(sys.modules)}
        assert imported == {strategy}
