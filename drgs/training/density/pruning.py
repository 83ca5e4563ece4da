"""The last phase of a fit's population: down to a number of Gaussians, a few at a time.

Part of ``drgs.training.density``: what the methods of ``densify.prune`` have in common. It comes
after the strategy that lets the population grow, whichever that is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drgs.config.schema import FitConfig
from drgs.training.density.strategy import DensityReport, Population


@dataclass(frozen=True)
class PruneSchedule:
    """When Gaussians are removed, and how many are to be left."""

    start: int  # nothing changes until after this iteration
    stop: int  # the last change
    every: int  # iterations between two
    to: int  # Gaussians that are left in the end

    @staticmethod
    def of(config: FitConfig) -> PruneSchedule:
        """That of a configuration; what is not given follows from the rest of it."""
        prune = config.densify.prune
        start, stop = config.densify.prune_window(config.iterations)
        return PruneSchedule(start, stop, prune.every, prune.to)

    def contains(self, iteration: int) -> bool:
        """Whether an iteration belongs to the phase."""
        return self.start < iteration <= self.stop

    def is_due(self, iteration: int) -> bool:
        """Whether something changes after an iteration."""
        due = iteration % self.every == 0 or iteration == self.stop
        return self.contains(iteration) and due

    def wanted(self, iteration: int, begun_with: int) -> int:
        """How many are to be left after an iteration: each change removes the same share.

        ``begun_with`` (to / begun_with)^s, s being the share of the phase that is over; ``to`` at
        its end.
        """
        if iteration >= self.stop or begun_with <= self.to:
            return self.to
        share = (iteration - self.start) / (self.stop - self.start)
        return round(begun_with * (self.to / begun_with) ** share)


def best_rows(scores: np.ndarray, count: int) -> np.ndarray:
    """The ``count`` rows of the highest scores (N,), ascending; ties: the first rows."""
    order = np.argsort(-scores, kind="stable")  # a NaN comes last
    return np.sort(order[:count])


def keep_best(population: Population, scores: np.ndarray, count: int) -> DensityReport:
    """Remove all but the ``count`` rows of the highest scores (N,); ties: the first rows stay.

    The rows that stay keep their order, and their moments.
    """
    population.edit(population.rows(best_rows(scores, count)))
    return DensityReport(num_gaussians=count, pruned=len(scores) - count)
