"""Checkpoints: a fit that was stopped continues to the bytes that it would have given."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drgs.config.changes import with_changes, with_decisions
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError, format_names, one_line
from drgs.core.files import atomic_path, read_arrays, refusal_reason
from drgs.fit.fingerprint import Fingerprint
from drgs.results.folder import CHECKPOINT, CONFIG, write_run_config
from drgs.results.history import DENSITY_COLUMNS, HistoryRow
from drgs.training.trainer import DENSITY

PLACE_KEYS = ("data.path", "data.source", "data.in_memory", "init.point_cloud", "init.gaussians")
"""Values that differ in a project that was moved, or on another machine; the data has a
fingerprint."""

MEANS_ARRAY = "means.value"  # the array that has a row for each Gaussian

SMOOTHING_ARRAY = "smoothing/filter"
"""The array of an effect that has a number for each Gaussian; a trainer has none at its start."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The past of a fit."""

    trainer: dict[str, np.ndarray]  # Trainer.state()
    history: np.ndarray  # (rows, columns) float64: see History.arrays
    density: np.ndarray  # (changes, columns) int64
    wall_s: float  # seconds spent on iterations
    data: Fingerprint
    config: FitConfig | None = None  # of the file that it was read from


def save_checkpoint(folder: Path, config: FitConfig, checkpoint: Checkpoint) -> None:
    """Write or replace the checkpoint of an output folder, atomically, and a missing config.yml."""
    values = config.model_dump(mode="json", exclude={"output", "stop_after"})  # these may change
    arrays = {
        "config": np.array(json.dumps(values, sort_keys=True)),
        "history": checkpoint.history,
        "density": checkpoint.density,
        "wall_s": np.array(checkpoint.wall_s),
        "data": np.frombuffer(checkpoint.data.to_bytes(), np.uint8),
        **{f"trainer.{name}": values for name, values in checkpoint.trainer.items()},
    }
    with atomic_path(folder / CHECKPOINT) as temporary:
        np.savez(temporary, **arrays)  # pyright: ignore[reportArgumentType]  # allow_pickle=
    if not (folder / CONFIG).is_file():
        write_run_config(folder, config)


def load_checkpoint(folder: Path, config: FitConfig) -> Checkpoint | None:
    """Return the checkpoint of ``folder``, or None if there is none yet; config: the run's.

    Raises UserError if the file is damaged or belongs to another configuration.
    """
    path = folder / CHECKPOINT
    if not os.path.lexists(path):
        return None
    try:
        arrays = read_arrays(path, "checkpoint")
        own = _match_leaves(config, json.loads(str(arrays.pop("config"))))
        checkpoint = Checkpoint(
            history=arrays.pop("history"),
            density=arrays.pop("density"),
            wall_s=float(arrays.pop("wall_s")),
            data=Fingerprint.from_bytes(arrays.pop("data").tobytes()),
            config=own,
            trainer={name.removeprefix("trainer."): array for name, array in arrays.items()},
        )
        _check_tables(checkpoint)
    except UserError as error:
        raise UserError(f"{error}; {_remedy(path)}") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise _damaged_error(path, error) from None
    # A value that one leaves to the dataset is taken from the other.
    if with_decisions(config, own) != with_decisions(own, config):
        raise UserError(
            f"{path}: belongs to another configuration than {folder / CONFIG}; {_remedy(path)}"
        )
    return checkpoint


