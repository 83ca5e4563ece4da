"""Whether the arrays of a checkpoint are the state of a fit: a file may be damaged, or edited.

Compared with what the trainer that is to continue has at its start: the same arrays of the same
types and shapes, but for the number of Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

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


def check_tables(history: np.ndarray, density: np.ndarray | None, wall_s: float) -> None:
    """Raise ValueError unless these can be the tables of a fit, and the seconds it took."""
    _check_table("history", history, HISTORY_COLUMNS, np.dtype(np.float64))
    if not np.isfinite(history[:, : HISTORY_COLUMNS[0]]).all():
        raise ValueError("history must hold finite numbers")
    if density is not None:
        _check_table("density", density, (len(DENSITY_COLUMNS),), np.dtype(np.int64))
        if (density < 0).any():
            raise ValueError("density must hold counts, got a negative number")
    if not 0 <= wall_s < math.inf:
        raise ValueError(f"wall_s must be a number of seconds, got {wall_s:g}")


def _check_table(name: str, rows: np.ndarray, widths: Sequence[int], dtype: np.dtype) -> None:
    if rows.ndim != 2 or rows.shape[1] not in widths or rows.dtype != dtype:
        raise ValueError(
            f"{name} must be rows of {widths[-1]} {dtype} numbers, got shape {rows.shape} of "
            f"{rows.dtype}"
        )


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
