"""Costs of effects: the command with small scenes, and its numbers."""

import csv
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from drgs.bench import __main__ as bench
from drgs.bench import effects, scenes


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


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


def test_images_are_never_reused(small):
    """Each is rendered: the second launches what the first did."""
    renderer = effects.CaseRenderer(effects.rendering_cases()[0], scenes.bench_gaussians(150))
    counts = [effects.operations(renderer) for _ in range(2)]
    assert counts[0] == counts[1] > 1000


def test_derivatives_do_not_add_up_over_rounds(small):
    cases = {c.effect: c for c in effects.rendering_cases()}
    renderer = effects.CaseRenderer(cases["camera refinement"], scenes.bench_gaussians(150))
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
