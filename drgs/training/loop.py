"""The iterations of a fit: what the command and the library run alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from drgs.gaussians.parameters import Gaussians
from drgs.training.history import History, HistoryRow
from drgs.training.trainer import StepReport, Trainer


class Length(Protocol):
    """When a fit ends: see :class:`drgs.training.budget.AllIterations`."""

    def goes_on(self, trainer: Trainer) -> bool:
        """Whether there is another iteration."""

    def total(self, trainer: Trainer) -> int:
        """Iterations in all."""


@dataclass(frozen=True)
class Iteration:
    """An iteration that is done."""

    report: StepReport
    row: HistoryRow | None  # of the history, where this iteration is written down
    is_last: bool


def iterations(trainer: Trainer, history: History, length: Length) -> Iterator[Iteration]:
    """Run the iterations that are left, one each time that the next one is asked for.

    Rows are added to ``history`` every ``output.history_every`` iterations, and for the last one.

    Raises ``NonFiniteError``, at a row of the history or at a change of the population, if a loss,
    a gradient or a value is not finite.
    """
    goes_on = length.goes_on(trainer)
    while goes_on:
        report, row = trainer.step(), None
        goes_on = length.goes_on(trainer)
        if not goes_on or report.iteration % trainer.config.output.history_every == 0:
            row = history.add(report)
            trainer.watch.check()  # reading the row has waited for the device
        yield Iteration(report, row, is_last=not goes_on)


def as_saved(gaussians: Gaussians, trainer: Trainer) -> Gaussians:
    """What ``point_cloud.ply`` holds: with ``output.bake_smoothing``, the filter in the Gaussians.

    gaussians: what ``trainer.gaussians()`` gave.
    """
    if not trainer.config.output.bake_smoothing:
        return gaussians
    from drgs.effects.smoothing import baked

    return baked(gaussians)
