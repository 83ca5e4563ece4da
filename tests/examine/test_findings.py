"""Findings of effects, from differences that are made up."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.small_capture import make_dataset

from drgs.effects.cameras import CameraRefinement
from drgs.effects.photometry import Photometry
from drgs.examine.examination import Decision, Examination, decide
from drgs.examine.photographs import look_for_moving_things

NOISE = {"vignetting": 0.01, "response": 0.02, "zoom": 0.1, "distortion": 0.3, "skew": 0.05}


def fit_with(num_cameras=1, sh_direction="mean", **middles):
    """A short fit of 24 views whose differences vary around these middles.

    A pair is of the first and of the second camera.
    """
    rng, views, alignments = np.random.default_rng(0), make_dataset(24).train, []
    views = [replace(view, fx=view.fx + k % num_cameras) for k, view in enumerate(views)]
    for k in range(len(views)):
        values = {}
        for name, noise in NOISE.items():
            middle = np.broadcast_to(middles.get(name, 0.0), 2)[k % num_cameras % 2]
            values[name] = middle + noise * rng.normal()
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


@pytest.mark.parametrize(("corners", "is_likely"), [(0.0, False), (-0.02, True), (0.02, False)])
def test_darker_corners_are_worth_a_fit_that_confirms_them(corners, is_likely):
    (found,) = Photometry.look_for(fit_with(vignetting=corners))
    assert found.effect == "vignetting" and found.is_likely is is_likely
    assert found.changes == {"colors.vignetting_lr": 0.03} and found.confirm is not None
    assert found.confirm(fit_with(vignetting=-0.03)) is None
    confirmed = found.confirm(fit_with(vignetting=-0.25))
    assert confirmed is not None and confirmed.evidence.startswith("corners are darker by 2")


def test_responses_are_compared_between_cameras():
    for tones, is_likely in (((0.0, 0.0), False), ((0.04, -0.04), True)):
        found = by_name(Photometry.look_for(fit_with(2, response=tones)))["response"]
        assert found.is_likely is is_likely, found.evidence
        assert (found.confirm(fit_with(2, response=tones)) is not None) is is_likely
    assert Photometry.look_for(fit_with(24)) == []  # a camera for each photograph


@pytest.mark.parametrize(
    ("middles", "expected"),
    [
        ({}, set()),
        ({"zoom": 0.5}, {"focal length"}),
        ({"zoom": -0.5}, {"focal length"}),
        ({"distortion": 0.8}, {"distortion"}),
        ({"skew": 0.7}, {"rolling shutter"}),
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


def test_what_is_confirmed_may_lose_a_little():
    (found,) = Photometry.look_for(fit_with(vignetting=-0.02))
    for loss, chosen in ((0.2, True), (0.8, False)):
        config = SimpleNamespace(data=SimpleNamespace(leave_out=[]))
        dataset = SimpleNamespace(test=make_dataset(10).train)
        without, fitted = (
            SimpleNamespace(
                config=config,
                dataset=dataset,
                psnr=np.zeros(10),
                toned_psnr=np.full(10, psnr),
                wall_s=1.0,
            )
            for psnr in (30.0, 30.0 - loss)
        )
        assert decide(found, without, fitted).chosen is chosen


def test_bad_photographs_are_offered_although_no_gain_counts():
    changes = {"data.leave_out": ["a", "b"]}
    row = {"effect": "bad photographs", "evidence": "a is blurred", "changes": changes}
    tried = Decision(**row, gain=0.01, spread=0.02, cost=1.0, advice="--leave-out a --leave-out b")
    found = Examination((tried,), 10, 1.0, smaller="300 of 500 iterations, 1 folds")
    assert found.bad_photographs == ["a", "b"] and found.changes == {}
    assert "--leave-out a --leave-out b" in str(found)
    assert "held-out views (within --budget: 300 of 500 iterations, 1 folds):" in str(found)
    assert Examination((Decision(**row),), 10, 1.0).bad_photographs == []
