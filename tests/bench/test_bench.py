"""The measurements run, write what they say and nothing else, and measure what they say."""

import argparse
import csv
import importlib
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.helpers import FLOAT32 as SINGLE
from support.helpers import Case, clear, device_camera, device_gaussians

from drgs.bench import __main__ as bench
from drgs.bench import scaling, scenes, speed, stability, timing
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
    frame = rendering.render(
        device_gaussians(case.gaussians, SINGLE), device_camera(case.camera, SINGLE),
        rendering.Pipeline(0),
    )  # fmt: skip
    work = timing.count_work(frame)
    splats = reference.project(case.gaussians, case.camera)
    order = reference._depth_order(splats.depths, splats.visible)
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


def test_exponents_of_a_power_law_are_recovered():
    work = timing.Work(1, 1, 1, 1)
    found = [
        scaling.Result(scaling.Point("Gaussians", n, 400, 2), 3e-3 * n**1.5, 7 * n, 0, work)
        for n in (1000, 5000, 20_000)
    ]
    assert scaling.exponent(found, "milliseconds") == pytest.approx(1.5)
    assert scaling.exponent(found, "device_bytes") == pytest.approx(1)


def test_entries_per_gaussian_stay_constant_as_their_number_grows():
    """In the first sweep the film grows and the Gaussians shrink."""
    ratios = []
    for point in scaling.points(quick=True):
        if point.sweep.startswith("constant"):
            gaussians = scenes.bench_gaussians(point.count)
            scales = gaussians.log_scales + np.float32(np.log(point.scale))
            gaussians = replace(gaussians, log_scales=scales)
            scene = scenes.Scene("", gaussians, scenes.bench_camera(point.size))
            ratios.append(timing.count_work(scenes.frame_of(scene)).entries / point.count)
    assert len(ratios) >= 2 and max(ratios) / min(ratios) < 1.1


def measurement(text):
    """``measure(folder)``, which writes ``text`` as ``it.csv``."""
    parser = argparse.ArgumentParser()
    add_out(parser, lambda args: (args.out / "it.csv").write_text(text), "it.csv")

    def measure(folder):
        args = parser.parse_args(["--out", str(folder)])
        args.run(args)

    return measure


def test_a_measurement_is_replaced_by_the_next_and_nothing_else(tmp_path):
    (tmp_path / "it.csv").write_text("mine")
    with pytest.raises(UserError, match=r"holds it\.csv"):
        measurement("first")(tmp_path)
    path = tmp_path / "out" / "it.csv"
    measurement("first")(path.parent)
    measurement("second")(path.parent)
    assert path.read_text() == "second"
    path.write_text("edited")
    with pytest.raises(UserError, match=r"holds it\.csv"):
        measurement("third")(path.parent)
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
