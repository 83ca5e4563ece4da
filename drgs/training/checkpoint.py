"""Checkpoints: a fit that was stopped continues to the bytes that it would have given.

One file, ``checkpoint.npz``: the trainer's state, the history so far, the seconds spent, the
configuration that it belongs to, and what the data was. It is written whole or not at all.
``config.yml`` follows it: a plan that is revised changes the configuration, and a process may end
between the two files. So the checkpoint says which configuration stood there before, too.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drgs.config.changes import changed, decided_as
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError, UserNote, listed, one_line
from drgs.core.files import atomic_path, read_arrays, why_refused
from drgs.datasets.fingerprint import Fingerprint
from drgs.results.files import CHECKPOINT, CONFIG
from drgs.results.folder import load_run_config, write_run_config
from drgs.training.state_checks import check_state, check_tables

PLACES = ("data.path", "data.source", "init.point_cloud")
"""Values that say where something is: a project that was moved has others. The start point is
needed no more; what the data is has a fingerprint."""


EARLIER_NAMES = {"gradient_norms": "density/gradient_norms", "views": "density/views"}
"""Of the trainer's state, in files of earlier versions."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """What a fit has to know of its past."""

    trainer: dict[str, np.ndarray]  # Trainer.state()
    history: np.ndarray  # (rows, columns) float64: the rows of history.csv
    wall_s: float  # seconds spent on iterations
    data: Fingerprint | None = None  # None: of an earlier version, which kept none
    density: np.ndarray | None = None  # (changes, columns) int64, of density.csv; None: the same
    config: FitConfig | None = None  # of the file that it was read from


def save_checkpoint(folder: Path, config: FitConfig, checkpoint: Checkpoint) -> None:
    """Write or replace the checkpoint of the output folder ``folder``, and then its ``config.yml``.

    The configuration's end may have changed since ``config.yml`` was written.
    """
    try:
        before = load_run_config(folder)
    except UserError:  # there is none, or somebody is just editing it
        before = config
    arrays = {f"trainer.{name}": values for name, values in checkpoint.trainer.items()}
    if checkpoint.data is not None:
        arrays["data"] = np.frombuffer(checkpoint.data.to_bytes(), np.uint8)
    if checkpoint.density is not None:
        arrays["density"] = checkpoint.density
    with atomic_path(folder / CHECKPOINT) as temporary:
        np.savez(
            temporary,
            config=np.array(_as_text(config)),
            config_before=np.array(_as_text(before)),
            history=checkpoint.history,
            wall_s=np.array(checkpoint.wall_s),
            **arrays,
        )
    if before != config or not (folder / CONFIG).is_file():
        write_run_config(folder, config)


def load_checkpoint(folder: Path, config: FitConfig) -> Checkpoint | None:
    """The checkpoint of ``folder``, or None if there is none yet.

    config: that of the run; where the plan had just been revised, the checkpoint's is the later.

    Raises UserError if the file is damaged or belongs to another configuration.
    """
    path = folder / CHECKPOINT
    if not os.path.lexists(path):
        return None
    try:
        arrays = read_arrays(path, "checkpoint")
        texts = [arrays.pop("config"), arrays.pop("config_before", None)]
        own, *before = (
            _at_the_places_of(config, json.loads(str(t))) for t in texts if t is not None
        )
        data = arrays.pop("data", None)
        checkpoint = Checkpoint(
            history=arrays.pop("history"),
            wall_s=float(arrays.pop("wall_s")),
            density=arrays.pop("density", None),
            data=None if data is None else Fingerprint.from_bytes(data.tobytes()),
            config=own,
            trainer=_named_as_now(arrays),
        )
        check_tables(checkpoint.history, checkpoint.density, checkpoint.wall_s)
    except UserError as error:
        raise UserError(f"{error}; {_remedy(path)}") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise _damaged(path, error) from None
    if not any(_says_the_same(config, earlier) for earlier in (own, *before)):
        raise UserError(
            f"{path}: belongs to another configuration than {folder / CONFIG}; {_remedy(path)}"
        )
    return checkpoint


def check_fits(folder: Path, checkpoint: Checkpoint, start: Mapping[str, np.ndarray]) -> None:
    """Raise UserError where a trainer cannot go on from the checkpoint in ``folder``.

    start: ``Trainer.state()`` of that trainer before its first iteration.
    """
    config = checkpoint.config
    try:
        check_state(checkpoint.trainer, start, config.iterations, config.densify.max_gaussians)
    except ValueError as error:
        raise _damaged(folder / CHECKPOINT, error) from None


def _named_as_now(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The trainer's state among the arrays of a file."""
    names = {name: name.removeprefix("trainer.") for name in arrays}
    return {EARLIER_NAMES.get(names[name], names[name]): array for name, array in arrays.items()}


def _damaged(path: Path, error: Exception) -> UserError:
    reason = f"{error.args[0]} missing" if isinstance(error, KeyError) else one_line(error)
    return UserError(f"{path}: the checkpoint is damaged: {reason}; {_remedy(path)}")


def _remedy(path: Path) -> str:
    return f"remove {path} to start again from iteration 0"


def check_same_data(
    folder: Path, where: Path, before: Fingerprint | None, now: Fingerprint
) -> None:
    """Raise UserError where the data of the checkpoint in ``folder`` is not what it is ``now``.

    where: the dataset's folder. before: of the checkpoint; None: it has none, which is noted.
    """
    if before is None:
        note = f"{folder / CHECKPOINT}: of a version that kept no record of the data: not compared"
        warnings.warn(UserNote(note), stacklevel=2)
    elif differences := before.differences(now):
        raise UserError(
            f"{folder / CHECKPOINT}: belongs to other data than {where}: {listed(differences)}; "
            f"give the folder with the data of this fit (--data), or remove {folder / CHECKPOINT} "
            "to start again from iteration 0"
        )


def remove_checkpoint(folder: Path) -> None:
    """A finished fit needs none.

    Raises :class:`UserError` where the file system refuses.
    """
    path = folder / CHECKPOINT
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot be removed: {why_refused(error)}") from None


def _says_the_same(config: FitConfig, earlier: FitConfig) -> bool:
    """What one of them leaves to the dataset, the other has from there."""
    return decided_as(config, earlier) == decided_as(earlier, config)


def _as_text(config: FitConfig) -> str:
    """Every value but where the output goes and how often it is written."""
    return json.dumps(config.model_dump(mode="json", exclude={"output"}), sort_keys=True)


def _at_the_places_of(config: FitConfig, values: Mapping[str, object]) -> FitConfig:
    """The configuration of a checkpoint, with the places and the section ``output`` of another."""
    output = config.output.model_dump()
    places = {}
    for key in PLACES:
        section, name = key.split(".")
        places[key] = getattr(getattr(config, section), name)
    return changed(FitConfig.model_validate({**values, "output": output}), places)
