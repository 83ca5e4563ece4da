"""Values that a configuration accepts are values that a fit can compute with."""

import math
import warnings

import mitsuba as mi
import numpy as np
import pytest
from pydantic import BaseModel
from support.fit_command import run_fit, without_images, write_project
from support.small_fits import make_trainer, plain_dataset

from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


REFUSED = {
    "init.opacity": ["1e-200", "0.9999999999999999"],
    "model.alpha_max": ["1e-46", "0.9999999999999999", "1e300"],
    "model.extent": ["1e308", "1e39", "1e-50"],
    "model.low_pass": ["1e39", "1e300"],
    "model.near": ["1e-320", "1e39"],
    "loss.sigma": ["1e-200", "1e300"],
    "loss.depth_weight": ["1e300"],
    "cameras.focal_lr": ["1e10"],
    "cameras.rotation_lr": ["1e300"],
    "colors.lr": ["1e20"],
    "colors.identity_weight": ["1e300"],
    "optimizer.means_lr": ["1e300"],
    "optimizer.quats_lr": ["1e38"],
    "optimizer.beta_1": ["0.9999999999999999"],
    "optimizer.beta_2": ["0.9999999999999999"],
    "optimizer.epsilon": ["1e-200", "1e300"],
}


@pytest.mark.parametrize("key", REFUSED)
def test_unusable_value_is_refused_by_name(tmp_path, key):
    (tmp_path / "a.yml").write_text("data: {path: x}\n")
    for value in REFUSED[key]:
        with warnings.catch_warnings(), pytest.raises(UserError) as error:
            warnings.simplefilter("error")  # as lines of NumPy would be
            load_config(tmp_path / "a.yml", [f"{key}={value}"])
        assert str(error.value).startswith(f"--set {key}: {key} must be "), value
        assert "\n" not in str(error.value)


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
