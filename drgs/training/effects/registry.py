"""The effects that a dataset and a configuration use, each imported when it is used."""

from __future__ import annotations

from collections.abc import Sequence

from drgs.config.extensions import EFFECTS, extensions_in_use, section_of
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.datasets.types import Dataset
from drgs.training.effects.base import TrainingEffect


def training_effects(
    config: FitConfig, dataset: Dataset, given: Sequence[TrainingEffect] = ()
) -> list[TrainingEffect]:
    """Return the effects that take part in a fit, in the order in which they act.

    given: effects besides those of the configuration, which act first.
    """
    used = [EFFECTS.get(name) for name in EFFECTS.shipped if _is_used(name, config, dataset)]
    used = [*extensions_in_use(config.extensions, EFFECTS), *used]
    effects = [*given]
    for extension in used:
        section = section_of(extension, config.extensions)
        effects.append(extension.value.from_config(config, dataset, section))
    names = [effect.name for effect in effects]
    for name in names:
        if not name or names.count(name) > 1:
            raise UserError(f"effects: each needs a name of its own, got {', '.join(names)}")
    return effects


def _is_used(name: str, config: FitConfig, dataset: Dataset) -> bool:
    """Return whether a configuration and a dataset use one of the effects that drgs ships."""
    views = dataset.train
    if name == "depth":
        return config.loss.depth_weight > 0 and any(view.depth is not None for view in views)
    if name == "masks":
        return any(view.mask is not None for view in views)
    return {
        "colors": config.colors.lr is not None,
        "background": config.data.random_background,
        "smoothing": config.model.smoothing,
        "cameras": config.cameras.optimise,
    }[name]


def integrator_settings(effects: Sequence[TrainingEffect]) -> dict[str, str]:
    """Return the settings of the integrator that effects need."""
    aovs = ", ".join(effect.aovs for effect in effects if effect.aovs)
    return {"aovs": aovs} if aovs else {}
