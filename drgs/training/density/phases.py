"""Strategies that follow one another in a fit, such as growth and a last selection.

The trainer sees them as one strategy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import chain
from typing import Any

import numpy as np

from drgs.training.density.strategy import DensityReport, DensityStrategy, Population, SeenStep


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

    @property
    def looks_at_pictures(self) -> bool:
        """Whether any of them does."""
        return any(phase.looks_at_pictures for phase in self.phases)

    def begin(self, population: Population) -> None:
        """Start with the statistics of no views."""
        for phase in self.phases:
            phase.begin(population)

    def gathers(self, iteration: int) -> bool:
        """Whether any of them does."""
        return any(phase.gathers(iteration) for phase in self.phases)

    def gather(self, step: SeenStep) -> None:
        """Tell those of them that gather."""
        for phase in self.phases:
            if phase.gathers(step.iteration):
                phase.gather(step)

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

    def acts(self, iteration: int) -> bool:
        """Whether any of them does."""
        return any(phase.acts(iteration) for phase in self.phases)

    def act(self, population: Population, iteration: int) -> DensityReport | None:
        """Those of them that act, one after the other."""
        reports = []
        for phase in self.phases:
            if not phase.acts(iteration):
                continue
            report = phase.act(population, iteration)
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
