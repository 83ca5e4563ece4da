"""The studies of accuracy measure what they print: the ladder of approximations, and float32."""

import csv
import json
import sys
from dataclasses import replace
from itertools import pairwise

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support import small_capture
from support.helpers import reference_gaussians
from support.studies import load_study, reference_rays

from drgs.bench.scenes import bench_camera, bench_gaussians
from drgs.core.errors import UserError
from drgs.results import metrics

accuracy, stability = map(load_study, ("accuracy", "stability"))
outside = load_study("error_budget_outside")


@pytest.fixture
def run_study(monkeypatch, tmp_path, capsys):
    """Run a study in an empty folder: run(module, *arguments); return what it printed."""

    def run(module, *arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [f"{module.__name__}.py", *map(str, arguments)])
        module.main()
        return capsys.readouterr().out

    return run


@pytest.mark.slow
def test_stability_finds_no_error_beyond_the_conditioning(run_study, tmp_path):
    """The bounds of test_hard_cases.py: 30 times the noise, 4 roundings in the exponential, n in a
    sum."""
    run_study(stability, "--quick", "--out", tmp_path)
    assert Image.open(tmp_path / "stability.png").size[0] > 800
    rows = list(csv.DictReader((tmp_path / "stability.csv").open()))
    assert {row["sweep"] for row in rows} == {sweep.name for sweep in stability.sweeps()}
    for row in rows:
        layers = float(row["value"]) if row["sweep"] == "Stack depth" else 60
        rounding = stability.UNIT_ROUNDOFF * (4 + np.sqrt(layers))
        for what in ("image", "gradient"):
            allowed = 30 * (float(row[f"{what}_noise"]) + rounding)
            assert 0 < float(row[what]) <= allowed, row
        assert float(row["left_out"]) < 0.1


# The ladder of accuracy


@pytest.fixture(scope="module")
def subject():
    """Three hundred splats that cover a small film."""
    gaussians = bench_gaussians(300)
    gaussians = replace(gaussians, log_scales=gaussians.log_scales + np.float32(1.8))
    camera = bench_camera(24)
    return accuracy.Subject("small", gaussians, [camera], (1.0, 1.0, 1.0))


ALL = next(rung for rung in accuracy.RUNGS if rung.name == "all of these")


def image_of(subject, **approximations):
    rung = accuracy.Rung("", approximations)
    return accuracy.RungRenderer.from_rung(rung, subject, subject.cameras[0]).image()


def test_each_rung_comes_closer_to_the_most_accurate_image(subject):
    """The most accurate kernels agree with it; each step on the way comes closer."""
    accurate = accuracy.most_accurate(subject, subject.cameras[0], accuracy.MIN_ALPHA)
    steps = [
        {},
        {"projection": "exact"},
        {"projection": "exact", "order": "pixel", "order_window": 16},
        {"projection": "exact", "order": "pixel", "order_window": 16, **accuracy.UNCUT},
        ALL.approximations,
    ]
    errors = [np.abs(image_of(subject, **step) - accurate).mean() for step in steps]
    assert all(after < before for before, after in pairwise(errors))
    # Left: single precision, alphas below a millionth, and the order among faint splats.
    assert errors[-1] < 1e-4 < errors[0]


def test_most_accurate_image_is_close_to_one_without_cuts(subject):
    for min_alpha, low, high in ((accuracy.MIN_ALPHA, 0, 3e-4), (1e-2, 1e-3, 1)):
        image = accuracy.most_accurate(subject, subject.cameras[0], min_alpha)
        # The first: three hundred alphas of less than a millionth.
        assert low < accuracy.check_on_crops(subject, image) < high


def test_measurement_matches_its_columns(subject):
    accurate = [accuracy.most_accurate(subject, c, accuracy.MIN_ALPHA) for c in subject.cameras]
    rungs = [accuracy.RUNGS[0], accuracy.Rung("exact", {"projection": "exact"})]
    default, exact = accuracy.measure(subject, accurate, rungs, 3)  # medians
    image = image_of(subject)
    reference_image = reference_rays.render(
        reference_gaussians(subject.gaussians), subject.cameras[0], (1, 1, 1)
    ).image
    assert np.abs(image - reference_image).mean() < 1e-5
    assert default.psnr == pytest.approx(metrics.psnr(image, accurate[0]), abs=1e-3)
    assert default.ssim == pytest.approx(metrics.ssim(image, accurate[0]), abs=1e-5)
    assert default.largest_error == pytest.approx(np.abs(image - accurate[0]).max(), abs=1e-4)
    assert 0 < default.milliseconds < default.both_milliseconds
    assert 1000 < default.operations < exact.operations


