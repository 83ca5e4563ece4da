"""Whether the arrays of a checkpoint are the state of a fit: a file may be damaged, or edited.

Compared with what the trainer that is to continue has at its start: the same arrays of the same
types and shapes, but for the number of Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from drgs.core.errors import listed
from drgs.results.history import DENSITY_COLUMNS

MEANS = "means.value"
"""The array that says how many Gaussians there are."""

DENSITY = "density/"
"""How names of the strategy's state begin: a row for each Gaussian, or single numbers."""

FILTER = "smoothing/filter"
"""Of an effect, with a number for each Gaussian; a trainer has none at its start."""

HISTORY_COLUMNS = (6, 7)
"""Those of earlier versions, and of this one; PSNR of test views, the last, may be NaN."""


def check_state(
    state: Mapping[str, np.ndarray],
    like: Mapping[str, np.ndarray],
    iterations: int,
    max_gaussians: int,
) -> None:
    """Raise ValueError with the first thing that is wrong with ``Trainer.state()`` of a file.

    like: that of the trainer at its start; iterations, max_gaussians: of the configuration.
    """
    if missing := [name for name in like if name not in state]:
        raise ValueError(f"{listed(missing)} missing")
    shape = state[MEANS].shape
    num = shape[0] if shape else 0
    if not 1 <= num <= max_gaussians:
        raise ValueError(f"must hold 1 to {max_gaussians:,} Gaussians, got {num:,}")
    expected = {name: (_shape(name, like, num), array.dtype) for name, array in like.items()}
    expected[FILTER] = (num,), np.dtype(np.float32)
    values = [name for name in like if name.endswith(".value")]
    expected |= {name.replace(".value", ".gradient"): expected[name] for name in values}
    for name in filter(expected.__contains__, state):
        _check_array(name, state[name], *expected[name])
    iteration = int(state["iteration"])
    if not 0 <= iteration <= iterations:
        raise ValueError(f"iteration must be between 0 and {iterations:,}, got {iteration:,}")


def check_history(rows: np.ndarray, wall_s: float) -> None:
    """Raise ValueError where these cannot be the history of a fit, and the seconds it took."""
    if rows.ndim != 2 or rows.shape[1] not in HISTORY_COLUMNS or rows.dtype != np.float64:
        raise ValueError(
            f"history must be rows of {HISTORY_COLUMNS[-1]} float64 numbers, got shape "
            f"{rows.shape} of {rows.dtype}"
        )
    if not np.isfinite(rows[:, : HISTORY_COLUMNS[0]]).all():
        raise ValueError("history must hold finite numbers")
    if not 0 <= wall_s < math.inf:
        raise ValueError(f"wall_s must be a number of seconds, got {wall_s:g}")


def check_density(rows: np.ndarray) -> None:
    """Raise ValueError where these cannot be changes of a population."""
    columns = len(DENSITY_COLUMNS)
    if rows.ndim != 2 or rows.shape[1] != columns or rows.dtype != np.int64:
        raise ValueError(
            f"density must be rows of {columns} int64 numbers, got shape {rows.shape} of "
            f"{rows.dtype}"
        )
    if (rows < 0).any():
        raise ValueError("density must hold counts, got a negative number")


def _shape(name: str, like: Mapping[str, np.ndarray], num: int) -> tuple[int, ...]:
    """Of an array of the state with ``num`` Gaussians; moments are flat, with several for each."""
    shape = like[name].shape
    of_effect = "/" in name and not name.startswith(DENSITY)
    belongs_to_gaussians = shape and not of_effect and not name.endswith(".t")
    if not belongs_to_gaussians:
        return shape
    return (shape[0] // like[MEANS].shape[0] * num, *shape[1:])


def _check_array(name: str, array: np.ndarray, shape: tuple[int, ...], dtype: np.dtype) -> None:
    if array.shape != shape or array.dtype != dtype:
        raise ValueError(
            f"{name} must be of shape {shape} and type {dtype}, got {array.shape} of {array.dtype}"
        )
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must hold finite numbers")
