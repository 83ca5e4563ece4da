"""Checkpoints: a fit that was stopped continues to the bytes that it would have given.

One file, ``checkpoint.npz``: the trainer's state, the history so far, the seconds spent, and the
configuration that it belongs to. It is written whole or not at all.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drgs.config.load import dump_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.core.files import atomic_path
from drgs.results.files import CHECKPOINT, CONFIG


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """What a fit has to know of its past."""

    trainer: dict[str, np.ndarray]  # Trainer.state()
    history: np.ndarray  # (rows, columns) float64: the rows of history.csv
    wall_s: float  # seconds spent on iterations


def save_checkpoint(folder: Path, config: FitConfig, checkpoint: Checkpoint) -> None:
    """Write or replace the checkpoint of the output folder ``folder``, and its ``config.yml``.

    The configuration's end may have changed. Both files change together: one that does not belong
    to the other could not be continued.
    """
    arrays = {f"trainer.{name}": values for name, values in checkpoint.trainer.items()}
    with atomic_path(folder / CHECKPOINT) as temporary:
        np.savez(
            temporary,
            config=np.array(_fingerprint(config)),
            history=checkpoint.history,
            wall_s=np.array(checkpoint.wall_s),
            **arrays,
        )
        dump_config(config, folder / CONFIG)


def load_checkpoint(folder: Path, config: FitConfig) -> Checkpoint | None:
    """The checkpoint of ``folder``, or None if there is none yet.

    Raises UserError if the file is damaged or belongs to another configuration.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    remedy = f"remove {path} to start again from iteration 0"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        fingerprint, history = str(arrays.pop("config")), arrays.pop("history")
        wall_s = float(arrays.pop("wall_s"))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: not a readable checkpoint ({error}); {remedy}") from None
    if fingerprint != _fingerprint(config):
        raise UserError(
            f"{path}: belongs to another configuration than {folder / CONFIG}; {remedy}"
        )
    trainer = {name.removeprefix("trainer."): values for name, values in arrays.items()}
    return Checkpoint(trainer=trainer, history=history, wall_s=wall_s)


def remove_checkpoint(folder: Path) -> None:
    """A finished fit needs none."""
    (folder / CHECKPOINT).unlink(missing_ok=True)


def _fingerprint(config: FitConfig) -> str:
    """Every value but where the output goes and how often it is written."""
    return json.dumps(config.model_dump(mode="json", exclude={"output"}), sort_keys=True)
