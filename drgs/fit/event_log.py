"""The history of a fit as TensorBoard reads it, written as the fit goes.

tensorboardX's ``SummaryWriter`` names files after the time and the
host, and writes them from a thread; the file of a fit has one name, and is complete after each row.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]  # made at import
from tensorboardX.record_writer import RecordWriter
from tensorboardX.summary import scalar
from typing_extensions import override

from drgs.fit.loop import History, Iteration, Observer
from drgs.results.history import HistoryRow
from drgs.training.trainer import Trainer

TAGS = {
    "loss": "loss",
    "psnr": "PSNR/training_view",
    "test_psnr": "PSNR/test_views",
    "num_gaussians": "Gaussians",
    "means_lr": "learning_rate/means",
}
"""Names of curves by column of ``history.csv``."""


class EventLog(Observer):
    """Writes the history's rows, existing ones first: a fit that was resumed is one curve."""

    def __init__(self, path: Path, history: History) -> None:
        """path: is replaced."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = RecordWriter(str(path.absolute()))
        version = Event(wall_time=time.time(), file_version="brain.Event:2")
        self._writer.write(version.SerializeToString())
        for row in history.rows:
            self._write(row, history)
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()

    @override
    def after_iteration(
        self, trainer: Trainer, history: History, done: Iteration, stops: Callable[[], bool]
    ) -> None:
        """Write the last row, if the iteration has one; the history's clock is paused."""
        if done.row is not None:
            start = time.perf_counter()
            self._write(history.rows[-1], history)  # with the latest measurements
            self._writer.flush()
            history.leave_out(time.perf_counter() - start)

    def _write(self, row: HistoryRow, history: History) -> None:
        at = time.time() - (history.wall_s - row.wall_s)
        for column, tag in TAGS.items():
            if (value := getattr(row, column)) is not None:
                summary = scalar(tag, float(value))
                event = Event(wall_time=at, step=row.iteration, summary=summary)
                self._writer.write(event.SerializeToString())
