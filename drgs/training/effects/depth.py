"""Supervision by the depth that the data has. Imported where a view has it and it counts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np

from drgs.config.extensions import EFFECTS
from drgs.config.schema import FitConfig
from drgs.core.arrays import from_host
from drgs.datasets.types import Dataset, View
from drgs.training.effects.base import TrainingEffect
from drgs.training.image_ops import depth_error, split
from drgs.training.views import TrainingView


@EFFECTS.register("depth")
class DepthSupervision(TrainingEffect):
    """Penalises the difference between the composited depth and that of the data.

    The term is weight / extent times the mean of |D - A d| over the pixels whose depth d is known
    and that no mask leaves out, D being the alpha-weighted sum of the splats' depths and A the
    alpha:
    :func:`drgs.training.image_ops.depth_error`.
    """

    name = "depth"
    aovs = "depth:depth, alpha:alpha"
    upload_bytes = 8

    @classmethod
    def from_config(cls, config: FitConfig, dataset: Dataset, section: None) -> DepthSupervision:
        """Return the effect of a fit."""
        del section
        return cls(config.loss.depth_weight, dataset.extent)

    def __init__(self, weight: float, extent: float) -> None:
        """weight: of the term, per scene extent."""
        self.weight, self.depths = weight / extent, None

    def upload(self, view: View) -> Any:
        """Depths, and weights of the pixels; None where a view has none that counts."""
        if view.depth is None:
            return None
        depth = np.asarray(view.depth)
        known = depth > 0
        if view.mask is not None:
            known &= np.asarray(view.mask) > 0
        if not known.any():
            return None
        weights = self.weight * known / known.sum()
        return from_host(mi.Float, depth), from_host(mi.Float, weights)

    def adjust(self, image: Any, view: TrainingView) -> Any:
        """The colours; depth and alpha are kept for the penalty."""
        del view
        image, self.depths = split(image, 3)
        return image

    def penalties(self, view: TrainingView) -> Iterator[Any]:
        """The difference in depth."""
        if (known := view.uploads[self.name]) is not None:
            yield depth_error(self.depths, *known)
