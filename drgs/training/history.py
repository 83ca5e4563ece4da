"""What a fit writes down as it goes."""

from __future__ import annotations

import csv
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drgs.core.files import atomic_path
from drgs.training.trainer import StepReport


@dataclass(frozen=True)
class HistoryRow:
    """One line of ``history.csv``."""

    iteration: int
    loss: float
    psnr: float  # dB, of the iteration's training view
    num_gaussians: int
    means_lr: float
    wall_s: float  # since the first iteration
    test_psnr: float | None = None  # dB, mean of some test views; None: not measured here


class History:
    """Rows of ``history.csv`` and the time spent, also before an interruption."""

    def __init__(self) -> None:
        self.rows: list[HistoryRow] = []
        self._before = 0.0
        self._started = time.perf_counter()

    @staticmethod
    def from_array(rows: np.ndarray, wall_s: float) -> History:
        """What :meth:`as_array` gave; the clock goes on from ``wall_s``.

        Rows of earlier versions have no PSNR of test views, and one column less.
        """
        history = History()
        for i, loss, psnr, n, lr, at, *more in rows:
            test_psnr = None if not more or math.isnan(more[0]) else float(more[0])
            history.rows.append(HistoryRow(int(i), loss, psnr, int(n), lr, at, test_psnr))
        history._before = wall_s
        return history

    def as_array(self) -> np.ndarray:
        """(rows, columns) float64; NaN where nothing was measured."""
        columns = len(HistoryRow.__dataclass_fields__)
        return np.array([tuple(vars(r).values()) for r in self.rows], float).reshape(-1, columns)

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

    def add_test_psnr(self, psnr: float, seconds: float) -> None:
        """Note what the last row's Gaussians reach on test views, in dB.

        seconds: what measuring took, which is no part of the fit.
        """
        self.rows[-1] = replace(self.rows[-1], test_psnr=psnr)
        self._started += seconds


def write_history(path: Path, history: list[HistoryRow]) -> None:
    """Write ``history.csv``."""
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(HistoryRow.__dataclass_fields__)
        for row in history:
            writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in vars(row).values()])
