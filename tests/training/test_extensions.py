"""Extensions of a fit that live outside of drgs: by name in a configuration, and as objects."""

import importlib
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits

import drgs
from drgs.cli.commands import CommandParser
from drgs.config.changes import with_changes
from drgs.config.load import config_from, dump_config, load_config
from drgs.core import registry
from drgs.core.errors import UserError
from drgs.training.effects.base import training_effects
from drgs.training.losses import prepare_target

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
NAMES = ("binary_opacity", "charbonnier", "halving", "vignetting")


@pytest.fixture(autouse=True)
def examples(monkeypatch):
    """The modules of the examples, found as those of an installed package are."""
    mi.set_variant("llvm_ad_rgb")
    monkeypatch.syspath_prepend(EXAMPLES)
    points = [EntryPoint(name, name, registry.ENTRY_POINT_GROUP) for name in NAMES]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    yield {name: importlib.import_module(name) for name in NAMES}
    for each in registry._registries:
        for name in NAMES:
            each._extensions.pop(name, None)
    registry._loaded.difference_update(NAMES)
    for name in NAMES:
        sys.modules.pop(name, None)


def configured(**changes):
    """The configuration of a small fit with the examples, from nested mappings."""
    values = fits.config_of().model_dump()
    values["densify"] = {"strategy": "halving"}
    values["loss"] = {"type": "charbonnier"}
    values["extensions"] = {
        "halving": {"after": 6},
        "vignetting": {},
        "binary_opacity": {"weight": 0.5},
        **changes,
    }
    values["iterations"], values["init"] = 12, {"num_points": 40}
    return config_from(values, "x.yml")


def test_documented_examples_are_the_files():
    text = (EXAMPLES.parent.parent / "docs" / "developing.md").read_text()
    for name in NAMES:
        source = (EXAMPLES / f"{name}.py").read_text()
        assert f"```python\n{source}```" in text, name
        assert 15 <= len(source.splitlines()) <= 60


def test_a_configuration_names_extensions_and_sets_their_sections(tmp_path):
    config = configured()
    assert config.extensions["halving"].after == 6
    assert config.extensions["vignetting"].lr == 0.01
    dump_config(config, tmp_path / "config.yml")
    again = load_config(tmp_path / "config.yml", ["extensions.binary_opacity.weight=2.5"])
    assert with_changes(again, {"extensions": {}}) == with_changes(config, {"extensions": {}})
    assert again.extensions["binary_opacity"].weight == 2.5
    assert type(again.extensions["halving"]) is type(config.extensions["halving"])


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"halvin": {}}, "x.yml: extensions.halvin: no extension has this name; did you mean halv"),
        ({"halving": {"after": 0}}, "x.yml: extensions.halving.after must be >= 1, got 0"),
        (
            {"halving": {"aftr": 3}},
            "x.yml: unknown key extensions.halving.aftr; did you mean after?",
        ),
    ],
)
def test_wrong_sections_are_refused_with_their_place(sections, message):
    with pytest.raises(UserError) as caught:
        configured(**sections)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_an_unknown_strategy_lists_the_installed_ones():
    with pytest.raises(UserError, match=r"must be one of 'adc', 'budget', 'mcmc', 'halving'; did"):
        config_from({"data": {"path": "."}, "densify": {"strategy": "halvin"}}, "x.yml")


def test_strategy_provides_the_defaults_of_its_schedule(examples, monkeypatch):
    values = {"data": {"path": "."}, "iterations": 1000, "densify": {"strategy": "halving"}}
    densify = config_from(values, "x.yml").densify
    assert (densify.start, densify.stop) == (50, 500)
    monkeypatch.setattr(examples["halving"].Halving, "start_share", 0.25)
    monkeypatch.setattr(examples["halving"].Halving, "stop_share", 0.8)
    densify = config_from(values, "x.yml").densify
    assert (densify.start, densify.stop) == (250, 800)


def test_a_trainer_takes_a_density_strategy(examples):
    """The object changes rows, not the strategy of the configuration."""
    config = configured()
    values = config.model_dump() | {"densify": {}}
    strategy = examples["halving"].Halving(config.extensions["halving"])
    config = config_from(values, "x.yml")
    start = fits.disturbed_blobs()
    trainer = fits.Trainer(config, fits.plain_dataset(), start, density=strategy)
    for _ in range(6):
        trainer.step()
    assert trainer.num_gaussians == start.num_gaussians - start.num_gaussians // 2


def test_fit_uses_configured_extensions():
    result = drgs.train(configured(), fits.plain_dataset())
    trainer = result.trainer
    (effect,) = trainer.effects
    assert type(trainer.density).__name__ == "Halving" and effect.name == "vignetting"
    assert [row.num_gaussians for row in result.history][-1] == trainer.num_gaussians
    start = fits.Trainer(configured(), fits.plain_dataset(), fits.disturbed_blobs()).num_gaussians
    trainer = fits.Trainer(configured(), fits.plain_dataset(), fits.disturbed_blobs())
    reports = [trainer.step() for _ in range(8)]
    assert trainer.num_gaussians == start - start // 2
    assert [bool(report.density) for report in reports] == [False] * 5 + [True] + [False] * 2
    assert float(effect.state()["strength.value"][0, 0]) != 0


