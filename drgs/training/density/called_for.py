"""The strategy that a configuration calls for: the one place that composes it.

Each is imported where it is called for.
"""

from __future__ import annotations

from drgs.config.schema import FitConfig
from drgs.training.density.strategy import DensityStrategy


def density_strategy(config: FitConfig, white_background: bool = False) -> DensityStrategy:
    """How the population of a fit changes.

    white_background: whether what is behind the splats is white.
    """
    growth = _growth(config, white_background)
    if config.densify.prune.to is None:
        return growth
    from drgs.training.density.phases import Phases

    return Phases([growth, _last_phase(config)])


def _growth(config: FitConfig, white_background: bool) -> DensityStrategy:
    if config.densify.strategy == "budget":
        from drgs.training.density.budget import GrowthToNumber

        return GrowthToNumber(config.densify, config.coarse or ())
    if config.densify.strategy == "mcmc":
        from drgs.training.density.mcmc import MarkovChain

        return MarkovChain(config.densify)
    from drgs.training.density.adc import AdaptiveDensityControl

    return AdaptiveDensityControl(config.densify, white_background)


def _last_phase(config: FitConfig) -> DensityStrategy:
    if config.densify.prune.method == "importance":
        from drgs.training.density.importance import Importance

        return Importance(config)
    from drgs.training.density.selection import NaturalSelection

    return NaturalSelection(config)
