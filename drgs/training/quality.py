"""How well a fit does on the way: PSNR of a few test views, for the curve of the report.

The fit does not depend on it: it gives the same bytes whether it is measured or not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from drgs.datasets.types import View
from drgs.results.metrics import psnr
from drgs.training.history import History, HistoryRow
from drgs.training.loop import Iteration
from drgs.training.trainer import Trainer

NUM_VIEWS = 8
"""Test views that are measured, spread over all of them: a fit with hundreds does not wait."""

TIMES = 10
"""How often a fit is measured, about."""

MIN_ITERATIONS = 100
"""Between two measurements, at least."""


class HeldOutQuality:
    """Measures some of the test views for the report: see :class:`drgs.training.loop.Observer`."""

    def __init__(self, views: Sequence[View]) -> None:
        """views: those of the test split; none on other ranks than 0."""
        self._views = measured_views(views)

    def after(
        self, trainer: Trainer, history: History, done: Iteration, stops: Callable[[], bool]
    ) -> None:
        """Measure where that is due, if there is to be a report."""
        del stops
        config = trainer.config
        if done.row is None or not config.output.report:
            return
        if measurement_is_due(history.rows, config.iterations):
            self.measure(trainer, history)

    def measure(self, trainer: Trainer, history: History) -> None:
        """Add the mean PSNR to the last row of the history, which is of this moment."""
        start = time.perf_counter()
        trainer.sync_scene()
        pairs = zip(trainer.images(self._views), self._views, strict=True)
        scores = [psnr(image, view.image, view.mask) for image, view in pairs]
        mean = trainer.comm.of_root(np.mean(scores) if scores else np.nan)
        history.add_test_psnr(float(mean), time.perf_counter() - start)


def measured_views(views: Sequence[View]) -> tuple[View, ...]:
    """Return at most :data:`NUM_VIEWS` of the views, evenly spread."""
    chosen = np.linspace(0, len(views) - 1, min(NUM_VIEWS, len(views))).round().astype(int)
    return tuple(views[index] for index in chosen)


def measurement_is_due(rows: Sequence[HistoryRow], iterations: int) -> bool:
    """Return whether the last of ``rows`` is to be measured; iterations: of the whole fit."""
    last = rows[-1].iteration
    before = max((row.iteration for row in rows if row.test_psnr is not None), default=0)
    return last >= iterations or last - before >= max(MIN_ITERATIONS, iterations // TIMES)