def test_effect_applies_depending_on_the_dataset(examples, monkeypatch):
    """Return whether its section is present."""
    needs = lambda config, dataset: any(view.depth is not None for view in dataset.train)  # noqa: E731
    monkeypatch.setattr(examples["vignetting"].Vignetting, "is_used", needs)
    for dataset, used in ((fits.plain_dataset(), []), (fits.true_dataset(), ["vignetting"])):
        effects = training_effects(configured(), dataset)
        assert [effect.name for effect in effects if effect.name != "depth"] == used


@pytest.mark.slow
def test_objects_and_names_give_the_same_bytes(examples):
    """Objects: an effect, a strategy and a loss."""
    config = configured()
    named = drgs.train(config, fits.plain_dataset()).gaussians
    values = config.model_dump() | {"densify": {}, "loss": {}}
    values["extensions"] = {"binary_opacity": {"weight": 0.5}}
    section = config.extensions
    given = drgs.train(
        values,
        fits.plain_dataset(),
        strategy=examples["halving"].Halving(section["halving"]),
        effects=[examples["vignetting"].Vignetting(section["vignetting"])],
        loss=examples["charbonnier"].Charbonnier(examples["charbonnier"].CharbonnierSection()),
    ).gaussians
    for name in ("means", "sh0", "logit_opacities"):
        np.testing.assert_array_equal(getattr(given, name), getattr(named, name))


@pytest.mark.slow
def test_fit_resumes_from_a_checkpoint_to_the_same_bytes():
    def trainer():
        return fits.Trainer(configured(), fits.plain_dataset(), fits.disturbed_blobs())

    whole, first, second = trainer(), trainer(), trainer()
    fits.steps(whole, 10)
    fits.steps(first, 7)
    state = first.state()
    assert "vignetting/strength.value" in state
    second.restore(state)
    fits.steps(second, 3)
    assert fits.everything_of(second) == fits.everything_of(whole)


def test_loss_and_its_term_match_numpy(examples):
    rng = np.random.default_rng(0)
    image, photograph = rng.uniform(size=(2, 5, 7, 3)).astype(np.float32)
    loss = examples["charbonnier"].Charbonnier(examples["charbonnier"].CharbonnierSection())
    shown, target = mi.TensorXf(image), prepare_target(mi.TensorXf(photograph))
    dr.enable_grad(shown)
    found, error = loss.with_squared_error(shown, target)
    difference = image.astype(np.float64) - photograph
    distance = np.sqrt(difference**2 + 1e-4)
    assert float(found[0]) == pytest.approx((distance - 0.01).mean(), rel=1e-5)
    assert float(error[0]) == pytest.approx((difference**2).mean(), rel=1e-5)
    dr.backward(found)
    expected = difference / distance / difference.size
    np.testing.assert_allclose(np.array(dr.grad(shown)), expected, rtol=1e-4, atol=1e-8)
    plain = fits.Trainer(configured(binary_opacity={"weight": 0}), *fit_inputs())
    heavy = fits.Trainer(configured(binary_opacity={"weight": 2.0}), *fit_inputs())
    opacities = 1 / (1 + np.exp(-fits.disturbed_blobs().logit_opacities.astype(np.float64)))
    more = 2 * (opacities * (1 - opacities)).mean()
    assert heavy.step().loss - plain.step().loss == pytest.approx(more, rel=1e-4)


def fit_inputs():
    return fits.plain_dataset(), fits.disturbed_blobs()


def test_errors_of_an_extension_are_reported_with_its_name(examples, monkeypatch):
    module = examples["vignetting"]
    exec("def adjust(self, image, view):\n    raise KeyError('oh')\n", vars(module))
    monkeypatch.setattr(module.Vignetting, "adjust", module.adjust)
    with pytest.raises(UserError, match=r"^effect \"vignetting\" \(vignetting\): KeyError: 'oh'$"):
        drgs.train(configured(), fits.plain_dataset())


def test_summary_and_help_list_extensions():
    from drgs.fit import add_arguments
    from drgs.integrator.summary import format_effects
    from drgs.training.summary import summary_of_fit

    text = format_effects(summary_of_fit(configured(), fits.plain_dataset()))
    assert "vignetting: effect: Renderings are darkened" in text and "extensions.vignetting" in text
    assert "halving: density strategy: Keeps the more" in text
    assert "(densify.strategy: halving)" in text
    parser = CommandParser(prog="drgs fit")
    add_arguments(parser)
    text = " ".join(parser.format_help().split())
    assert "installed extensions:" in text
    assert "loss term binary_opacity: The mean of o (1 - o)" in text
