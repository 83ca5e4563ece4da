"""The phase after growth, ``densify.prune``: down to a number of Gaussians, a few at a time."""

from __future__ import annotations

import math
from collections.abc import Mapping

import drjit as dr
import numpy as np
from typing_extensions import override

from drgs.config.schema import FitConfig
from drgs.core.arrays import types_of
from drgs.training.density.strategy import DensityReport, DensityStrategy, Population

MIN_OPACITY = 0.005
"""Less opaque Gaussians are removed."""

OPACITY_RATE_FACTOR = 4.0
"""Factor of ``optimizer.opacities_lr`` during the phase."""

MAX_PRESSURE = 1.0
"""Most by which logits are lowered at one time: an opacity of 0.5 becomes 0.27, which Adam makes
good within some ten iterations at four times the usual rate."""


class NaturalSelection(DensityStrategy):
    """Lowers all opacities, and removes Gaussians that become transparent.

    The loss raises the opacities of Gaussians that matter, at a higher learning rate; the others
    fall below a threshold (GNS, Gaussian natural selection).
    """

    num_left = 0  # Gaussians after the last change

    def __init__(self, config: FitConfig) -> None:
        self.prune = config.densify.prune
        assert self.prune.to is not None, "a fit without it has no last phase"
        self.to = self.prune.to  # Gaussians that are left in the end
        # Nothing changes until after the first iteration; the last change is after the second.
        self.start, self.stop = config.densify.prune_window(config.iterations)
        self.num_before = 0  # Gaussians, at the first change

    def contains(self, iteration: int) -> bool:
        """Return whether an iteration belongs to the phase."""
        return self.start < iteration <= self.stop

    @override
    def is_due(self, iteration: int) -> bool:
        due = iteration % self.prune.every == 0 or iteration == self.stop
        is_over = 0 < self.num_left <= self.to
        return self.contains(iteration) and due and not is_over

    def goal(self, iteration: int, before: int) -> int:
        """Return the number to be left after an iteration: each change removes the same share.

        ``before`` (to / before)^s, s being the share of the phase that is over, of ``before``
        Gaussians at the first change; ``to`` at its end.
        """
        if iteration >= self.stop or before <= self.to:
            return self.to
        share = (iteration - self.start) / (self.stop - self.start)
        return round(before * (self.to / before) ** share)

    @override
    def rate_factors(self, iteration: int) -> Mapping[str, float]:
        under_pressure = self.num_left > self.to and self.contains(iteration)
        return {"logit_opacities": OPACITY_RATE_FACTOR if under_pressure else 1.0}

    @override
    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Lower all logits, and remove Gaussians that are then below the threshold.

        The shift follows from the number to be left now, up to ``MAX_PRESSURE``. The last time,
        the least opaque are removed until few enough are left.
        """
        logits = population.host("logit_opacities")
        threshold = math.log(MIN_OPACITY / (1 - MIN_OPACITY))
        self.num_left = before = count = len(logits)
        self.num_before = self.num_before or before
        surplus = before - self.goal(iteration, self.num_before)
        if iteration == self.stop:
            count = min(before, self.to)
        elif surplus > 0:
            highest_removed = np.sort(logits)[surplus - 1]
            pressure = min(max(highest_removed - threshold, 0.0), MAX_PRESSURE)
            values = population.value("logit_opacities")
            amount = dr.opaque(types_of(type(values)).Float, pressure)
            population.set_values("logit_opacities", values - amount)
            count = max(before - surplus, int(np.count_nonzero(logits - pressure > threshold)))
        if count == before:
            return None
        self.num_left = count
        return keep_best(population, logits, count)

    @override
    def state(self) -> dict[str, np.ndarray]:
        return {"pruned_from": np.array(self.num_before), "pruned_to": np.array(self.num_left)}

    @override
    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self.num_before, self.num_left = int(state["pruned_from"]), int(state["pruned_to"])


def keep_best(population: Population, scores: np.ndarray, count: int) -> DensityReport:
    """Keep ``count`` rows of the highest scores (N,), with their moments; of equals, the first."""
    order = np.argsort(-scores, kind="stable")  # a NaN comes last
    population.edit(population.to_device_indices(np.sort(order[:count])))
    return DensityReport(num_gaussians=count, pruned=len(scores) - count)
