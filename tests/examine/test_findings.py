"""Findings of effects, from differences that are made up."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.small_capture import make_dataset

from drgs.effects.base import Finding
from drgs.effects.cameras import CameraRefinement
from drgs.examine import short_fits
from drgs.examine.examination import Decision, Examination, _try
from drgs.examine.photographs import look_for_moving_things

NOISE = {"zoom": 0.1, "distortion": 0.3, "skew": 0.05}

MEASURED = Finding("mine", "seen", False, {"mine.rate": 1}, is_measured=True)
TRIED = Finding("mine", "seen", False, {"mine.rate": 1})


def fit_with(sh_direction="mean", **middles):
    """A short fit of 24 views whose differences vary around these middles."""
    rng, views, alignments = np.random.default_rng(0), make_dataset(24).train, []
    for k in range(len(views)):
        values = {
            name: middles.get(name, 0.0) + middles.get(f"{name}_noise", noise) * rng.normal()
            for name, noise in NOISE.items()
        }
        skew = np.array([values["skew"] * rng.choice([-1, 1]), 0.05 * rng.normal()])
        left = np.full((24, 32), 0.01, np.float32)
        if k < middles.get("moving", 0):
            left[5:12, 3:11] = 0.3
        shift = 0.05 * rng.normal(size=2)
        alignments.append(SimpleNamespace(**{**values, "skew": skew, "shift": shift, "left": left}))
    config = SimpleNamespace(model=SimpleNamespace(sh_direction=sh_direction))
    dataset = SimpleNamespace(test=tuple(views[:10]), train=tuple(views[10:]))
    return SimpleNamespace(
        config=config,
        dataset=dataset,
        alignments=alignments[:10],
        trained=alignments[10:],
        factor=3,
    )


def by_name(findings):
    return {finding.effect: finding for finding in findings}


@pytest.mark.parametrize(
    ("middles", "expected"),
    [
        ({}, set()),
        ({"zoom": 0.5}, {"focal length"}),
        ({"zoom": -0.5}, {"focal length"}),
        ({"distortion": 0.8}, {"distortion"}),
        ({"skew": 0.7}, {"rolling shutter"}),
        ({"skew": 0.7, "zoom_noise": 0.6}, set()),
    ],
)
def test_lenses_and_shutters_differ_in_the_middle_of_all_photographs(middles, expected):
    found = by_name(CameraRefinement.look_for(fit_with(**middles)))
    assert {name for name, each in found.items() if each.is_likely or each.advice} == expected
    assert found["focal length"].changes["cameras.focal_lr"] == 1e-3
    alone = by_name(CameraRefinement.look_for(fit_with(sh_direction="pixel", **middles)))
    assert alone.keys() == {"distortion", "rolling shutter"}


@pytest.mark.parametrize(("count", "is_said"), [(0, False), (5, False), (12, True)])
def test_things_that_move_are_said_if_many_photographs_have_them(count, is_said):
    found = look_for_moving_things(fit_with(moving=count))
    assert bool(found.advice) is is_said and not found.is_likely and not found.changes
    assert found.evidence.startswith(f"{count / 24:.0%} of photographs")


def test_what_is_measured_is_chosen_without_a_fit():
    decision, base = _try(replace(MEASURED, is_likely=True), None, (), None, 0.0)
    assert (decision.chosen, decision.gain, base) == (True, None, None)
    assert not _try(MEASURED, None, (), None, 0.0)[0].chosen
    found = Examination((decision,), 10, 1.0)
    assert found.reasons == {"mine.rate": "seen"} and found.changes == {"mine.rate": 1}
    assert "mine    seen                      mine.rate: 1" in str(found)


def test_folds_are_added_until_an_effect_is_decided(monkeypatch):
    views, added = make_dataset(20).train, []

    def fit(gain, num_folds=1):
        return SimpleNamespace(
            config=SimpleNamespace(data=SimpleNamespace(leave_out=[])),
            dataset=SimpleNamespace(test=views[: 5 * num_folds]),
            psnr=30.0 + gain + 0.001 * np.arange(5 * num_folds),
            wall_s=1.0,
            factor=1,
            num_folds=num_folds,
            gain=gain,
        )

    def add_fold(one, *args):
        added.append(one.gain)
        return fit(one.gain, one.num_folds + 1)

    for gain, more in ((-0.2, 0), (0.04, 0), (0.2, 1), (0.06, 1)):
        added.clear()
        monkeypatch.setattr(short_fits, "fit_fold", lambda *args, gain=gain: fit(gain))
        monkeypatch.setattr(short_fits, "add_fold", add_fold)
        monkeypatch.setattr("drgs.examine.examination.with_changes", lambda config, changes: config)
        decision, base = _try(replace(TRIED, is_likely=True), fit(0.0), (None,) * 2, None, np.inf)
        assert added == [0.0, gain] * more and base.num_folds == 1 + more
        assert decision.chosen is (gain > 0.05)


def test_bad_photographs_are_offered_although_no_gain_counts():
    changes = {"data.leave_out": ["a", "b"]}
    row = {"effect": "bad photographs", "evidence": "a is blurred", "changes": changes}
    tried = Decision(**row, gain=0.01, spread=0.02, cost=1.0, advice="--leave-out a --leave-out b")
    found = Examination((tried,), 10, 1.0)
    assert found.bad_photographs == ["a", "b"] and found.changes == {}
    assert "--leave-out a --leave-out b" in str(found)
    assert Examination((Decision(**row),), 10, 1.0).bad_photographs == []
