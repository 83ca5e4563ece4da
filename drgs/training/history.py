"""What a fit writes down as it goes."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import asdict, replace
from itertools import accumulate

import numpy as np

from drgs.results.history import (
    DENSITY_COLUMNS,
    DensityReport,
    DensityRow,
    FitHistory,
    HistoryRow,
)
from drgs.training.trainer import StepReport

SMOOTHING = 0.9
"""Weight of the past in the PSNR of training views, each of which is another photograph."""


class History(FitHistory):
    """The tables of a fit that runs, and the time spent, also before an interruption."""

    def __init__(self) -> None:
        super().__init__()
        self._before = 0.0
        self._started = time.perf_counter()

    @staticmethod
    def from_array(rows: np.ndarray, wall_s: float, density: np.ndarray | None = None) -> History:
        """What :meth:`as_array` and :meth:`density_array` gave; the clock goes on from ``wall_s``.

        Rows of earlier versions have no PSNR of test views, and one column less; density: None in
        theirs.
        """
        history = History()
        history.density = [
            DensityRow(**dict(zip(DENSITY_COLUMNS, map(int, row), strict=True)))
            for row in (() if density is None else density)
        ]
        for i, loss, psnr, n, lr, at, *more in rows:
            test_psnr = None if not more or math.isnan(more[0]) else float(more[0])
            history.rows.append(HistoryRow(int(i), loss, psnr, int(n), lr, at, test_psnr))
        history._before = wall_s
        return history

    def as_array(self) -> np.ndarray:
        """(rows, columns) float64; NaN where nothing was measured."""
        columns = len(HistoryRow.__dataclass_fields__)
        return np.array([tuple(vars(r).values()) for r in self.rows], float).reshape(-1, columns)

    def density_array(self) -> np.ndarray:
        """(changes, columns) int64: the rows of ``density.csv``."""
        rows = [[getattr(row, name) for name in DENSITY_COLUMNS] for row in self.density]
        return np.array(rows, np.int64).reshape(-1, len(DENSITY_COLUMNS))

    @property
    def wall_s(self) -> float:
        """Seconds spent so far."""
        return self._before + time.perf_counter() - self._started

    def add(self, report: StepReport) -> HistoryRow:
        """Read the numbers of one iteration; waits for the device."""
        row = HistoryRow(
            iteration=report.iteration,
            loss=report.loss,
            psnr=report.psnr,
            num_gaussians=report.num_gaussians,
            means_lr=report.means_lr,
            wall_s=self.wall_s,
        )
        self.rows.append(row)
        return row

    def add_density(self, iteration: int, report: DensityReport) -> None:
        """Write down a change of the population; waits for nothing."""
        self.density.append(DensityRow(**asdict(report), iteration=iteration))

    def add_test_psnr(self, psnr: float, seconds: float) -> None:
        """Note what the last row's Gaussians reach on test views, in dB.

        seconds: what measuring took, which is no part of the fit.
        """
        self.rows[-1] = replace(self.rows[-1], test_psnr=psnr)
        self.leave_out(seconds)

    def leave_out(self, seconds: float) -> None:
        """So much of the time since the last row was no part of the fit."""
        self._started += seconds


def smoother(past: float | None, value: float) -> float:
    """The next value of a smooth line, given the one before it (None: there is none)."""
    return value if past is None else SMOOTHING * past + (1 - SMOOTHING) * value


def smoothed(values: Iterable[float]) -> np.ndarray:
    """Exponential mean of the past, (n,) float64."""
    return np.fromiter(accumulate(values, smoother), np.float64)
