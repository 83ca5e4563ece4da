"""The measurements run, write what they say and nothing else, and measure what they say."""

import argparse
import csv
import importlib
import json
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support import small_capture
from support.commands import assert_refused
from support.helpers import FLOAT32 as SINGLE
from support.helpers import Case, clear, device_camera, device_gaussians, reference_gaussians

from drgs.bench import __main__ as bench
from drgs.bench import accuracy, effects, scaling, scenes, speed, stability, timing
from drgs.bench.__main__ import COMMANDS
from drgs.bench.output import add_out
from drgs.bench.scenes import bench_camera, bench_gaussians
from drgs.cli.commands import CommandParser
from drgs.core.errors import UserError
from drgs.datasets.types import View
from drgs.reference import rays as reference_rays
from drgs.reference import splatting as reference
from drgs.results import metrics
from drgs.splatting import rendering


@pytest.mark.slow
def test_stability_finds_no_error_beyond_the_conditioning(tmp_path):
    """The bounds of test_hard_cases.py: 30 times the noise, 4 roundings in the exponential, n in a
    sum."""
    bench.main(["stability", "--quick", "--out", str(tmp_path)])
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


def test_useful_pairs_match_the_reference():
    case = clear(Case("pairs", 40, 35, 0, count=80))
    inputs = device_gaussians(case.gaussians, SINGLE), device_camera(case.camera, SINGLE)
    work = timing.count_work(rendering.render(*inputs, rendering.Pipeline(0)))
    splats = reference.project(case.gaussians, case.camera)
    order = reference.depth_order(splats.depths, splats.visible)
    y, x = np.mgrid[: case.height, : case.width] + 0.5
    transmittance, finished, useful = np.ones(x.shape), np.zeros(x.shape, bool), 0
    for i in order:
        d = np.stack([x - splats.means2d[i, 0], y - splats.means2d[i, 1]], axis=-1)
        exponent = -0.5 * np.einsum("hwi,ij,hwj->hw", d, splats.conics[i], d)
        alpha = np.minimum(splats.opacities[i] * np.exp(exponent), reference.ALPHA_MAX)
        seen = (alpha >= reference.ALPHA_CUT) & ~finished
        finished |= seen & (transmittance * (1 - alpha) < reference.TRANSMITTANCE_STOP)
        seen &= ~finished
        transmittance = np.where(seen, transmittance * (1 - alpha), transmittance)
        useful += int(seen.sum())
    assert work.useful == useful > 1000
    assert work.useful <= work.evaluated <= 16 * work.micro_entries
    assert work.entries <= work.micro_entries <= 16 * work.entries


@pytest.fixture
def small_scene():
    mi.set_variant("llvm_ad_rgb")
    return scenes.Scene("small", bench_gaussians(500), bench_camera(48))


def test_an_iteration_is_profiled(small_scene):
    """Every kernel of it belongs to a stage."""
    before = rendering.bin_splats
    report = speed.profile_training(small_scene, rounds=2)
    assert rendering.bin_splats is before
    assert report.wall_ms > 0 and report.kernel_ms > 0
    assert set(report.num_kernels) == set(timing.STAGES)
    assert all(count > 0 for count in report.num_kernels.values())
    assert report.work.useful > 0


def test_renderers_do_not_reuse_a_frame(small_scene):
    problem = speed.Problem(small_scene.gaussians, small_scene.camera, np.ones((48, 48, 3)))
    renderer = speed.drgs_renderer(problem)
    renderer.forward()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        renderer.forward()
        first = len(dr.kernel_history())
        renderer.forward()
        assert len(dr.kernel_history()) == first >= 10


def test_entries_per_gaussian_stay_constant_as_their_number_grows():
    """In the first sweep the film grows and the Gaussians shrink; a power law is recovered."""
    work, ratios = timing.Work(1, 1, 1, 1), []
    found = [
        scaling.Result(scaling.Point("Gaussians", n, 400, 2), 3e-3 * n**1.5, 7 * n, 0, work)
        for n in (1000, 5000, 20_000)
    ]
    assert scaling.exponent(found, "milliseconds") == pytest.approx(1.5)
    assert scaling.exponent(found, "device_bytes") == pytest.approx(1)
    for point in scaling.points(quick=True):
        if point.sweep.startswith("constant"):
            gaussians = bench_gaussians(point.count)
            scales = gaussians.log_scales + np.float32(np.log(point.scale))
            gaussians = replace(gaussians, log_scales=scales)
            scene = scenes.Scene("", gaussians, bench_camera(point.size))
            ratios.append(timing.count_work(scenes.frame_of(scene)).entries / point.count)
    assert len(ratios) >= 2 and max(ratios) / min(ratios) < 1.1


