"""Pixels that the dataset's masks leave out of a fit."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from typing_extensions import override

from drgs.config.extensions import EFFECTS
from drgs.core.types import TensorXf
from drgs.effects.base import SimulatedEffect, TrainingEffect, as_channels

if TYPE_CHECKING:
    from drgs.config.schema import FitConfig
    from drgs.datasets.types import Dataset, View
    from drgs.training.views import TrainingView


@EFFECTS.register("masks")
class Masks(TrainingEffect):
    """Pixels that a mask leaves out are black in the rendering and in the photograph.

    They have no derivative. SSIM's windows that reach into them see the same black in both.
    """

    order = 40
    upload_bytes = 12

    @classmethod
    @override
    def summarize(cls, config: FitConfig, dataset: Dataset) -> list[SimulatedEffect]:
        masks = [view.mask for view in dataset.train]
        effect = SimulatedEffect.from_data("masks", masks, "pixels left out")
        return [replace(effect, ignored="masks" in dataset.ignored)]

    @override
    def upload(self, view: View) -> TensorXf | None:
        """Return the mask, (H, W, 3); None where a view has none."""
        return None if view.mask is None else as_channels(view.mask)

    @override
    def target_image(self, view: View, image: np.ndarray) -> np.ndarray:
        return image if view.mask is None else image * np.asarray(view.mask)[:, :, None]

    @override
    def adjust(self, image: TensorXf, view: TrainingView) -> TensorXf:
        """Return the rendering without masked pixels."""
        mask = view.uploads[self.name]
        return image if mask is None else image * mask
