"""The strategy that a configuration chooses, imported when it is used."""

from __future__ import annotations

from drgs.config.extensions import STRATEGIES, section_of
from drgs.config.schema import FitConfig
from drgs.datasets.types import Dataset
from drgs.training.density.strategy import DensityStrategy


def density_strategy(
    config: FitConfig, dataset: Dataset | None = None, growth: DensityStrategy | None = None
) -> DensityStrategy:
    """Return the strategy of a fit: growth, and a last phase if there is one.

    dataset: None for an estimate; growth: a strategy instead of ``densify.strategy``.
    """
    if growth is None:
        growth = _make(config.densify.strategy, config, dataset)
    if config.densify.prune.to is None:
        return growth
    from drgs.training.density.phases import Phases

    return Phases([growth, _make(config.densify.prune.method, config, dataset)])


def _make(name: str, config: FitConfig, dataset: Dataset | None) -> DensityStrategy:
    strategy = STRATEGIES.get(name, "densify.strategy")
    section = section_of(strategy, config.extensions)
    return strategy.value.from_config(config, dataset, section)