def test_pareto_front_contains_undominated_measurements():
    rows = [("a", 1, 30), ("b", 2, 40), ("c", 3, 35), ("d", 4, 50)]
    a, b, c, d = (
        accuracy.AccuracyMeasurement("scene", name, ms, 2 * ms, 1, psnr, 0.9, 0.1)
        for name, ms, psnr in rows
    )
    assert accuracy.pareto_front([d, c, b, a]) == [a, b, d]
    text = accuracy.table([a, b, c, d])
    assert "| a * | 1 ms, 1.00x | 2 ms, 1.00x | 1 | 30.0 dB |" in text and "| c | 3 ms" in text


@pytest.mark.slow
def test_the_ladder_of_a_ply_and_the_stress_scene(run_study, tmp_path, monkeypatch):
    mi.set_variant("llvm_ad_rgb")
    bench_gaussians(50).save(tmp_path / "few.ply")
    monkeypatch.setattr(accuracy, "FILM_SIZE_PX", 32)
    monkeypatch.setattr(accuracy, "RUNGS", accuracy.RUNGS[:3])
    printed = run_study(accuracy, "few.ply", "--quick", "--error", 0.1, "--out", tmp_path)
    assert "few: 50 Gaussians, 1 views" in printed and "| stress |" in printed
    with (tmp_path / "accuracy.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["scene"], row["rung"]) for row in rows] == [
        (scene, rung)
        for scene in ("few", "stress")
        for rung in ("default", "unscented", "exact", "error at most 0.1")
    ]
    assert Image.open(tmp_path / "accuracy.png").size[0] > 800


def test_measurement_includes_the_smoothing_filter(tmp_path, subject):
    """Without the filter, the most accurate form and all rungs agree."""
    gaussians = subject.gaussians
    smoothing = np.full(gaussians.num_gaussians, 0.1, np.float32)
    replace(gaussians, smoothing=smoothing).save(tmp_path / "smooth.ply")
    found = accuracy.load_subject(tmp_path / "smooth.ply", 1)
    assert (found.gaussians.log_scales > gaussians.log_scales).all()
    found = replace(found, cameras=subject.cameras, background=subject.background)
    accurate = accuracy.most_accurate(found, found.cameras[0], accuracy.MIN_ALPHA)
    without = accuracy.most_accurate(subject, subject.cameras[0], accuracy.MIN_ALPHA)
    image = image_of(found, **ALL.approximations)
    # The error of the last rung; the filter is as wide as the splats and changes far more.
    assert np.abs(image - accurate).mean() < 1e-4 < 0.01 < np.abs(accurate - without).mean()


@pytest.mark.parametrize("has", ["lens distortion", "motion"])
def test_views_other_than_static_pinholes_are_refused(tmp_path, has):
    """A fit's folder is refused; its Gaussians can be measured alone."""
    fit = small_capture.write_fit(tmp_path, small_capture.make_dataset(2, 1))
    path = tmp_path / "data" / "transforms_test.json"
    transforms = json.loads(path.read_text())
    if has == "motion":
        (frame,) = transforms["frames"]
        close = np.array(frame["transform_matrix"])
        close[0, 3] += 0.1
        frame["transform_matrix_close"] = close.tolist()
    else:
        transforms["k1"] = 0.1
    path.write_text(json.dumps(transforms))
    with pytest.raises(UserError, match=f"has {has}, expected pinhole cameras at rest") as refused:
        accuracy.load_subject(fit, 1)
    assert f"give {fit / 'point_cloud.ply'} instead" in str(refused.value)
    with pytest.raises(UserError, match="must be the output folder of a fit that has ended"):
        accuracy.load_subject(tmp_path, 1)


# ----------------------------------------------------------------------------------------------
# Error budgets, judged by rays in numpy
# ----------------------------------------------------------------------------------------------

SLOW_KINDS = ("wide fisheye", "rolling shutter", "surface and environment")


@pytest.mark.parametrize(
    "name", ["8 x 8 pixels", *(pytest.param(k, marks=pytest.mark.slow) for k in SLOW_KINDS)]
)
def test_error_budgets_hold_at_views_that_were_not_measured(name):
    """One view in twenty may exceed them, by half at most: here there are six."""
    ((_, _, chosen, kept, worst, stated),) = outside.rows_of(name, outside.kinds()[name], (0.01,))
    assert "order=pixel" in chosen
    assert kept in ("5 of 6", "6 of 6") and 0.1 < float(worst) <= 1.5 and float(stated) <= 1


def test_judging_by_rays_finds_budgets_that_are_exceeded(monkeypatch):
    """Images are those of splats that are a little more opaque."""
    kind = outside.kinds()["8 x 8 pixels"]
    logits = kind.gaussians["logit_opacities"] + 0.3
    other = replace(kind, gaussians={**kind.gaussians, "logit_opacities": logits})
    monkeypatch.setattr(type(kind), "truth", lambda self, pose, truth=kind.truth: truth(pose))
    ((*_, kept, worst, _),) = outside.rows_of("more opaque", other, (0.01,))
    assert kept == "0 of 6" and float(worst) > 1.5
