"""Extensions of a fit that live outside of drgs: by name in a configuration, and as objects."""

import json
import os
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits
from support.fit_command import write_project
from support.installed_examples import installed_examples

import drgs
from drgs.cli.commands import CommandParser
from drgs.config.changes import with_changes
from drgs.config.load import config_from, dump_config, load_config
from drgs.core.errors import UserError
from drgs.effects.base import training_effects
from drgs.effects.optimised import OptimisedEffect
from drgs.fit.__main__ import add_arguments
from drgs.fit.summary import summary_of_fit
from drgs.integrator.summary import format_effects
from drgs.results.folder import result_names
from drgs.training.losses import prepare_target


@pytest.fixture(autouse=True)
def examples():
    with installed_examples("binary_opacity", "charbonnier", "halving", "vignetting") as modules:
        yield modules


def configured(**changes):
    """The configuration of a small fit with the examples, from nested mappings."""
    values = fits.config_of().model_dump()
    values["densify"] = {"strategy": "halving", "halving": {"after": 6}, "remove_floaters": False}
    values["loss"] = {"type": "charbonnier"}
    values |= {"vignetting": {}, "binary_opacity": {"weight": 0.5}, **changes}
    values["iterations"], values["init"] = 12, {"num_points": 40}
    return config_from(values, "x.yml")


def test_a_configuration_names_extensions_and_sets_their_sections(tmp_path):
    config = configured()
    assert config.densify.sections["halving"].after == 6
    assert config.sections["vignetting"].lr == 0.01
    dump_config(config, tmp_path / "config.yml")
    again = load_config(tmp_path / "config.yml", ["binary_opacity.weight=2.5"])
    assert with_changes(again, {"binary_opacity.weight": 0.5}) == config
    assert type(again.densify.sections["halving"]) is type(config.densify.sections["halving"])


REFUSED = [
    ({"halvin": {}}, "unknown key halvin; did you mean densify.halving?"),
    ({"extensions": {"halving": {}}}, "extensions must be {}, its only value since 0.1.0"),
    ({"densify": {"halving": {"after": 0}}}, "densify.halving.after must be >= 1, got 0"),
    ({"densify": {"halving": {"aftr": 3}}}, "unknown key densify.halving.aftr; did you mean"),
    (
        {"densify": {"strategy": "halvin"}},
        "densify.strategy must be one of 'adc', 'budget', 'mcmc', 'halving'; did you mean halving",
    ),
]


@pytest.mark.parametrize(("values", "message"), REFUSED)
def test_wrong_sections_are_refused_with_their_place(values, message):
    with pytest.raises(UserError) as caught:
        config_from({"data": {"path": "."}, **values}, "x.yml")
    assert str(caught.value).startswith(f"x.yml: {message}") and "\n" not in str(caught.value)


def test_strategy_provides_the_defaults_of_its_schedule(examples, monkeypatch):
    values = {"data": {"path": "."}, "iterations": 1000, "densify": {"strategy": "halving"}}
    for expected in ((50, 500), (250, 800)):
        densify = config_from(values, "x.yml").densify
        assert (densify.start, densify.stop) == expected
        monkeypatch.setattr(examples["halving"].Halving, "start_share", 0.25)
        monkeypatch.setattr(examples["halving"].Halving, "stop_share", 0.8)


def make_trainer():
    return fits.Trainer(configured(), fits.plain_dataset(), fits.disturbed_blobs())


def test_fit_uses_configured_extensions_and_resumes_to_the_same_bytes():
    fits.assert_resumes_to_the_same_bytes(make_trainer, 5, 3)
    trainer = make_trainer()
    start, (effect,) = trainer.num_gaussians, trainer.effects
    assert type(trainer.density).__name__ == "Halving" and effect.name == "vignetting"
    reports = [trainer.step() for _ in range(8)]
    assert trainer.num_gaussians == start - start // 2
    assert [bool(report.density) for report in reports] == [False] * 5 + [True] + [False] * 2
    assert float(effect.state()["strength.value"][0, 0]) != 0


def test_numbers_of_an_effect_are_written_beside_the_results(tmp_path, monkeypatch):
    """Numbers of all views are there once, those of each view by its name."""
    trainer = make_trainer()
    (effect,), views = trainer.effects, trainer.dataset.train
    effect.write(tmp_path, trainer.dataset)
    strength = json.loads((tmp_path / "vignetting.json").read_text())
    assert strength == {"strength": [float(effect.state()["strength.value"][0, 0])]}
    rows = np.arange(2.0 * len(views)).reshape(-1, 2)
    each = OptimisedEffect({"gain": rows}, {"gain": 0.1})
    monkeypatch.setattr(OptimisedEffect, "name", "gains")
    each.write(tmp_path, trainer.dataset)
    written = json.loads((tmp_path / "gains.json").read_text())
    assert written == {"gain": {v.name: list(row) for v, row in zip(views, rows, strict=True)}}
    assert "vignetting.json" in result_names()


