"""Checkpoints of versions whose configuration had fewer values, or left fewer to the data."""

import json

import mitsuba as mi
import numpy as np
import pytest
from support.trainers import make_trainer

from drgs.config.changes import changed
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from drgs.training.history import History
from drgs.training.state_checks import check_state

DECIDED = {"data.background": "white", "model.near": 0.2}


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "out").mkdir()
    return tmp_path / "out"


@pytest.fixture
def config(tmp_path):
    return changed(
        FitConfig(data={"path": tmp_path}, densify={"strategy": "adc"}, iterations=7000), DECIDED
    )


def saved_as(folder, config, change):
    """The checkpoint of ``config``, whose words about it are changed."""
    save_checkpoint(
        folder, config, Checkpoint({"iteration": np.array(3)}, History().as_array(), 0.0)
    )
    with np.load(folder / "checkpoint.npz") as file:
        arrays = dict(file)
    del arrays["config_before"]  # which no earlier version wrote
    values = json.loads(str(arrays["config"]))
    change(values)
    arrays["config"] = np.array(json.dumps(values, sort_keys=True))
    np.savez(folder / "checkpoint.npz", **arrays)


def without_what_is_new(values):
    del values["data"]["ignore_points"], values["init"]["start"], values["init"]["scale"]
    for name in ("decay", "decay_from", "views", "views_from"):
        del values["optimizer"][name]
    densify = values["densify"]
    kept = ("strategy", "start", "stop", "every", "max_gaussians", "adc")
    values["densify"] = {name: densify[name] for name in kept}


def test_a_checkpoint_of_an_earlier_version_goes_on(folder, config):
    saved_as(folder, config, without_what_is_new)
    assert int(load_checkpoint(folder, config).trainer["iteration"]) == 3


def test_statistics_of_an_earlier_version_are_those_of_adc(folder):
    """Whose names stood among those of the optimizer."""
    densify = {"strategy": "adc", "start": 2, "every": 6, "adc": {"grad_threshold": 1e-6}}
    trainer = make_trainer(densify=densify)
    for _ in range(4):
        trainer.step()
    state = trainer.state()
    earlier = {name.removeprefix("density/"): values for name, values in state.items()}
    assert {"gradient_norms", "views"} < set(earlier)
    history = History().as_array()
    save_checkpoint(folder, trainer.config, Checkpoint(earlier, history, 0.0))
    read = load_checkpoint(folder, trainer.config).trainer
    assert {k: v.tobytes() for k, v in read.items()} == {k: v.tobytes() for k, v in state.items()}
    resumed = make_trainer(densify=densify)
    check_state(read, resumed.state(), 50, 1000)
    resumed.restore(read)
    assert resumed.step().loss == trainer.step().loss
    assert resumed.step().density == trainer.step().density is not None


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [("model", "near", 0.1), ("data", "background", "black"), ("densify", "stop", 15_000)],
)
def test_one_of_other_values_does_not(folder, config, section, key, value):
    def change(values):
        without_what_is_new(values)
        values[section][key] = value

    saved_as(folder, config, change)
    with pytest.raises(UserError, match="belongs to another configuration"):
        load_checkpoint(folder, config)
