"""The iterations of a fit and its history, for command and library."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import accumulate
from typing import Protocol

import numpy as np
from typing_extensions import override

from drgs.config.changes import with_changes
from drgs.datasets.types import View, evenly_spaced
from drgs.results.history import DENSITY_COLUMNS, DensityReport, DensityRow, HistoryRow
from drgs.results.metrics import psnr
from drgs.training.trainer import StepReport, Trainer

PSNR_SMOOTHING = 0.9  # weight of the past in the PSNR of training views

MAX_MEASURED_VIEWS = 8  # test views that are measured on the way, spread over all of them

NUM_MEASUREMENTS, MIN_ITERATIONS_BETWEEN = 10, 100
"""About how often a fit is measured, and the fewest iterations between two measurements."""


@dataclass(eq=False)
class History:
    """The tables of a fit that runs, and the time spent, also before an interruption."""

    rows: list[HistoryRow] = field(default_factory=list)
    density: list[DensityRow] = field(default_factory=list)
    _before: float = 0.0
    _started: float = field(default_factory=lambda: time.perf_counter())

    @staticmethod
    def from_arrays(rows: np.ndarray, density: np.ndarray, wall_s: float) -> History:
        """Return the inverse of :meth:`arrays`; the clock continues from ``wall_s``."""
        history = History(_before=wall_s)
        for i, loss, view_psnr, n, lr, at, test_psnr in rows:
            measured = None if math.isnan(test_psnr) else float(test_psnr)
            history.rows.append(HistoryRow(int(i), loss, view_psnr, int(n), lr, at, measured))
        for row in density.tolist():
            history.density.append(DensityRow(**dict(zip(DENSITY_COLUMNS, row, strict=True))))
        return history

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of both tables: float64, NaN where nothing was measured; and int64."""
        columns = len(HistoryRow.__dataclass_fields__)
        rows = np.array([tuple(vars(r).values()) for r in self.rows], float).reshape(-1, columns)
        density = [[getattr(row, name) for name in DENSITY_COLUMNS] for row in self.density]
        return rows, np.array(density, np.int64).reshape(-1, len(DENSITY_COLUMNS))

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

    def leave_out(self, seconds: float) -> None:
        """Subtract time since the last row that was no part of the fit."""
        self._started += seconds


def smoother(past: float | None, value: float) -> float:
    """Return the next value of a smooth line, given the one before it (None: there is none)."""
    return value if past is None else PSNR_SMOOTHING * past + (1 - PSNR_SMOOTHING) * value


def exponential_mean(values: Iterable[float]) -> np.ndarray:
    """Return the exponential mean of the past, (n,) float64."""
    return np.fromiter(accumulate(values, smoother), np.float64)


Continues = Callable[[Trainer], bool]
"""Returns whether a fit runs another step; all ranks call it."""


def until_planned_end(trainer: Trainer) -> bool:
    """Return whether the iterations of the configuration are not done yet."""
    return trainer.iteration < trainer.config.last_iteration


@dataclass(frozen=True)
class Iteration:
    """A finished step, of one iteration or several."""

    trainer: Trainer
    history: History
    report: StepReport
    row: HistoryRow | None  # of the history, where this iteration is written down
    is_last: bool


class Observer(Protocol):
    """An observer of a running fit, without influence on its bytes."""

    def after_iteration(self, done: Iteration, stops: Callable[[], bool]) -> None:
        """Called after an iteration, by the thread that fits.

        stops: whether the fit is to stop at once; an observer that waits has to call it.
        """


def iterations(
    trainer: Trainer, history: History, continues: Continues = until_planned_end
) -> Iterator[Iteration]:
    """Run the remaining iterations: a generator, one step an item.

    Rows are added to ``history`` every ``output.history_every`` iterations, and for the last one.
    There, and at changes of the population, ``NonFiniteError`` is raised if a loss, a gradient or a
    value is not finite.
    """
    is_last = _is_last(trainer, continues)
    while not is_last:
        report, row = trainer.step(), None
        if report.density is not None:
            history.add_density(report.iteration, report.density)
        is_last = _is_last(trainer, continues)
        if is_last or report.passes(trainer.config.output.history_every):
            row = history.add(report)
            trainer.check_iterations()  # reading the row has waited for the device
        yield Iteration(trainer, history, report, row, is_last)


def _is_last(trainer: Trainer, continues: Continues) -> bool:
    """Return whether a fit ends; one that ends otherwise than planned records where."""
    is_last, config = not continues(trainer), trainer.config
    if is_last and trainer.iteration != config.last_iteration:
        trainer.config = with_changes(config, {"stop_after": trainer.iteration})
    return is_last


class HeldOutQuality(Observer):
    """Measures the PSNR of a few test views on the way, for the curve of the report."""

    def __init__(self, views: Sequence[View]) -> None:
        """views: test views; none on other ranks than 0."""
        self._views = evenly_spaced(views, MAX_MEASURED_VIEWS)

    @override
    def after_iteration(self, done: Iteration, stops: Callable[[], bool]) -> None:
        config = done.trainer.config
        is_row = done.row is not None and config.output.report
        if is_row and (done.is_last or measurement_is_due(done.history.rows, config.iterations)):
            self.measure(done.trainer, done.history)

    def measure(self, trainer: Trainer, history: History) -> None:
        """Add the mean PSNR to the last row of the history; its clock is paused meanwhile."""
        start = time.perf_counter()
        trainer.sync_scene()
        pairs = zip(trainer.images(self._views), self._views, strict=True)
        scores = [psnr(image, view.image, view.mask) for image, view in pairs]
        mean = np.mean(scores) if scores else np.nan
        test_psnr = float(trainer.comm.broadcast_numbers(mean))
        history.rows[-1] = replace(history.rows[-1], test_psnr=test_psnr)
        history.leave_out(time.perf_counter() - start)


def measurement_is_due(rows: Sequence[HistoryRow], iterations: int) -> bool:
    """Return whether the last of ``rows`` is to be measured; iterations: of the whole fit."""
    before = max((row.iteration for row in rows if row.test_psnr is not None), default=0)
    every = max(MIN_ITERATIONS_BETWEEN, iterations // NUM_MEASUREMENTS)
    return rows[-1].iteration - before >= every