def test_loss_and_its_term_match_numpy(examples):
    rng = np.random.default_rng(0)
    image, photograph = rng.uniform(size=(2, 5, 7, 3)).astype(np.float32)
    loss = examples["charbonnier"].Charbonnier(examples["charbonnier"].CharbonnierSection())
    target = prepare_target(mi.TensorXf(photograph))
    found, error = loss.with_squared_error(mi.TensorXf(image), target)
    difference = image.astype(np.float64) - photograph
    distance = np.sqrt(difference**2 + 1e-4)
    assert float(found[0]) == pytest.approx((distance - 0.01).mean(), rel=1e-5)
    assert float(error[0]) == pytest.approx((difference**2).mean(), rel=1e-5)
    inputs = fits.plain_dataset(), fits.disturbed_blobs()
    plain, heavy = (
        fits.Trainer(configured(binary_opacity={"weight": weight}), *inputs).step().loss
        for weight in (0.0, 2.0)
    )
    opacities = 1 / (1 + np.exp(-inputs[1].logit_opacities.astype(np.float64)))
    assert heavy - plain == pytest.approx(2 * (opacities * (1 - opacities)).mean(), rel=1e-4)


def test_effect_applies_depending_on_the_dataset(examples, monkeypatch):
    needs = lambda config, dataset: any(view.depth is not None for view in dataset.train)  # noqa: E731
    monkeypatch.setattr(examples["vignetting"].Vignetting, "is_used", needs)
    for dataset, used in ((fits.plain_dataset(), []), (fits.true_dataset(), ["vignetting"])):
        effects = training_effects(configured(), dataset)
        assert [effect.name for effect in effects if effect.name != "depth"] == used


def test_errors_of_an_extension_are_reported_with_its_name(examples, monkeypatch):
    module = examples["vignetting"]
    exec("def adjust(self, image, view):\n    raise KeyError('oh')\n", vars(module))
    monkeypatch.setattr(module.Vignetting, "adjust", module.adjust)
    match = r"^effect \"vignetting\" \(vignetting\): KeyError: 'oh', at <string>:2$"
    with pytest.raises(UserError, match=match):
        drgs.train(configured(), fits.plain_dataset())


MODULE = """
from drgs.config.extensions import STRATEGIES
from drgs.io.formats import FORMATS, FileFormat
from drgs.training.density.strategy import DensityStrategy

@FORMATS.register("aformat")
class AFormat(FileFormat):
    suffix, description = ".aformat", "a format"

@STRATEGIES.register("zstrategy")
class ZStrategy(DensityStrategy):
    def is_due(self, iteration):
        return iteration == 2
    def refine(self, population, iteration):
        return population.no_such_method()
"""


def test_of_a_module_with_two_extensions_the_right_one_is_named(tmp_path):
    """Also what registered later, and file and line; ``--traceback`` prints all of it."""
    (tmp_path / "two.py").write_text(MODULE)
    info = tmp_path / "two-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: two\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[drgs]\ntwo = two\n")
    project = write_project(tmp_path / "project", densify={"strategy": "zstrategy"})
    path = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    command = [sys.executable, "-m", "drgs.fit", str(project), "--out", str(tmp_path / "out")]
    for more in ([], ["--overwrite", "--traceback"]):
        done = subprocess.run(
            [*command, *more], env=os.environ | path, capture_output=True, text=True
        )
        expected = 'error: density strategy "zstrategy" (two): AttributeError'
        assert done.returncode == 2 and expected in done.stderr, done.stderr
        assert f"{tmp_path / 'two.py'}:15" in done.stderr
        assert ("Traceback" in done.stderr) == bool(more)


def test_summary_and_help_list_extensions():
    text = format_effects(summary_of_fit(configured(), fits.plain_dataset()))
    assert "vignetting: effect: Renderings are darkened" in text and "(vignetting)" in text
    assert "halving: density strategy: Keeps the more" in text
    assert "(densify.strategy: halving)" in text
    parser = CommandParser(prog="drgs fit")
    add_arguments(parser)
    text = " ".join(parser.format_help().split())
    assert "installed extensions:" in text
    assert "loss term binary_opacity: The mean of o (1 - o)" in text
