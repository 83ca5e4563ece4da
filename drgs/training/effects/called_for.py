"""The effects that a dataset and a configuration call for: the one place that composes them.

Each is imported where it is called for.
"""

from __future__ import annotations

from collections.abc import Sequence

from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.datasets.types import Dataset
from drgs.training.effects.base import TrainingEffect


def training_effects(config: FitConfig, dataset: Dataset) -> list[TrainingEffect]:
    """Those that take part in the iterations of a fit, in the order in which they act."""
    effects: list[TrainingEffect] = []
    views = dataset.train
    if config.loss.depth_weight > 0 and any(view.depth is not None for view in views):
        from drgs.training.effects.depth import DepthSupervision

        effects.append(DepthSupervision(config.loss.depth_weight, dataset.extent))
    if config.colors.lr is not None:
        from drgs.training.effects.colors import ColorCorrection

        effects.append(ColorCorrection(config.colors, len(views)))
    if config.data.random_background:
        from drgs.training.effects.background import RandomBackground

        if any(view.alpha is None for view in views):
            raise UserError(
                "data.random_background: the photographs must be transparent where the background "
                "is to be seen, got opaque ones"
            )
        loss = config.loss
        effects.append(RandomBackground(config.seed, dataset.background, loss.window, loss.sigma))
    if any(view.mask is not None for view in views):
        from drgs.training.effects.masks import Masks

        effects.append(Masks())
    if config.model.smoothing:
        from drgs.training.effects.smoothing import TrainingSmoothing

        effects.append(TrainingSmoothing())
    # Behind the filter, which places all sensors: the one that is rendered then gets derivatives.
    if config.cameras.optimise:
        from drgs.training.effects.cameras import CameraRefinement

        effects.append(CameraRefinement(config.cameras, len(views), dataset.extent))
    return effects


def integrator_settings(effects: Sequence[TrainingEffect]) -> dict[str, str]:
    """Settings of the integrator that effects need."""
    aovs = ", ".join(effect.aovs for effect in effects if effect.aovs)
    return {"aovs": aovs} if aovs else {}
