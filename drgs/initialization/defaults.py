"""Defaults that follow from the dataset: values of a configuration that are null until then."""

from __future__ import annotations

import math

import numpy as np

from drgs.cameras.viewpoints import focus_of
from drgs.config.changes import with_changes
from drgs.config.extensions import STRATEGIES
from drgs.config.schema import NAMED_COLORS, NEAR_LIMITS, REFERENCE_NEAR, FitConfig
from drgs.core.errors import UserError
from drgs.datasets.types import Dataset
from drgs.initialization.visual_hull import MAX_EMPTY_ALPHA, MIN_TRANSPARENT_SHARE

NEAR_SHARE = 0.04
"""The near plane is this share of the cameras' distance to their focus, rounded to one digit: the
reference's 0.2 for NeRF-synthetic scenes, whose distance is 4.03, and for distances of 4 to 6,
which photographs often have in COLMAP's unit of length."""

MAX_NEAR_SHARE = 0.5  # of that distance: a farther near plane would cut into the scene

GAUSSIANS_PER_PIXEL_OF_SIDE = 250  # that strategies grow to, in proportion to the images' sides

SHARE_AT_START, REFERENCE_POINTS = 0.4, 100_000
"""Share of such a number that a fit starts with; and its number for other strategies."""

SCALES_LR_CUT_OUT, SCALES_LR = 0.02, 0.01
"""Rates of the log scales, for objects that are cut out and for other photographs."""

COARSE_SHARE = 0.35  # of a fit's iterations, with photographs at half size: see ``bench recipes``

MIN_COARSE_SIDE_PX = 100  # of photographs that are made smaller still; SSIM's window has 11 px

NUM_ALPHA_VIEWS = 15  # images, at most, by which a dataset is judged to be cut out


def resolve_defaults(config: FitConfig, dataset: Dataset) -> FitConfig:
    """Return ``config`` with the values that follow from ``dataset``, such as its background.

    Given values stay. Raises :class:`UserError` for a near plane too close to what the cameras look
    at, and for steps of more views than there are.
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
        red, green, blue = map(float, dataset.background)
        background = red, green, blue
        changes["data.background"] = names.get(background, background)
    distance = _viewing_distance(dataset)
    if config.model.near is None:
        near = float(f"{np.clip(NEAR_SHARE * distance, *NEAR_LIMITS):.1g}")
        changes["model.near"] = near if count else REFERENCE_NEAR
    elif count and config.model.near > MAX_NEAR_SHARE * distance:
        raise UserError(
            f"model.near must be less than half of the distance from the cameras to what they look "
            f"at, {distance:.3g}, got {config.model.near:g}; model.near=null lets it follow from "
            "the cameras"
        )
    changes |= _numbers_of_gaussians(config, dataset)
    if config.coarse is None or config.optimizer.scales_lr is None:
        is_cut_out = _is_cut_out(dataset)  # reads images, which a parallel fit has on other ranks
        if config.coarse is None:
            until = round(COARSE_SHARE * config.iterations)
            sides = [min(view.width, view.height) for view in dataset.train]
            is_coarse = (
                not is_cut_out  # cut-out objects start in place
                and config.init.gaussians is None
                and STRATEGIES.get(config.densify.strategy).value.begins_coarse
                and until >= 1
                and min(sides, default=0) >= MIN_COARSE_SIDE_PX
            )
            changes["coarse"] = [{"until": until, "factor": 2}] if is_coarse else []
        if config.optimizer.scales_lr is None:
            changes["optimizer.scales_lr"] = SCALES_LR_CUT_OUT if is_cut_out else SCALES_LR
    return with_changes(config, changes) if changes else config


def _numbers_of_gaussians(config: FitConfig, dataset: Dataset) -> dict[str, object]:
    changes: dict[str, object] = {}
    densify, at_start = config.densify, REFERENCE_POINTS
    if densify.has_goal:
        goal = getattr(densify.settings, "gaussians", None)
        if goal is None:
            sides = [math.sqrt(view.width * view.height) for view in dataset.train]
            suitable = round(GAUSSIANS_PER_PIXEL_OF_SIDE * float(np.mean(sides or [1])))
            goal = max(4, suitable, config.init.num_points or 0)
            changes[f"densify.{densify.strategy}.gaussians"] = goal
        at_start = max(4, round(SHARE_AT_START * goal))
    if config.init.num_points is None:
        changes["init.num_points"] = min(at_start, densify.max_gaussians)
    return changes


def _is_cut_out(dataset: Dataset) -> bool:
    """Return whether most of some images are transparent in part."""
    some = dataset.train[:: -(-len(dataset.train) // NUM_ALPHA_VIEWS) or 1]
    alphas = (np.asarray(view.alpha) for view in some if view.alpha is not None)
    shares = [float(np.mean(alpha <= MAX_EMPTY_ALPHA)) for alpha in alphas]  # one at a time
    return sum(share >= MIN_TRANSPARENT_SHARE for share in shares) > len(some) / 2


def _viewing_distance(dataset: Dataset) -> float:
    """Return the cameras' distance to their focus; without a focus, the scene's extent."""
    if not dataset.train:
        return 1.0
    try:
        return focus_of(dataset.train)[1]
    except UserError:
        return dataset.extent
