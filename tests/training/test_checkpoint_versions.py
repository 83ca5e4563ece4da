"""Checkpoints of configurations with fewer values, or which leave fewer to the data."""

import json

import numpy as np
import pytest
from support.small_capture import make_dataset

from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.datasets.fingerprint import fingerprint_of
from drgs.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from drgs.training.loop import History


@pytest.fixture
def config(tmp_path):
    config = FitConfig(data={"path": tmp_path}, densify={"strategy": "adc"}, iterations=7000)
    return with_changes(config, {"data.background": "white", "model.near": 0.2})


def saved_as(folder, config, change):
    """Save a checkpoint of ``config``, and change its record of it."""
    data, state = fingerprint_of(make_dataset(1, 1)), {"iteration": np.array(3)}
    save_checkpoint(folder, config, Checkpoint(state, *History().arrays(), 0.0, data))
    with np.load(folder / "checkpoint.npz") as file:
        arrays = dict(file)
    values = json.loads(str(arrays["config"]))
    change(values)
    for name in ("config", "config_before"):
        arrays[name] = np.array(json.dumps(values, sort_keys=True))
    np.savez(folder / "checkpoint.npz", **arrays)


def remove_new_keys(values):
    del values["data"]["ignore_points"], values["init"]["start"], values["init"]["scale"]
    for name in ("decay", "decay_from", "views", "views_from"):
        del values["optimizer"][name]
    densify = values["densify"]
    kept = ("strategy", "start", "stop", "every", "max_gaussians", "adc")
    values["densify"] = {name: densify[name] for name in kept}


def test_checkpoint_of_an_earlier_version_is_continued(tmp_path, config):
    saved_as(tmp_path, config, remove_new_keys)
    assert int(load_checkpoint(tmp_path, config).trainer["iteration"]) == 3


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [("model", "near", 0.1), ("data", "background", "black"), ("densify", "stop", 15_000)],
)
def test_checkpoint_with_different_values_is_refused(tmp_path, config, section, key, value):
    def change(values):
        remove_new_keys(values)
        values[section][key] = value

    saved_as(tmp_path, config, change)
    with pytest.raises(UserError, match="belongs to another configuration"):
        load_checkpoint(tmp_path, config)
