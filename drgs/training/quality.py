"""How well a fit does on the way: PSNR of a few test views, for the curve of the report.

The fit does not depend on it: it gives the same bytes whether it is measured or not.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from drgs.datasets.types import View
from drgs.results.metrics import psnr
from drgs.training.history import History, HistoryRow
from drgs.training.trainer import Trainer

NUM_VIEWS = 8
"""Test views that are measured, spread over all of them: a fit with hundreds does not wait."""

TIMES = 10
"""How often a fit is measured, about."""

MIN_ITERATIONS = 100
"""Between two measurements, at least."""


def measured_views(views: Sequence[View]) -> tuple[View, ...]:
    """At most :data:`NUM_VIEWS` of the test views, evenly spread."""
    chosen = np.linspace(0, len(views) - 1, min(NUM_VIEWS, len(views))).round().astype(int)
    return tuple(views[index] for index in chosen)


def measurement_is_due(rows: Sequence[HistoryRow], iterations: int) -> bool:
    """Whether the last of ``rows`` is to be measured; iterations: of the whole fit."""
    last = rows[-1].iteration
    before = max((row.iteration for row in rows if row.test_psnr is not None), default=0)
    return last >= iterations or last - before >= max(MIN_ITERATIONS, iterations // TIMES)


def measure(trainer: Trainer, history: History, views: tuple[View, ...]) -> None:
    """Add the mean PSNR of ``views`` to the last row of ``history``, which is of this moment."""
    start = time.perf_counter()
    trainer.sync_scene()
    pairs = zip(trainer.images(views), views, strict=True)
    mean = np.mean([psnr(image, view.image, view.mask) for image, view in pairs])
    history.add_test_psnr(float(mean), time.perf_counter() - start)
