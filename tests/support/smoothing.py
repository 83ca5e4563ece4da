"""The smoothing filter, and trainers that use it."""

from dataclasses import replace

import numpy as np

import drgs  # noqa: F401  (registers the plugin)
from drgs.reference import effects as reference_effects
from drgs.reference import splatting as reference


def rates_of(smoothing) -> np.ndarray:
    """The sampling rates that call for a filter: its variance is 0.2 / rate^2."""
    return np.sqrt(0.2) / smoothing


def smoothed_reference(gaussians: reference.Gaussians, smoothing) -> reference.Gaussians:
    """Gaussians whose parameters hold the filter."""
    scales, opacities = reference_effects.smoothing_filter(
        gaussians.log_scales, gaussians.logit_opacities, rates_of(smoothing)
    )
    logits = np.log(opacities) - np.log1p(-opacities)
    return replace(gaussians, log_scales=np.log(scales), logit_opacities=logits)
