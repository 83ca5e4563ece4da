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
    if config.densify.strategy == "budget":
        from drgs.training.density.budget import GrowthToNumber

        return GrowthToNumber(config.densify, config.coarse)
    from drgs.training.density.adc import AdaptiveDensityControl

    return AdaptiveDensityControl(config.densify, white_background)
