"""Checkpoints that are damaged are refused, and kept; those of earlier versions are continued."""

import io
import json
import os
import shutil
import zipfile

import numpy as np
import pytest
from support.fit_command import assert_fits, run_fit, stop_after, without_images, write_scene
from support.small_capture import make_dataset

from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.fit.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from drgs.fit.fingerprint import fingerprint_of
from drgs.fit.loop import History


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """The folder of a fit of 4 iterations that was stopped after the second."""
    folder = tmp_path_factory.mktemp("fit")
    write_scene(
        folder,
        model={"sh_degree": 1, "smoothing": True},
        colors={"lr": 0.02},
        cameras={"optimise": True},
        iterations=4,
        densify={"stop": 100},  # the population stays
        output={"checkpoint_every": 1, "history_every": 1},
    )
    with pytest.MonkeyPatch.context() as patch:
        stop_after(patch, 2)
        assert run_fit(folder / "a.yml", "--out", folder / "out").returncode == 130
    return folder / "out"


@pytest.fixture
def checkpoint(stopped, tmp_path):
    """The checkpoint of a copy of that folder."""
    shutil.copytree(stopped, tmp_path / "out")
    return tmp_path / "out" / "checkpoint.npz"


def edit(name, change):
    """Return a damage: ``change`` of one array; None removes it."""

    def apply(checkpoint):
        with np.load(checkpoint) as file:
            arrays = dict(file)
        changed = change(arrays.pop(name))
        if changed is not None:
            arrays[name] = changed
        np.savez(checkpoint, **arrays)

    return apply


def spoil(name, value):
    """Return a damage: the last number of an array is another."""

    def change(array):
        array = array.copy()
        array.reshape(-1)[-1:] = value
        return array

    return edit(f"trainer.{name}", change)


