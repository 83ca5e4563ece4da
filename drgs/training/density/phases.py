"""Strategies that follow one another in a fit, such as growth and a last selection.

The trainer sees them as one strategy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import chain
from typing import Any

import numpy as np

from drgs.training.density.strategy import (
    DensityReport,
    DensityStrategy,
    PixelWeight,
    Population,
    StepInfo,
)


@dataclass(frozen=True)
class Phases(DensityStrategy):
    """Each does what it would do alone; names in their states differ.

    Where one of them changes rows, the others begin anew, without statistics.
    """

    phases: Sequence[DensityStrategy]

    @property
    def by_row(self) -> Sequence[str]:
        """Those of all of them."""
        return [name for phase in self.phases for name in phase.by_row]

    def begin(self, population: Population) -> None:
        """Start with the statistics of no views."""
        for phase in self.phases:
            phase.begin(population)

    def needs_statistics(self, iteration: int) -> bool:
        """Whether any of them does."""
        return any(phase.needs_statistics(iteration) for phase in self.phases)

    def pixel_weights(self, iteration: int) -> Mapping[str, PixelWeight]:
        """Return the planes of the phases that need statistics."""
        needed = [phase for phase in self.phases if phase.needs_statistics(iteration)]
        return {k: v for phase in needed for k, v in phase.pixel_weights(iteration).items()}

    def update_statistics(self, step: StepInfo) -> None:
        """Tell those of them that gather."""
        for phase in self.phases:
            if phase.needs_statistics(step.iteration):
                phase.update_statistics(step)

    def penalties(self, parameters: Mapping[str, Any], num_rows: int) -> Iterator[Any]:
        """Those of all of them."""
        return chain.from_iterable(p.penalties(parameters, num_rows) for p in self.phases)

    def rate_factors(self, iteration: int) -> Mapping[str, float]:
        """The products of theirs."""
        product: dict[str, float] = {}
        for phase in self.phases:
            for name, factor in phase.rate_factors(iteration).items():
                product[name] = product.get(name, 1.0) * factor
        return product

    def perturb(self, population: Population, iteration: int, means_lr: float) -> None:
        """One after the other."""
        for phase in self.phases:
            phase.perturb(population, iteration, means_lr)

    def is_due(self, iteration: int) -> bool:
        """Whether any of them does."""
        return any(phase.is_due(iteration) for phase in self.phases)

    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Those of them that act, one after the other."""
        reports = []
        for phase in self.phases:
            if not phase.is_due(iteration):
                continue
            report = phase.refine(population, iteration)
            if report is not None:
                reports.append(report)
                for other in self.phases:
                    if other is not phase:
                        other.begin(population)
        return _together(reports) if reports else None

    def state(self) -> dict[str, np.ndarray]:
        """Those of all of them."""
        return {name: v for phase in self.phases for name, v in phase.state().items()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Each finds its own."""
        for phase in self.phases:
            phase.restore(state)

    def most_gaussians(self, start: int, iterations: int) -> int:
        """Each may begin with as many as the one before has at most."""
        most = start
        for phase in self.phases:
            most = max(most, phase.most_gaussians(most, iterations))
        return most


def _together(reports: Sequence[DensityReport]) -> DensityReport:
    """Sums, and the number of Gaussians after the last one."""
    counts = [field.name for field in fields(DensityReport) if field.name != "num_gaussians"]
    sums = {name: sum(getattr(report, name) for report in reports) for name in counts}
    return DensityReport(num_gaussians=reports[-1].num_gaussians, **sums)
