"""The phase after growth, ``densify.prune``: down to a number of Gaussians, a few at a time."""

from __future__ import annotations

import math
from collections.abc import Mapping

import drjit as dr
import numpy as np
from typing_extensions import override

from drgs.config.schema import FitConfig
from drgs.core.arrays import from_host, types_of
from drgs.core.types import Float, TensorXf
from drgs.datasets.types import Dataset
from drgs.training.density.strategy import (
    NOT_BEGUN,
    DensityReport,
    DensityStrategy,
    PixelWeight,
    Population,
    StepInfo,
)

MAX_PRESSURE = 1.0
"""Most by which logits are lowered at one time: an opacity of 0.5 becomes 0.27, which Adam makes
good within some ten iterations at four times the usual rate."""


class Pruning(DensityStrategy):
    """A last phase; subclasses choose the Gaussians that are removed."""

    @classmethod
    @override
    def from_config(cls, config: FitConfig, dataset: Dataset | None, section: None) -> Pruning:
        return cls(config)

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
        return self.contains(iteration) and due

    def goal(self, iteration: int, before: int) -> int:
        """Return the number to be left after an iteration: each change removes the same share.

        ``before`` (to / before)^s, s being the share of the phase that is over, of ``before``
        Gaussians at the first change; ``to`` at its end.
        """
        if iteration >= self.stop or before <= self.to:
            return self.to
        share = (iteration - self.start) / (self.stop - self.start)
        return round(before * (self.to / before) ** share)


class Importance(Pruning):
    """Removes Gaussians by their contribution to images.

    A Gaussian's score is the sum of its weights T a (3DGS, equation 3) over the pixels of the
    images of the phase so far (as in Mini-Splatting, Fang and Wang 2024, section 4.2). Those of the
    lowest scores are removed, a few at a time, so that the rest can compensate.
    Each image of the phase takes about half as long again.
    """

    by_row = ("weights",)
    scores: Float = NOT_BEGUN  # (N,)

    @override
    def begin(self, population: Population) -> None:
        self.scores = population.zeros()

    @override
    def needs_statistics(self, iteration: int) -> bool:
        return self.contains(iteration)

    @override
    def pixel_weights(self, iteration: int) -> Mapping[str, PixelWeight]:
        return {"coverage": _ones}

    @override
    def update_statistics(self, step: StepInfo) -> None:
        self.scores = self.scores + step.weighted_sums["coverage"]
        dr.eval(self.scores)

    @override
    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        before = population.num_rows
        self.num_before = self.num_before or before
        scores = population.gather(self.scores)
        count = min(before, self.goal(iteration, self.num_before))
        if count == before:
            return None
        report = keep_best(population, scores, count)
        # The remaining scores are kept: few views were rendered since the last change.
        left = population.local(scores[best_rows(scores, count)])
        self.scores = from_host(type(self.scores), left)
        return report

    @override
    def state(self) -> dict[str, np.ndarray]:
        return {"pruned_from": np.array(self.num_before), "weights": np.array(self.scores)}

    @override
    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self.num_before = int(state["pruned_from"])
        self.scores = from_host(type(self.scores), state["weights"])


class NaturalSelection(Pruning):
    """Lowers all opacities, and removes Gaussians that become transparent.

    The loss raises the opacities of Gaussians that matter, at a higher learning rate; the others
    fall below a threshold (GNS, Gaussian natural selection).
    """

    num_left = 0  # Gaussians after the last change

    @override
    def rate_factors(self, iteration: int) -> Mapping[str, float]:
        under_pressure = self.num_left > self.to and self.contains(iteration)
        return {"logit_opacities": self.prune.opacity_rate if under_pressure else 1.0}

    @override
    def is_due(self, iteration: int) -> bool:
        is_over = 0 < self.num_left <= self.to
        return super().is_due(iteration) and not is_over

    @override
    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Lower all logits, and remove Gaussians that are then below the threshold.

        The shift follows from the number to be left now, up to ``MAX_PRESSURE``. The last time,
        the least opaque are removed until few enough are left.
        """
        logits = population.host("logit_opacities")
        threshold = math.log(self.prune.opacity / (1 - self.prune.opacity))
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


METHODS = {"importance": Importance, "selection": NaturalSelection}
"""By the value of ``densify.prune.method``."""


def best_rows(scores: np.ndarray, count: int) -> np.ndarray:
    """Return the ``count`` rows of the highest scores (N,), ascending; ties: the first rows."""
    order = np.argsort(-scores, kind="stable")  # a NaN comes last
    return np.sort(order[:count])


def keep_best(population: Population, scores: np.ndarray, count: int) -> DensityReport:
    """Remove all but the ``count`` rows of the highest scores (N,), which keep their moments."""
    population.edit(population.to_device_indices(best_rows(scores, count)))
    return DensityReport(num_gaussians=count, pruned=len(scores) - count)


def _ones(image: TensorXf, photograph: TensorXf) -> Float:
    height, width, _ = image.shape
    return dr.opaque(type(image.array), 1, height * width)
