"""Effects chosen by evidence: what is found where it is known, and what a user sees of it."""

import json
import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.commands import assert_ends_well, assert_refused
from support.fit_command import assert_fit_refused, assert_fits, without_images
from support.small_capture import blobs, make_dataset, photograph, pose_around, view, write_dataset

import drgs
from drgs.config.extensions import EFFECTS
from drgs.config.load import config_from
from drgs.core.registry import temporary_registrations
from drgs.effects.base import Finding, TrainingEffect
from drgs.examine import __main__ as command
from drgs.examine.examination import Examination, decide, given_keys, middle_of, overlaps
from drgs.examine.short_fits import split_views

ITERATIONS = 1500  # of a fit: the fewest that are examined
NAMES = ["background of one colour", "bad photographs", "exposure and white balance"]
NAMES += ["vignetting", "camera refinement", "focal length", "distortion", "rolling shutter"]
NAMES += ["things that move"]
assert_examines = partial(assert_ends_well, command.main)


@pytest.fixture(scope="module")
def dataset():
    """Photographs of blobs on grey, of which no effect is the cause."""
    grey = (0.5, 0.5, 0.5)
    given, scene = make_dataset(train=40, test=2), blobs()

    def seen(view):
        return replace(view, image=photograph(scene, view, grey).image.astype(np.float32))

    train, test = (tuple(map(seen, views)) for views in (given.train, given.test))
    return replace(given, train=train, test=test, background=grey)


def config_of(**sections):
    init = {"num_points": 60, "half_extent": 0.6}
    return {"iterations": ITERATIONS, "init": init, **sections}


def spoil(dataset, change):
    rng = np.random.default_rng(1)
    return replace(dataset, train=tuple(change(view, rng) for view in dataset.train))


def darken(view, rng):
    image = view.image * np.exp(rng.normal(0, 0.3) - 0.4)
    return replace(view, image=image.astype(np.float32))


def turn(view, rng):
    pose = view.camera_to_world.copy()
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(rng.normal(0, 0.04, 3)).as_matrix()
    return replace(view, camera_to_world=pose)


