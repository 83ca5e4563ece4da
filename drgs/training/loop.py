"""The iterations of a fit: what the command and the library run alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from drgs.training.history import History, HistoryRow
from drgs.training.parallel.communicator import Communicator
from drgs.training.trainer import StepReport, Trainer


class StopCriterion(Protocol):
    """Decides when a fit ends."""

    def should_continue(self, trainer: Trainer) -> bool:
        """Return whether to run another iteration; may revise the trainer's configuration."""

    def num_iterations(self, trainer: Trainer) -> int:
        """The number of iterations of the whole fit, as expected now."""


class AllIterations:
    """Ends a fit after the number of iterations of its configuration."""

    def should_continue(self, trainer: Trainer) -> bool:
        """See :class:`StopCriterion`."""
        return trainer.iteration < trainer.config.iterations

    def num_iterations(self, trainer: Trainer) -> int:
        """See :class:`StopCriterion`."""
        return trainer.config.iterations


@dataclass(frozen=True)
class RootDecides:
    """Ends a fit, and revises it, on all ranks as the criterion of rank 0 does there."""

    criterion: StopCriterion  # of other ranks: is not consulted
    comm: Communicator

    def should_continue(self, trainer: Trainer) -> bool:
        """See :class:`StopCriterion`."""
        before, continues = trainer.config, True
        if self.comm.is_root:
            continues = self.criterion.should_continue(trainer)
        config, is_revised = trainer.config, trainer.config is not before
        decision = continues, is_revised, config.iterations, config.densify.stop
        continues, is_revised, *plan = map(int, self.comm.of_root(decision))
        if is_revised and not self.comm.is_root:
            trainer.reschedule(*plan)
        return bool(continues)

    def num_iterations(self, trainer: Trainer) -> int:
        """See :class:`StopCriterion`."""
        return self.criterion.num_iterations(trainer)


@dataclass(frozen=True)
class Iteration:
    """A finished step, of one iteration or several."""

    report: StepReport
    row: HistoryRow | None  # of the history, where this iteration is written down
    is_last: bool


class Observer(Protocol):
    """Follows a fit as it runs; the result has the same bytes without it."""

    def after(
        self, trainer: Trainer, history: History, done: Iteration, stops: Callable[[], bool]
    ) -> None:
        """Called after an iteration, by the thread that fits; history: with its row, if it has one.

        stops: whether the fit is to stop at once; an observer that waits has to call it.
        """


def iterations(trainer: Trainer, history: History, criterion: StopCriterion) -> Iterator[Iteration]:
    """Run the iterations that are left, one step each time that the next item is requested.

    Rows are added to ``history`` every ``output.history_every`` iterations, and for the last one.

    Raises ``NonFiniteError``, at a row of the history or at a change of the population, if a loss,
    a gradient or a value is not finite.
    """
    continues = criterion.should_continue(trainer)
    while continues:
        report, row = trainer.step(), None
        if report.density is not None:
            history.add_density(report.iteration, report.density)
        continues = criterion.should_continue(trainer)
        if not continues or report.passes(trainer.config.output.history_every):
            row = history.add(report)
            trainer.check_iterations()  # reading the row has waited for the device
        yield Iteration(report, row, is_last=not continues)
