"""The measurements run, write what they say and nothing else, and measure what they say."""

import argparse
import csv
import importlib
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.helpers import FLOAT32 as SINGLE
from support.helpers import Case, clear, device_camera, device_gaussians

from drgs.bench import __main__ as bench
from drgs.bench import effects, scaling, scenes, speed, stability, timing
from drgs.bench.__main__ import COMMANDS
from drgs.bench.output import add_out
from drgs.cli.commands import CommandParser
from drgs.core.errors import UserError
from drgs.reference import splatting as reference
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
    return scenes.Scene("small", scenes.bench_gaussians(500), scenes.bench_camera(48))


def test_an_iteration_is_profiled(small_scene):
    """Every kernel of it belongs to a stage."""
    before = rendering.bin_footprints
    report = speed.profile_training(small_scene, rounds=2)
    assert rendering.bin_footprints is before
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
            gaussians = scenes.bench_gaussians(point.count)
            scales = gaussians.log_scales + np.float32(np.log(point.scale))
            gaussians = replace(gaussians, log_scales=scales)
            scene = scenes.Scene("", gaussians, scenes.bench_camera(point.size))
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
    gaussians = scenes.bench_gaussians(150)
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
    renderer = effects.CaseRenderer(cases["camera refinement"], scenes.bench_gaussians(150))
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