def test_a_measurement_is_replaced_by_the_next_unless_it_was_edited(tmp_path):
    path, text = tmp_path / "it.csv", ""
    parser = argparse.ArgumentParser()
    add_out(parser, lambda args: path.write_text(text), "it.csv")
    args = parser.parse_args(["--out", str(tmp_path)])
    for text in ("first", "second"):  # noqa: B007  (the measurement writes it)
        args.run(args)
    assert path.read_text() == "second"
    path.write_text("edited")
    with pytest.raises(UserError, match=r"holds it\.csv"):
        args.run(args)
    assert path.read_text() == "edited"


@pytest.mark.parametrize("name", COMMANDS)
def test_existing_output_is_refused_before_measuring(name, tmp_path):
    module = importlib.import_module(f"drgs.bench.{name}")
    parser = CommandParser()
    module.add_arguments(parser)
    (tmp_path / f"{name}.csv").write_text("mine")
    args = parser.parse_args(["--out", str(tmp_path)])
    with pytest.raises(UserError, match=rf"holds .*{name}\.csv"):
        args.run(args)
    assert [p.name for p in tmp_path.iterdir()] == [f"{name}.csv"]


@pytest.fixture
def small(monkeypatch):
    """32 px, 150 Gaussians, one round."""
    monkeypatch.setattr(effects, "SIZE", 32)
    monkeypatch.setattr(effects, "NUM_GAUSSIANS", 150)
    monkeypatch.setattr(effects, "ROUNDS", 1)
    monkeypatch.setattr(effects, "ENVIRONMENT_SHAPE", (4, 8))


@pytest.mark.slow
def test_the_command_writes_its_table_and_plot(small, tmp_path, capsys):
    bench.main(["effects", "--out", str(tmp_path)])
    with (tmp_path / "effects.csv").open() as file:
        rows = list(csv.DictReader(file))
    cases = [*effects.rendering_cases(), *effects.fitting_cases()]
    assert [(r["effect"], r["variant"]) for r in rows] == [(c.effect, c.variant) for c in cases]
    for row in rows:
        for name in ("both_ms", "both_ratio", "operations"):
            assert float(row[name]) > 0, row
        assert row["effect"] != "none" or row["operations_more"] == "0"
    assert Image.open(tmp_path / "effects.png").size[0] > 500
    printed = capsys.readouterr().out
    assert "150 Gaussians, 32x32" in printed
    assert printed.count("| --- |") >= 2 and str(tmp_path / "effects.csv") in printed


def test_every_case_renders_a_different_image(small):
    """But for derivatives, which are no image's, and effects that a single sample cannot show."""
    gaussians = bench_gaussians(150)
    images = {}
    for case in effects.rendering_cases():
        image = np.array(effects.CaseRenderer(case, gaussians)._render())
        assert image.shape == (32, 32, 3) and np.isfinite(image).all()
        images[case.effect, case.variant] = image
    plain = images["none", "none"]
    for key, image in images.items():
        same = key in (("none", "none"), ("camera refinement", "pose and focal lengths"))
        assert (np.abs(image - plain).max() < 1e-4) == same, key


def test_derivatives_do_not_add_up_over_rounds(small):
    cases = {c.effect: c for c in effects.rendering_cases()}
    renderer = effects.CaseRenderer(cases["camera refinement"], bench_gaussians(150))
    first, second = (effects.operations(renderer) for _ in range(2))
    assert first == second > 1000  # images are never reused
    found = []
    for _ in range(2):
        renderer.forward_and_backward()
        found.append([np.array(dr.grad(renderer.params[n])) for n in renderer.differentiated])
    for first, second in zip(*found, strict=True):
        np.testing.assert_array_equal(first, second)
    assert sum(first.any() for first in found[0]) >= 6


def test_prices_are_medians_relative_to_the_first_case(monkeypatch):
    """With a clock of our own: an effect that takes twice as long has the ratio 2."""

    def subject(case):
        cost = 1.0 + (case.effect == "slow")
        return SimpleNamespace(forward=lambda: cost, forward_and_backward=lambda: 3 * cost)

    cases = [effects.FittingCase("none", "none"), effects.FittingCase("slow", "x")]
    monkeypatch.setattr(effects, "seconds", lambda function: function())
    monkeypatch.setattr(effects, "operations", lambda subject: int(100 * subject.forward()))
    prices = effects.measure(cases, subject, rounds=3)
    table = effects.table(prices, "image", "both").splitlines()
    assert "| slow | x | 2000.0 ms | 2.00 | 6000.0 ms | 2.00 | +100 |" in table
    table = effects.table(prices, "", "both").splitlines()
    assert "| slow | x | 6000.0 ms | 2.00 | +100 |" in table


