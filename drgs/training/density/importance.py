"""``densify.prune.method: importance``: Gaussians that hardly show are removed.

Part of ``drgs.training.density``; imported where a fit prunes, and by this method.

A Gaussian's score is the sum of its weights T a (3DGS, equation 3) over the pixels of the pictures
of the phase so far: how much of what was seen is its colour (as in Mini-Splatting, Fang and Wang
2024, section 4.2). Those of the lowest scores are removed, a few at a time, so that the others can
take over what they showed. Each picture of the phase takes about half as long again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import numpy as np

from drgs.config.extensions import STRATEGIES
from drgs.config.schema import FitConfig
from drgs.core.arrays import from_host
from drgs.datasets.types import Dataset
from drgs.training.density.pruning import PruneSchedule, best_rows, keep_best
from drgs.training.density.strategy import (
    DensityReport,
    DensityStrategy,
    PixelWeight,
    Population,
    StepInfo,
)


@STRATEGIES.register("importance")
class Importance(DensityStrategy):
    """Removes Gaussians by what they contribute to pictures."""

    by_row = ("weights",)

    @classmethod
    def from_config(cls, config: FitConfig, dataset: Dataset | None, section: None) -> Importance:
        """Return the phase of the section ``densify.prune``."""
        del dataset, section
        return cls(config)

    def __init__(self, config: FitConfig) -> None:
        self.schedule = PruneSchedule.of(config)
        self.begun_with = 0  # Gaussians, at the first change
        self.scores: Any = None  # (N,) Float, until it begins None

    def begin(self, population: Population) -> None:
        """Start with the scores of no pictures."""
        float_type = type(population.value("means").array)
        self.scores = dr.zeros(float_type, population.num_own)

    def needs_statistics(self, iteration: int) -> bool:
        """Weights count in the iterations of the phase."""
        return self.schedule.contains(iteration)

    def pixel_weights(self, iteration: int) -> Mapping[str, PixelWeight]:
        """Return ones: all pixels count alike."""
        del iteration
        return {"coverage": _ones}

    def update_statistics(self, step: StepInfo) -> None:
        """Add the weights of an image."""
        self.scores = self.scores + step.weighted_sums["coverage"]
        dr.eval(self.scores)

    def is_due(self, iteration: int) -> bool:
        """As the schedule says."""
        return self.schedule.is_due(iteration)

    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Remove as many as the schedule says."""
        before = population.num_rows
        self.begun_with = self.begun_with or before
        scores = population.of_all(self.scores)
        fewer = min(before, self.schedule.wanted(iteration, self.begun_with))
        if fewer == before:
            return None
        report = keep_best(population, scores, fewer)
        # Others' scores stay: few of the views were seen since the last change.
        left = population.own(scores[best_rows(scores, fewer)])
        self.scores = from_host(type(self.scores), left)
        return report

    def state(self) -> dict[str, np.ndarray]:
        """The scores so far."""
        return {"pruned_from": np.array(self.begun_with), "weights": np.array(self.scores)}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from :meth:`state`."""
        self.begun_with = int(state["pruned_from"])
        self.scores = from_host(type(self.scores), state["weights"])


def _ones(image: Any, photograph: Any) -> Any:
    del photograph
    height, width, _ = image.shape
    return dr.opaque(type(image.array), 1, height * width)
