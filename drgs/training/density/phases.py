"""The strategy of a fit: growth, then what removes floaters and the least Gaussians."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import chain
from typing import cast

import drjit as dr
import numpy as np
from typing_extensions import override

from drgs.config.extensions import STRATEGIES, section_of
from drgs.config.schema import FitConfig
from drgs.core.types import Float
from drgs.datasets.types import Dataset
from drgs.training.contracts import checked_report
from drgs.training.density.floaters import Floaters
from drgs.training.density.pruning import NaturalSelection
from drgs.training.density.strategy import (
    DensityReport,
    DensityStrategy,
    PixelWeight,
    Population,
    StepInfo,
)


def density_strategy(
    config: FitConfig, dataset: Dataset | None = None, growth: DensityStrategy | None = None
) -> DensityStrategy:
    """Return a fit's strategy; dataset: None: an estimate; growth: in place of the configured."""
    densify = config.densify
    if growth is None:
        strategy = STRATEGIES.get(densify.strategy, "densify.strategy")
        section = section_of(strategy, densify.sections)
        growth = cast(DensityStrategy, strategy.value.from_config(config, dataset, section))
    phases: list[DensityStrategy] = [growth]
    if densify.remove_floaters:
        phases.append(Floaters(config, dataset))
    if densify.prune.to is not None:
        phases.append(NaturalSelection(config))
    return growth if len(phases) == 1 else PhasedStrategy(phases)


class PhasedStrategy(DensityStrategy):
    """A sequence of strategies; if one changes rows, the others are reset."""

    def __init__(self, phases: Sequence[DensityStrategy]) -> None:
        self.phases = phases
        self.by_row = [name for phase in phases for name in phase.by_row]

    @override
    def begin(self, population: Population) -> None:
        for phase in self.phases:
            phase.begin(population)

    @override
    def needs_statistics(self, iteration: int) -> bool:
        return any(phase.needs_statistics(iteration) for phase in self.phases)

    @override
    def pixel_weights(self, iteration: int) -> Mapping[str, PixelWeight]:
        needed = [phase for phase in self.phases if phase.needs_statistics(iteration)]
        return {k: v for phase in needed for k, v in phase.pixel_weights(iteration).items()}

    @override
    def update_statistics(self, step: StepInfo) -> None:
        for phase in self.phases:
            if phase.needs_statistics(step.iteration):
                phase.update_statistics(step)

    @override
    def penalties(self, parameters: Mapping[str, dr.ArrayBase], num_rows: int) -> Iterator[Float]:
        return chain.from_iterable(p.penalties(parameters, num_rows) for p in self.phases)

    @override
    def rate_factors(self, iteration: int) -> Mapping[str, float]:
        product: dict[str, float] = {}
        for phase in self.phases:
            for name, factor in phase.rate_factors(iteration).items():
                product[name] = product.get(name, 1.0) * factor
        return product

    @override
    def perturb(self, population: Population, iteration: int, means_lr: float) -> None:
        for phase in self.phases:
            phase.perturb(population, iteration, means_lr)

    @override
    def is_due(self, iteration: int) -> bool:
        return any(phase.is_due(iteration) for phase in self.phases)

    @override
    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Let the phases that are due act, one after the other; return the sum of the reports."""
        total: DensityReport | None = None
        for phase in self.phases:
            report = phase.refine(population, iteration) if phase.is_due(iteration) else None
            checked_report(phase, report)
            if report is not None:
                for other in self.phases:
                    if other is not phase:
                        other.begin(population)
                total = report if total is None else _sum(total, report)
        return total

    @override
    def state(self) -> dict[str, np.ndarray]:
        return {name: v for phase in self.phases for name, v in phase.state().items()}

    @override
    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        for phase in self.phases:
            phase.restore(state)

    @override
    def max_num_gaussians(self, start: int, iterations: int) -> int:
        """Return the largest number of all phases."""
        most = start
        for phase in self.phases:
            most = max(most, phase.max_num_gaussians(most, iterations))
        return most


def _sum(first: DensityReport, second: DensityReport) -> DensityReport:
    counts = {name: count + getattr(second, name) for name, count in asdict(first).items()}
    return DensityReport(**{**counts, "num_gaussians": second.num_gaussians})
