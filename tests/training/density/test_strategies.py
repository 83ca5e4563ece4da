"""The trainer with any strategy, and small fits by each: they resume to the same bytes."""

import sys
from dataclasses import dataclass, field
from importlib import import_module
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.trainers import make_trainer

from drgs.config import extensions
from drgs.config.schema import FitConfig
from drgs.training import trainer as trainer_module
from drgs.training.density.phases import PhasedStrategy, density_strategy
from drgs.training.density.strategy import DensityReport, DensityStrategy


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
    phases = PhasedStrategy((first, last))
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


MODULES = {"adc", "budget", "mcmc", "pruning"}


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
