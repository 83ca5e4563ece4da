"""What a configuration leaves to the dataset: values that are null until it has been read."""

from __future__ import annotations

import math

import numpy as np

from drgs.config.changes import changed
from drgs.config.schema import NAMED_COLORS, REFERENCE_NEAR, FitConfig
from drgs.core.errors import UserError
from drgs.datasets.focus import focus_of
from drgs.datasets.types import Dataset, View

NEAR_SHARE = 0.04
"""Of the cameras' distance to what they look at, rounded to one digit: the near plane. It gives the
reference's 0.2 for NeRF-synthetic scenes, whose distance is 4.03, as well as for distances of 4 to
6, which photographs often have in COLMAP's unit of length."""

NEAR_RANGE = (1e-9, 1e9)
"""Scene units: what a configuration accepts."""

FARTHEST_NEAR = 0.5
"""Of that distance: a near plane beyond it would cut into what is looked at."""

GAUSSIANS_PER_PIXEL_OF_SIDE = 250
"""Numbers of Gaussians that strategies grow to are in proportion to the pictures' sides."""

SHARE_AT_START, REFERENCE_POINTS = 0.4, 100_000
"""Of such a number, how many a fit starts with; and how many where there is no such number."""

COARSE_SHARE = 0.35
"""Of a fit's iterations, those that see photographs at half their size: see ``bench recipes``."""

LEAST_SIDE = 100
"""px: of photographs that are made smaller still. SSIM's window is 11 px wide."""

ALPHA_LOOKED_AT = 15
"""Pictures, at most, that tell whether a dataset's are cut out."""


def completed(config: FitConfig, dataset: Dataset) -> FitConfig:
    """``config`` with background, near plane, numbers and coarse stages as ``dataset`` has them.

    Those that are given stay. Raises :class:`UserError` for a near plane behind which there is
    nothing left to look at, and for steps of more views than there are.
    """
    count = len(dataset.train)
    if 0 < count < config.optimizer.views_per_step:
        raise UserError(
            f"optimizer.views_per_step must be at most the number of training views ({count}), got "
            f"{config.optimizer.views_per_step}"
        )
    changes: dict[str, object] = {}
    if config.data.background is None:
        names = {color: name for name, color in NAMED_COLORS.items()}
        background = tuple(map(float, dataset.background))
        changes["data.background"] = names.get(background, background)
    if config.model.near is None:
        changes["model.near"] = _near_plane(dataset)
    else:
        _check_near_plane(config.model.near, dataset)
    changes |= _numbers_of_gaussians(config, dataset)
    if config.coarse is None:
        changes["coarse"] = _coarse_stages(config, dataset)
    return changed(config, changes) if changes else config


def _near_plane(dataset: Dataset) -> float:
    if not dataset.train:
        return REFERENCE_NEAR
    return float(f"{np.clip(NEAR_SHARE * _viewing_distance(dataset), *NEAR_RANGE):.1g}")


def _numbers_of_gaussians(config: FitConfig, dataset: Dataset) -> dict[str, object]:
    """At the start and in the end, those of them that are not given."""
    changes: dict[str, object] = {}
    densify, at_start = config.densify, REFERENCE_POINTS
    if densify.strategy in ("budget", "mcmc"):
        goal = getattr(densify, densify.strategy).gaussians
        if goal is None:
            goal = max(_suitable_number(dataset), config.init.num_points or 0)
            changes[f"densify.{densify.strategy}.gaussians"] = goal
        at_start = max(4, round(SHARE_AT_START * goal))
    if config.init.num_points is None:
        changes["init.num_points"] = min(at_start, densify.max_gaussians)
    return changes


def _suitable_number(dataset: Dataset) -> int:
    sides = [math.sqrt(view.width * view.height) for view in dataset.train]
    return max(4, round(GAUSSIANS_PER_PIXEL_OF_SIDE * float(np.mean(sides or [1]))))


def _coarse_stages(config: FitConfig, dataset: Dataset) -> list[dict[str, int]]:
    """Photographs are fitted coarse first: what is far off begins anywhere.

    What is cut out of its pictures begins where it is.
    """
    until = round(COARSE_SHARE * config.iterations)
    sides = [min(view.width, view.height) for view in dataset.train]
    is_small = min(sides, default=0) < LEAST_SIDE
    if config.densify.strategy == "adc" or until < 1 or is_small or _is_cut_out(dataset):
        return []
    return [{"until": until, "factor": 2}]


def _is_cut_out(dataset: Dataset) -> bool:
    """Whether most of some pictures are transparent where there is nothing to fit."""
    some = dataset.train[:: -(-len(dataset.train) // ALPHA_LOOKED_AT) or 1]
    return sum(map(_is_transparent, some)) > len(some) / 2


def _is_transparent(view: View) -> bool:
    if view.alpha is None:
        return False
    from drgs.initialization.visual_hull import LEAST_TRANSPARENT, TRANSPARENT

    return float(np.mean(np.asarray(view.alpha) <= TRANSPARENT)) >= LEAST_TRANSPARENT


def _check_near_plane(near: float, dataset: Dataset) -> None:
    if not dataset.train:
        return
    distance = _viewing_distance(dataset)
    if near > FARTHEST_NEAR * distance:
        raise UserError(
            f"model.near must be less than half of the distance from the cameras to what they look "
            f"at, {distance:.3g}, got {near:g}; model.near=null lets it follow from the cameras"
        )


def _viewing_distance(dataset: Dataset) -> float:
    """From the cameras to what they look at; the scene's extent where they look nowhere."""
    try:
        return focus_of(dataset.train)[1]
    except UserError:
        return dataset.extent
