"""A fit that somebody watches: pictures, pause and end, between two of its iterations.

What is rendered changes nothing that the coming iterations depend on: a fit that was watched has
the bytes of one that was not.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import drjit as dr

from drgs.datasets.types import Dataset
from drgs.training.loop import History, Iteration, StopCriterion
from drgs.training.trainer import Trainer
from drgs.viewer.frames import LiveScene
from drgs.viewer.requests import Wishes
from drgs.viewer.scheduler import Screen, Spectators

REFRESH_SECONDS = 1.0
"""Between two pictures of a camera that is still, at least."""

REFRESH_SHARE = 0.05
"""Of the time, at most, for pictures of a camera that is still."""

SAID_SECONDS = 0.5
"""Between two reports of where the fit is, where somebody is there to read them."""

WAIT_SECONDS = 0.1
"""In a pause, until Ctrl-C is noticed."""


class FitScreen(Screen, Protocol):
    """Where a fit is shown."""

    def tell(self, trainer: Trainer, history: History, total: int) -> None:
        """Say where the fit is; total: iterations in all. Waits for nothing."""

    def tell_end(self, iterations: int) -> None:
        """Say that there are no more iterations, and that results are being written."""


class UntilEnded:
    """A fit ends as ``criterion`` decides, or when a viewer client ends it.

    Its configuration then says what was done.
    """

    def __init__(self, criterion: StopCriterion, wishes: Wishes) -> None:
        self._criterion, self._wishes = criterion, wishes

    def should_continue(self, trainer: Trainer) -> bool:
        """Whether there is another iteration; if not by request, revises the configuration."""
        done = trainer.iteration
        if self._wishes.ended and 0 < done < trainer.config.iterations:
            trainer.reschedule(done, trainer.config.densify.stop)
            return False
        return self._criterion.should_continue(trainer)

    def num_iterations(self, trainer: Trainer) -> int:
        """Iterations in all."""
        return self._criterion.num_iterations(trainer)


class Watching:
    """Serves those who look on at a fit: see ``drgs.training.loop.Observer``."""

    def __init__(
        self, wishes: Wishes, screen: FitScreen, dataset: Dataset, criterion: StopCriterion
    ) -> None:
        self._wishes, self._screen, self._criterion = wishes, screen, criterion
        self._background = dataset.background
        self._spectators = Spectators(wishes, screen, _refreshed_after)
        self._scene: tuple[int, LiveScene] | None = None  # and the iteration that it is of
        self._said = 0.0  # when, by time.monotonic
        self._of_fit = 0.0  # seconds of the fit's own, waited for here

    def after(
        self, trainer: Trainer, history: History, done: Iteration, stops: Callable[[], bool]
    ) -> None:
        """Render what is due, and wait where the fit is to pause.

        The history's clock stands still meanwhile.
        """
        start, self._of_fit = time.perf_counter(), 0.0
        is_due = self._wishes.asked and time.monotonic() - self._said >= SAID_SECONDS
        if history.rows and (is_due or done.is_last):
            self._tell(trainer, history)
        self._serve(trainer)
        while self._wishes.paused and not (self._wishes.ended or done.is_last or stops()):
            if not self._serve(trainer):
                self._wishes.wait(WAIT_SECONDS)
        self._scene = None  # what it holds of the Gaussians would keep memory
        history.leave_out(time.perf_counter() - start - self._of_fit)
        if done.is_last:
            self._screen.tell_end(trainer.iteration)

    def _tell(self, trainer: Trainer, history: History) -> None:
        self._said = time.monotonic()
        self._screen.tell(trainer, history, self._criterion.num_iterations(trainer))

    def _serve(self, trainer: Trainer) -> bool:
        return self._spectators.serve(lambda: self._scene_of(trainer))

    def _scene_of(self, trainer: Trainer) -> LiveScene:
        """The Gaussians as they are after the last iteration."""
        if self._scene is None or self._scene[0] != trainer.iteration:
            start = time.perf_counter()
            dr.sync_thread()  # the iteration's kernels may still be running
            self._of_fit += time.perf_counter() - start
            trainer.sync_scene()
            gaussians = dr.detach(trainer.integrator.gaussians)
            model, degree = trainer.config.model, trainer.sh_degree
            scene = LiveScene(gaussians, model, self._background, sh_degree=degree)
            self._scene = trainer.iteration, scene
        return self._scene[1]


def _refreshed_after(seconds: float) -> float:
    return max(REFRESH_SECONDS, seconds / REFRESH_SHARE)