def check_fits(folder: Path, checkpoint: Checkpoint, start: Mapping[str, np.ndarray]) -> None:
    """Raise UserError if a trainer cannot continue from the checkpoint in ``folder``.

    start: ``Trainer.state()`` of that trainer before its first iteration; names, types and shapes
    of arrays must be the same, but for the number of Gaussians.
    """
    state, config = checkpoint.trainer, checkpoint.config
    assert config is not None, "it was read from a file"
    try:
        if missing := [name for name in start if name not in state]:
            raise ValueError(f"{format_names(missing)} missing")
        num, most = len(np.atleast_1d(state[MEANS_ARRAY])), config.densify.max_gaussians
        if not 1 <= num <= most:
            raise ValueError(f"must hold 1 to {most:,} Gaussians, got {num:,}")
        expected = {name: (_shape(name, start, num), array.dtype) for name, array in start.items()}
        expected[SMOOTHING_ARRAY] = (num,), np.dtype(np.float32)
        values = [name for name in start if name.endswith(".value")]
        expected |= {name.replace(".value", ".gradient"): expected[name] for name in values}
        for name in filter(expected.__contains__, state):
            _check_shape(name, state[name], *expected[name])
            _check_finite(name, state[name])
        iteration = int(state["iteration"])
        if iteration < 0:
            raise ValueError(f"iteration must be >= 0, got {iteration:,}")
    except ValueError as error:
        raise _damaged_error(folder / CHECKPOINT, error) from None


def check_same_data(folder: Path, where: Path, before: Fingerprint, now: Fingerprint) -> None:
    """Raise UserError if the data differ from the checkpoint's fingerprint.

    where: the dataset's folder; before: the checkpoint's fingerprint; now: the present one.
    """
    if differences := before.differences(now):
        raise UserError(
            f"{folder / CHECKPOINT}: belongs to other data than {where}: "
            f"{format_names(differences)}; give the folder with the data of this fit (--data), "
            f"or {_remedy(folder / CHECKPOINT)}"
        )


def remove_checkpoint(folder: Path) -> None:
    """Remove the checkpoint of a finished fit, or raise :class:`UserError`."""
    path = folder / CHECKPOINT
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot be removed: {refusal_reason(error)}") from None


def _damaged_error(path: Path, error: Exception) -> UserError:
    reason = f"{error.args[0]} missing" if isinstance(error, KeyError) else one_line(error)
    return UserError(f"{path}: the checkpoint is damaged: {reason}; {_remedy(path)}")


def _remedy(path: Path) -> str:
    return f"remove {path} to start again from iteration 0"


def _match_leaves(config: FitConfig, values: Mapping[str, object]) -> FitConfig:
    """Return a checkpoint's configuration, with places, ``output`` and the end of another."""
    places = {}
    for key in PLACE_KEYS:
        section, name = key.split(".")
        places[key] = getattr(getattr(config, section), name)
    others = {"output": config.output.model_dump(), "stop_after": config.stop_after}
    return with_changes(FitConfig.model_validate({**values, **others}), places)


def _shape(name: str, start: Mapping[str, np.ndarray], num: int) -> tuple[int, ...]:
    """Return a shape with ``num`` Gaussians; moments are flat, with several numbers for each."""
    shape = start[name].shape
    of_effect = "/" in name and not name.startswith(DENSITY)
    if not shape or of_effect or name.endswith(".t"):
        return shape
    return (shape[0] // len(start[MEANS_ARRAY]) * num, *shape[1:])


def _check_tables(checkpoint: Checkpoint) -> None:
    """Raise ValueError unless these can be the tables of a fit, and the seconds it took."""
    history, density, wall_s = checkpoint.history, checkpoint.density, checkpoint.wall_s
    columns = len(HistoryRow.__dataclass_fields__)
    _check_shape("history", history, (len(history), columns), np.dtype(np.float64))
    _check_finite("history", history[:, :-1])  # the last, PSNR of test views, may be NaN
    _check_shape("density", density, (len(density), len(DENSITY_COLUMNS)), np.dtype(np.int64))
    if (density < 0).any() or not 0 <= wall_s < math.inf:
        raise ValueError("density and wall_s must hold counts and seconds")


def _check_shape(name: str, array: np.ndarray, shape: tuple[int, ...], dtype: np.dtype) -> None:
    if array.shape != shape or array.dtype != dtype:
        raise ValueError(
            f"{name} must be of shape {shape} and type {dtype}, got {array.shape} of {array.dtype}"
        )


def _check_finite(name: str, array: np.ndarray) -> None:
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must hold finite numbers")