CASES = {
    "nothing": (lambda view, rng: view, {}),
    "exposure": (darken, {"colors.lr": 0.02}),
    "poses": (turn, {"cameras.optimise": True}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_what_photographs_call_for_is_chosen_and_nothing_else(dataset, case):
    change, chosen = CASES[case]
    found = drgs.examine(spoil(dataset, change), config_of())
    assert found.changes == chosen, str(found)
    assert [each.effect for each in found.decisions] == NAMES
    assert found.num_held_out in (10, 20)
    again = drgs.examine(spoil(dataset, change), config_of())
    for one, other in zip(found.decisions, again.decisions, strict=True):
        assert replace(one, cost=None) == replace(other, cost=None)


def near_and_far():
    """39 near photographs and 3 far ones, each with the exposure that its mean calls for."""
    scene, rng, views = blobs(), np.random.default_rng(2), []
    for k in range(42):
        turn, height = 2.4 * k, rng.uniform(0.1, 1.0)
        pose = pose_around(turn, height, 11.0 if k % 14 == 6 else rng.uniform(2.2, 4.0))
        image = photograph(scene, view(f"{k:02d}", pose, None), (0.25, 0.25, 0.25)).image
        image = np.clip(image * (0.4 / image.mean()), 0, 1)
        views.append(view(f"{k:02d}", pose, image.astype(np.float32)))
    return replace(make_dataset(), train=tuple(views), background=(0.25, 0.25, 0.25))


@pytest.mark.slow
def test_automatic_exposure_is_found_although_some_photographs_are_far():
    found = drgs.examine(near_and_far(), config_of())
    assert found.changes.get("colors.lr") == 0.02, str(found)


@pytest.mark.slow
def test_a_background_of_one_colour_is_found(dataset):
    black = replace(dataset, background=(0.0, 0.0, 0.0))
    found = drgs.examine(black, config_of())
    assert found.changes.keys() == {"data.background"}
    np.testing.assert_allclose(found.changes["data.background"], 0.5, atol=0.01)
    assert re.search(
        r"background of one colour +\d+% of each border has one colour, mostly 0\.50", str(found)
    )


@pytest.mark.slow
def test_given_values_are_not_examined_and_effects_from_outside_are(dataset):
    with temporary_registrations():

        @EFFECTS.register("mine")
        class Mine(TrainingEffect):
            """Changes nothing."""

            @classmethod
            def look_for(cls, fit):
                assert len(fit.images) == len(fit.dataset.test) == len(fit.alignments)
                return Finding("mine", "to be tried", True, {"mine": None})

        given = {"colors": {"lr": 0.02}, "cameras": {"optimise": False}}
        found = drgs.examine(dataset, config_of(**given))
        background, mine = (
            next(e for e in found.decisions if e.effect == name) for name in (NAMES[0], "mine")
        )
        assert (background.effect, background.gain) == (NAMES[0], None)
        assert (mine.effect, mine.gain, mine.chosen) == ("mine", 0.0, False)
        found = drgs.examine(dataset, config_of(**given, mine=None))
        assert [each.effect for each in found.decisions] == [*NAMES[:2], *NAMES[3:4], *NAMES[6:]]


@pytest.mark.parametrize(
    ("train", "iterations", "note"),
    [
        (1, 4000, "1 training photographs are fewer than 20"),
        (2, 4000, "2 training photographs are fewer than 20"),
        (40, 1400, "1400 iterations are fewer than 1500"),
    ],
)
def test_too_little_is_not_examined(train, iterations, note):
    found = drgs.examine(make_dataset(train), {"iterations": iterations})
    assert (found.decisions, found.changes, found.note) == ((), {}, note)
    assert str(found) == f"not examined: {note}"


@pytest.mark.parametrize(
    ("values", "key", "is_given"),
    [
        ({"colors": {"lr": None}}, "colors.lr", True),
        ({"cameras": {"optimise": False}}, "cameras.optimise", True),
        ({"data": {"background": None}}, "data.background", False),
        ({"data": {"background": "white"}}, "data.background", True),
        ({}, "colors.lr", False),
        ({"coarse": []}, "coarse", True),
        ({"densify": {"mcmc": {"gaussians": 500}}}, "densify.mcmc.gaussians", True),
    ],
)
def test_keys_that_are_given(values, key, is_given):
    data = {"path": ".", **values.get("data", {})}
    assert (key in given_keys(config_from({**values, "data": data}, "x"))) is is_given


def test_keys_overlap_with_their_sections():
    assert overlaps("mine", "mine.rate")
    assert overlaps("mine.rate", "mine") and overlaps("a.b", "a.b")
    assert not overlaps("colors.lr", "colors.lr_decay")


def test_large_photographs_are_scaled_and_masked_ones_not_held_out():
    given = make_dataset(40)
    large = [
        replace(view, width=640, height=480, image=np.zeros((480, 640, 3), np.float32))
        for view in given.train
    ]
    large[2] = replace(large[2], mask=np.zeros((480, 640), np.float32))
    (split, *_), factor = split_views(replace(given, train=tuple(large)))
    assert (factor, split.train[0].width, len(split.test), len(split.train)) == (5, 128, 9, 30)
    assert all(view.mask is None for view in split.test)


@pytest.mark.parametrize(
    ("count", "held_out"), [(20, [5] * 4), (27, [7, 6, 7]), (42, [10, 10]), (100, [12, 12])]
)
def test_each_photograph_is_fitted_or_held_out(count, held_out):
    given = make_dataset(count, 3)
    folds, factor = split_views(given)
    assert factor == 1 and [len(fold.test) for fold in folds] == held_out
    names = [view.name for fold in folds for view in fold.test]
    assert len(names) == len({*names})
    for fold in folds:
        together = [view.name for view in (*fold.train, *fold.test)]
        assert {*together} == {view.name for view in given.train} and len(together) == count


def fits_with_gains(gains, cameras=None):
    """Two short fits, as far as decisions are concerned; cameras: a number for each view."""
    views = make_dataset(len(gains)).train
    cameras = cameras or [0] * len(views)
    views = tuple(replace(v, fx=v.fx + number) for v, number in zip(views, cameras, strict=True))
    before = np.linspace(20, 30, len(gains))
    dataset = SimpleNamespace(test=views)
    config = SimpleNamespace(data=SimpleNamespace(leave_out=[]))
    without = SimpleNamespace(dataset=dataset, psnr=before, wall_s=2.0)
    psnr = before + gains
    return without, SimpleNamespace(config=config, dataset=dataset, psnr=psnr, wall_s=3.0)


FINDING = Finding("x", "seen", True, {"colors.lr": 0.02})
OUTLIER = [0.08, 0.12, 0.1, 0.15, 0.11, 0.09, 0.13, 0.1, 0.07, 1.4]


@pytest.mark.parametrize(
    ("gains", "chosen"),
    [
        ([0.3, 0.4, 0.35, 0.3, 0.4, 0.2, 0.25], True),
        ([0.3, 0.4, 0.35, 0.3, 0.4, 0.2], False),  # six have the confidence 1 - 1/64
        (OUTLIER, True),
        ([*OUTLIER[:-1], -1.4], True),
        ([0.3, -0.2, 0.1, 0.3, -0.4, 0.2, -0.1, 0.1], False),
        ([0.04] * 10, False),
        ([0.0] * 10, False),
    ],
)
def test_a_gain_counts_if_photographs_agree(gains, chosen):
    decision = decide(FINDING, *fits_with_gains(np.array(gains)))
    assert decision.chosen is chosen and decision.cost == 1.5
    # Pair by pair, each photograph with itself as well.
    means = [(a + b) / 2 for i, a in enumerate(gains) for b in gains[i:]]
    assert decision.gain == pytest.approx(np.median(means))
    examination = Examination((decision,), 3, 9.0)
    assert examination.changes == ({"colors.lr": 0.02} if chosen else {})
    assert json.loads(examination.to_json())["changes"] == examination.changes


def test_one_far_photograph_spreads_a_mean_and_not_the_ranks():
    gains = np.array(OUTLIER)
    assert gains.mean() < 2.26 * gains.std(ddof=1) / np.sqrt(10)  # Student's t, 9 degrees
    gain, spread = middle_of(gains)
    assert 0.08 < gain < 0.13 and spread < 0.03


def test_the_spread_of_normal_gains_is_their_standard_error():
    gains = np.random.default_rng(0).normal(0.2, 0.1, (300, 20))
    middles, spreads = np.array([middle_of(row) for row in gains]).T
    assert np.mean(spreads) == pytest.approx(np.std(middles), rel=0.1)


def test_noise_counts_as_rarely_as_the_confidence_says():
    gains = np.random.default_rng(0).normal(0.0, 1.0, (1500, 12))
    share = np.mean([decide(FINDING, *fits_with_gains(row)).chosen for row in gains])
    assert 0.01 < share < 0.04  # the trimming makes 0.025 of 0.01


@pytest.mark.parametrize(("others", "chosen"), [(0.0, True), (-0.2, False)])
def test_one_of_several_cameras_may_need_an_effect(others, chosen):
    rng = np.random.default_rng(0)
    gains = np.concatenate([np.full(8, 0.4), np.full(12, others)]) + rng.normal(0, 0.03, 20)
    assert decide(FINDING, *fits_with_gains(gains, [1] * 8 + [2] * 12)).chosen is chosen
    assert not decide(FINDING, *fits_with_gains(gains[8:])).chosen


# Commands


@pytest.fixture
def folder(dataset, tmp_path, monkeypatch):
    """Opaque photographs of different exposure in ``data``."""
    without_images(monkeypatch)
    write_dataset(tmp_path / "data", spoil(dataset, darken), alpha=1.0)
    return tmp_path


SETTINGS = ("--set", f"iterations={ITERATIONS}", "--set", "init.half_extent=0.6")
SETTINGS += ("--set", "init.num_points=60", "--set", "data.background=[0.5, 0.5, 0.5]")
SETTINGS += ("--set", "model.antialiased=false")


@pytest.mark.slow
def test_a_fit_of_a_folder_chooses_says_why_and_asks_once(folder):
    data, out = folder / "data", folder / "out"
    text = assert_fits(data, "--out", out, *SETTINGS).stdout
    assert re.search(
        r"exposure and white balance +brightness differs by .* colors\.lr: 0\.02", text
    )
    why = r"\(colors\.lr: brightness differs by [\d.]+%, colours by [\d.]+%: \+[\d.]+ dB\)"
    assert re.search(why, text), text
    assert yaml.safe_load((out / "config.yml").read_text())["colors"]["lr"] == 0.02
    assert json.loads((out / "examination.json").read_text())["changes"] == {"colors.lr": 0.02}
    assert "is finished" in assert_fits(data, "--out", out, *SETTINGS).stdout
    again = assert_fits(out / "config.yml", "--out", folder / "again").stdout
    assert "examined" not in again
    points = [(f / "point_cloud.ply").read_bytes() for f in (out, folder / "again")]
    assert points[0] == points[1]
    printed = assert_examines(data, *SETTINGS).stdout
    assert re.search(r"examined in \d+ s, on (10|20) held-out views:", printed)
    assert re.search(rf"fit with it: drgs fit {data} .* --set colors\.lr=0\.02\n", printed)
    message = "already holds another run, "
    other = (*SETTINGS, "--set", "colors.lr=0.05")
    assert_fit_refused(data, "--out", out, *other, folder=folder, message=message)
    (out / "examination.json").write_text("{}")
    message = "examination.json: must be what an examination wrote"
    assert_fit_refused(data, "--out", out, *SETTINGS, folder=folder, message=message)


REFUSED = [
    (["nowhere"], "nowhere"),
    ([], "arguments are required"),
    (["empty"], "neither transforms_train.json"),
    (["data", "--set", "colors.lr=11"], "colors.lr must be <= 10, got 11"),
    (["data", "--set", "colours.lr=1"], "unknown key colours"),
    (["data", "--variant", "scalar_rgb"], "scalar_rgb"),
    (["data", "--threads", "0"], "--threads"),
    (["data", "more"], "unrecognized arguments: more"),
]


@pytest.mark.parametrize(("words", "message"), REFUSED)
def test_refused_inputs_of_the_command(words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    write_dataset(tmp_path / "data", make_dataset(2, 1))
    assert_refused(command.main, *words, folder=tmp_path, message=message)


def test_a_short_fit_of_a_folder_is_not_examined(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_dataset(tmp_path / "data", make_dataset(2, 1))
    outcome = assert_examines("data")
    assert "not examined: 2 training photographs are fewer than 20" in outcome.stdout
