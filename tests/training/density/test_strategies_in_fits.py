"""Small fits by each strategy and last phase: they learn, resume to the same bytes, keep caps."""

import sys
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from support import small_fits as fits
from support.small_capture import blobs

from drgs.config import extensions
from drgs.config.schema import FitConfig
from drgs.gaussians.parameters import Gaussians
from drgs.training.density.strategy import density_strategy
from drgs.training.trainer import Trainer

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
    "importance": {**SELECTION, "densify__prune__method": "importance"},
    "budget and selection": BUDGET | SELECTION,
    "mcmc and selection": MCMC | SELECTION,
}


def many_blobs(count=48) -> Gaussians:
    """Return the start of a fit whose population changes: half of the blobs are transparent."""
    logits = np.where(np.arange(count) % 2, -6.0, 0.0).astype(np.float32)
    return replace(blobs(count, seed=5), logit_opacities=logits)


def make_trainer(name, **changes):
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
    whole = make_trainer(name)
    sizes = []
    for iteration in range(1, 28):
        sizes.append(whole.step().num_gaussians)
        if iteration == pause:
            state = whole.state()
    resumed = make_trainer(name)
    resumed.restore(state)
    fits.steps(resumed, 27 - pause)
    expected, got = fits.everything_of(whole), fits.everything_of(resumed)
    assert got.keys() == expected.keys()
    assert [key for key in expected if got[key] != expected[key]] == []
    assert len(set(sizes)) > 2
    if "mcmc" in name or "budget" in name:
        assert max(sizes) <= 60
    if name != "mcmc":
        assert sizes[23:] == [20] * 4


@pytest.mark.slow
def test_revised_plan_keeps_a_phase_that_has_begun():
    trainer = fits.steps(make_trainer("selection", densify__prune__stop=None), 17)
    assert trainer.config.densify.prune_window(30) == (14, 22)
    trainer.reschedule(60, 14)
    assert trainer.config.densify.prune_window(60) == (14, 22)
    assert fits.steps(trainer, 5).num_gaussians == 20
    early = fits.steps(make_trainer("selection", densify__prune__stop=24), 5)
    early.reschedule(60, 30)
    assert early.config.densify.prune_window(60) == (30, 48)


@pytest.mark.slow
def test_revised_plan_with_a_future_phase_equals_a_plan_from_the_start():
    """The phase would have begun before the revision, had it been planned so."""
    window = {"densify__prune__start": 20, "densify__prune__stop": 26}
    revised = make_trainer("selection", **window)
    for iteration in range(1, 25):
        revised.step()
        if iteration == 18:
            revised.reschedule(24, 14)
    assert revised.config.densify.prune_window(24)[0] == 18
    again = fits.steps(replanned(revised), 24)
    assert fits.everything_of(again) == fits.everything_of(revised)


@pytest.mark.slow
def test_phase_without_time_is_skipped():
    trainer = fits.steps(make_trainer("selection", densify__prune__start=20), 16)
    trainer.reschedule(16, 14)
    again = fits.steps(replanned(trainer), 16)
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
        density_strategy(FitConfig(data={"path": "."}, densify={"strategy": strategy}))
        imported = {name.rpartition(".")[2] for name in names & set(sys.modules)}
        assert imported == {strategy}