def with_header(shape):
    """Return a damage: the file holds one array, with such a header and nothing after it."""

    def apply(checkpoint):
        stream = io.BytesIO()
        header = {"descr": "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(stream, header)
        with zipfile.ZipFile(checkpoint, "w") as archive:
            archive.writestr("wall_s.npy", stream.getvalue())

    return apply


def compress(checkpoint):
    with np.load(checkpoint) as file:
        np.savez_compressed(checkpoint, **file, zeros=np.zeros(10**7, np.uint8))


def as_pipe(checkpoint):
    checkpoint.unlink()
    os.mkfifo(checkpoint)


DAMAGE = {
    "means missing": (edit("trainer.means.value", lambda a: None), "means.value missing"),
    "a moment missing": (edit("trainer.sh0.v", lambda a: None), "sh0.v missing"),
    "history missing": (edit("history", lambda a: None), "history"),
    "configuration missing": (edit("config", lambda a: None), "config"),
    "of an effect missing": (edit("trainer.colors/common", lambda a: None), "colors/common mis"),
    "fewer columns": (
        edit("trainer.means.value", lambda a: a[:, :2]),
        "means.value must be of shape (40, 3) and type float32, got (40, 2)",
    ),
    "fewer rows": (edit("trainer.quats.value", lambda a: a[1:]), "quats.value must be of shape"),
    "no rows": (edit("trainer.means.value", lambda a: a[:0]), "1 to 1,000,000 Gaussians, got 0"),
    "no array": (edit("trainer.means.value", lambda a: a[0, 0]), "must be of shape"),
    "a moment of others": (edit("trainer.shN.m", lambda a: a[9:]), "shN.m must be of shape"),
    "another type": (edit("trainer.sh0.value", lambda a: a.astype("f8")), "type float32, got"),
    "text": (edit("trainer.sh0.value", lambda a: a.astype("U")), "type float32, got"),
    "fewer views": (edit("trainer.cameras/turns.value", lambda a: a[1:]), "turns.value must be"),
    "fewer filters": (edit("trainer.smoothing/filter", lambda a: a[1:]), "filter must be of shape"),
    "NaN": (spoil("means.value", np.nan), "means.value must hold finite num"),
    "infinite": (spoil("cameras/moves.m", np.inf), "moves.m must hold finite"),
    "negative iteration": (edit("trainer.iteration", lambda a: -a), "must be >= 0, got -2"),
    "several iterations": (edit("trainer.iteration", lambda a: np.array([a, a])), "iteration must"),
    "history of text": (edit("history", lambda a: a.astype("U")), "history must be of shape"),
    "history of 5 columns": (edit("history", lambda a: a[:, :5]), "must be of shape (2, 7)"),
    "NaN in the history": (edit("history", lambda a: a * np.nan), "history must hold finite"),
    "changes that are none": (
        edit("density", lambda a: a[:, :3]),
        "density must be of shape (0, 8) and type int64",
    ),
    "less than no changes": (
        edit("density", lambda a: np.full((1, a.shape[1]), -1)),
        "density and wall_s must hold counts",
    ),
    "time that is none": (edit("wall_s", lambda a: a * np.nan), "density and wall_s must hold"),
    "negative time": (edit("wall_s", lambda a: a * 0 - 1), "density and wall_s must hold"),
    "8 TB": (with_header((10**12,)), "cannot read the checkpoint"),
    "8 EB": (with_header((10**6, 10**6, 10**6)), "cannot read the checkpoint"),
    "a bomb": (compress, "its arrays are larger than the file"),
    "a pipe": (as_pipe, "must be a regular file, got a named pipe"),
    "cut off": (lambda path: os.truncate(path, 999), "cannot read the checkpoint"),
    "empty": (lambda path: path.write_bytes(b""), "cannot read the checkpoint"),
    "no numbers": (lambda path: path.write_bytes(b"hello"), "cannot read the checkpoint"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("damage", "message"), DAMAGE.values(), ids=DAMAGE)
def test_damaged_checkpoint_is_refused_and_kept(checkpoint, damage, message):
    damage(checkpoint)
    kept = checkpoint.read_bytes() if checkpoint.is_file() else None
    before = sorted(os.listdir(checkpoint.parent))
    outcome = run_fit("--resume", checkpoint.parent)
    assert outcome.returncode == 2, outcome
    assert outcome.stderr.startswith(f"error: {checkpoint}: ") and message in outcome.stderr
    assert outcome.stderr.count("\n") == 1 and len(outcome.stderr) < 700
    assert outcome.stderr.endswith(f"remove {checkpoint} to start again from iteration 0\n")
    assert sorted(os.listdir(checkpoint.parent)) == before
    assert kept is None or checkpoint.read_bytes() == kept


def test_intact_checkpoint_is_continued(checkpoint, monkeypatch):
    without_images(monkeypatch)
    assert "continues at iteration 2" in assert_fits("--resume", checkpoint.parent).stdout


@pytest.fixture
def config(tmp_path):
    config = FitConfig(data={"path": tmp_path}, densify={"strategy": "adc"}, iterations=7000)
    return with_changes(config, {"data.background": "white", "model.near": 0.2})


def saved_as(folder, config, change):
    """Save a checkpoint of ``config``, and change its record of it."""

    def changed(text):
        values = json.loads(str(text))
        change(values)
        return np.array(json.dumps(values, sort_keys=True))

    data, state = fingerprint_of(make_dataset(1, 1)), {"iteration": np.array(3)}
    save_checkpoint(folder, config, Checkpoint(state, *History().arrays(), 0.0, data))
    edit("config", changed)(folder / "checkpoint.npz")


def remove_new_keys(values):
    del values["data"]["ignore_points"], values["init"]["start"]
    for name in ("decay", "decay_from", "views", "views_from"):
        del values["optimizer"][name]
    densify = values["densify"]
    kept = ("strategy", "start", "stop", "every", "max_gaussians", "adc")
    values["densify"] = {name: densify[name] for name in kept if name in densify}


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