# The ladder of accuracy


@pytest.fixture(scope="module")
def subject():
    """Three hundred splats that cover a small film."""
    gaussians = bench_gaussians(300)
    gaussians = replace(gaussians, log_scales=gaussians.log_scales + np.float32(1.8))
    camera = bench_camera(24)
    grey = np.full((24, 24, 3), 0.5, np.float32)
    photograph = View(
        "grey", np.eye(4), camera.fx, camera.fy, camera.cx, camera.cy, 24, 24, image=grey
    )
    return accuracy.Subject("small", gaussians, [camera], [photograph], (1.0, 1.0, 1.0))


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
    """Masked pixels of a photograph are left out."""
    accurate = [accuracy.most_accurate(subject, c, accuracy.MIN_ALPHA) for c in subject.cameras]
    rungs = [accuracy.RUNGS[0], accuracy.Rung("4 samples", {"low_pass": 0.0}, False, samples=4)]
    default, sampled = accuracy.measure(subject, accurate, rungs, 3)  # medians
    image = image_of(subject)
    reference_image = reference_rays.render(
        reference_gaussians(subject.gaussians), subject.cameras[0], (1, 1, 1)
    ).image
    assert np.abs(image - reference_image).mean() < 1e-5
    assert default.psnr == pytest.approx(metrics.psnr(image, accurate[0]), abs=1e-3)
    assert default.ssim == pytest.approx(metrics.ssim(image, accurate[0]), abs=1e-5)
    assert default.largest_error == pytest.approx(np.abs(image - accurate[0]).max(), abs=1e-4)
    assert default.photo_psnr == pytest.approx(
        metrics.psnr(image, subject.photographs[0].image), abs=1e-3
    )
    mask = np.ones((24, 24), np.float32)
    mask[:, 5:] = 0
    masked = replace(subject, photographs=[replace(subject.photographs[0], mask=mask)])
    (found,) = accuracy.measure(masked, accurate, rungs[:1], 1)
    expected = metrics.psnr(image[:, :5], subject.photographs[0].image[:, :5])
    assert found.photo_psnr == pytest.approx(expected, abs=1e-3)
    assert abs(expected - default.photo_psnr) > 0.1
    assert 0 < default.milliseconds < default.both_milliseconds
    assert 1000 < default.operations < sampled.operations


def test_pareto_front_contains_undominated_measurements():
    rows = [("a", 1, 30), ("b", 2, 40), ("c", 3, 35), ("d", 4, 50), ("other", 0.5, 90)]
    a, b, c, d, other = (
        accuracy.AccuracyMeasurement(
            "scene", name, name != "other", ms, 2 * ms, 1, psnr, 0.9, 0.1, None
        )
        for name, ms, psnr in rows
    )
    assert accuracy.pareto_front([d, c, other, b, a]) == [a, b, d]
    text = accuracy.table([a, b, c, d, other])
    assert "| a * | 1 ms, 1.00x | 2 ms, 1.00x | 1 | 30.0 dB |" in text
    assert "| c | 3 ms" in text and "| (other) | 0 ms" in text


@pytest.mark.slow
def test_the_command_measures_a_ply_and_the_stress_scene(tmp_path, capsys, monkeypatch):
    mi.set_variant("llvm_ad_rgb")
    bench_gaussians(50).save(tmp_path / "few.ply")
    monkeypatch.setattr(accuracy, "FILM_SIZE_PX", 32)
    monkeypatch.setattr(accuracy, "RUNGS", accuracy.RUNGS[:3])
    words = ["--quick", "--error", "0.1", "--out", str(tmp_path)]
    bench.main(["accuracy", str(tmp_path / "few.ply"), *words])
    printed = capsys.readouterr().out
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
    message = f"has {has}, expected pinhole cameras at rest"
    line = assert_refused(bench.main, "accuracy", fit, folder=tmp_path, message=message)
    assert f"give {fit / 'point_cloud.ply'} instead" in line
    message = "must be the folder of a finished fit"
    assert_refused(bench.main, "accuracy", tmp_path, folder=tmp_path, message=message)
