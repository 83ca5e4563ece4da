"""Values that a configuration accepts are values that a fit can compute with."""

import math

import mitsuba as mi
import numpy as np
import pytest
from pydantic import BaseModel
from support.fit_command import run_fit, without_images, write_project
from support.small_fits import make_trainer, plain_dataset

from drgs.config.schema import FitConfig
from drgs.core.errors import UserError


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def numbers_of(key, model):
    """(name, (least, most)) of the numbers of a section, and of the sections in it.

    As close as float64 comes to what a number must not be.
    """
    for name, field in model.model_fields.items():
        if field.annotation in (float, float | None):
            low, high = -math.inf, math.inf
            for limit in field.metadata:
                low = max(low, getattr(limit, "ge", low))
                low = max(low, np.nextafter(getattr(limit, "gt", -math.inf), math.inf))
                high = min(high, getattr(limit, "le", high))
                high = min(high, np.nextafter(getattr(limit, "lt", math.inf), -math.inf))
            yield f"{key}.{name}", (low, high)
        elif isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from numbers_of(f"{key}.{name}", field.annotation)


SECTIONS = ["init", "model", "optimizer", "loss", "colors", "cameras", "densify"]

NUMBERS = [p for s in SECTIONS for p in numbers_of(s, FitConfig.model_fields[s].annotation)]

UNLIMITED = {"model.low_pass", "densify.adc.grad_threshold", "densify.adc.clone_scale",
             "densify.adc.prune_scale", "densify.adc.split_shrink"}  # fmt: skip
"""Compared with, or finite in float32, however large they are."""


def test_every_number_has_two_limits():
    for key, (low, high) in NUMBERS:
        assert low > -math.inf
        assert high < math.inf or key in UNLIMITED, key


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return write_project(
        tmp_path_factory.mktemp("scene"),
        model={"sh_degree": 1, "sh_increase_every": 2, "smoothing": True},
        colors={"lr": 0.02},
        cameras={"optimise": True, "focal_lr": 1e-4, "principal_lr": 1e-4},
        iterations=4,
        output={"save_renders": False},
    )


@pytest.mark.slow
@pytest.mark.parametrize(("key", "ends"), NUMBERS)
def test_fit_accepts_numbers_at_their_limits_or_reports_the_problem(
    config, tmp_path, monkeypatch, key, ends
):
    without_images(monkeypatch)
    for value in (*ends, 1e-300, 1e300):
        if math.isfinite(value):
            outcome = run_fit(config, "--out", tmp_path / f"{value}", "--set", f"{key}={value}")
            assert outcome.returncode in (0, 2), outcome
            assert outcome.stderr.count("\n") == (outcome.returncode == 2), outcome.stderr


def test_diverging_focal_lengths_are_an_error_naming_their_rate():
    trainer = make_trainer(plain_dataset(), cameras__optimise=True, cameras__focal_lr=1.0)
    (effect,) = (e for e in trainer.effects if e.name == "cameras")
    assert effect.lens_change.focal == (1, 1)
    state = effect.state()
    state["log_focals.value"][:] = 88
    effect.restore(state)
    with pytest.raises(
        UserError, match=r"cameras.focal_lr: .* up to 1000, got e to the power of 88"
    ):
        effect.correct_views(())
