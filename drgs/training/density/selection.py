"""``densify.prune.method: selection``: Gaussians that the photographs do not defend are removed.

Part of ``drgs.training.density``; imported where a fit prunes, and by this method.

Natural selection (GNS, Gaussian natural selection): now and then all opacities are lowered alike.
The derivatives of the loss raise again what is seen, all the faster as the opacities' rate is
higher meanwhile; what hardly matters falls below a threshold, and is removed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import drjit as dr
import numpy as np

from drgs.config.extensions import STRATEGIES
from drgs.config.schema import FitConfig
from drgs.core.arrays import types_of
from drgs.datasets.types import Dataset
from drgs.training.density.pruning import PruneSchedule, keep_best
from drgs.training.density.strategy import DensityReport, DensityStrategy, Population

LARGEST_PRESSURE = 1.0
"""Of logits, at one time: an opacity of 0.5 becomes 0.27. What Adam makes good within some ten
iterations at four times the usual rate."""


@STRATEGIES.register("selection")
class NaturalSelection(DensityStrategy):
    """Lowers opacities alike, and removes what becomes transparent."""

    @classmethod
    def from_config(
        cls, config: FitConfig, dataset: Dataset | None, section: None
    ) -> NaturalSelection:
        """Return the phase of the section ``densify.prune``."""
        del dataset, section
        return cls(config)

    def __init__(self, config: FitConfig) -> None:
        self.schedule, self.prune = PruneSchedule.of(config), config.densify.prune
        self.begun_with = self.left = 0  # Gaussians: at the first change, and after the last

    def rate_factors(self, iteration: int) -> Mapping[str, float]:
        """The opacities' rate is higher from the first change until the last."""
        under_pressure = self.left > self.schedule.to and self.schedule.contains(iteration)
        return {"logit_opacities": self.prune.opacity_rate if under_pressure else 1.0}

    def is_due(self, iteration: int) -> bool:
        """As the schedule says, until few enough are left."""
        is_over = 0 < self.left <= self.schedule.to
        return self.schedule.is_due(iteration) and not is_over

    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Lower all logits, and remove what is then below the threshold.

        By how much follows from how many are to be left now: so many are below, unless others are
        so opaque that it would take more than ``LARGEST_PRESSURE``. The last time, the least opaque
        go until few enough are left.
        """
        logits, to = population.host("logit_opacities"), self.schedule.to
        before, threshold = len(logits), _logit(self.prune.opacity)
        self.begun_with = self.begun_with or before
        self.left = before
        report, surplus = None, before - self.schedule.wanted(iteration, self.begun_with)
        if iteration == self.schedule.stop:
            fewer = min(before, to)
        elif surplus > 0:
            highest_removed = np.sort(logits)[surplus - 1]
            pressure = min(max(highest_removed - threshold, 0.0), LARGEST_PRESSURE)
            _lower(population, pressure)
            fewer = max(before - surplus, int(np.count_nonzero(logits - pressure > threshold)))
        else:
            fewer = before
        if fewer < before:
            report = keep_best(population, logits, fewer)
            self.left = fewer
        return report

    def state(self) -> dict[str, np.ndarray]:
        """Numbers of Gaussians."""
        return {"pruned_from": np.array(self.begun_with), "pruned_to": np.array(self.left)}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from :meth:`state`."""
        self.begun_with, self.left = int(state["pruned_from"]), int(state["pruned_to"])


def _lower(population: Population, pressure: float) -> None:
    """Subtract from all logits, which keep their moments."""
    logits = population.value("logit_opacities")
    amount = dr.opaque(types_of(type(logits)).Float, pressure)
    population.set_values("logit_opacities", logits - amount)


def _logit(opacity: float) -> float:
    return math.log(opacity / (1 - opacity))
