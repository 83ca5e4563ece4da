"""Random backgrounds behind transparent photographs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from typing_extensions import override

from drgs.config.extensions import EFFECTS
from drgs.core.errors import UserError
from drgs.core.types import TensorXf
from drgs.effects.base import SimulatedEffect, TrainingEffect, as_channels

if TYPE_CHECKING:
    from drgs.config.schema import FitConfig
    from drgs.datasets.types import Dataset, View
    from drgs.training.views import FitState, TrainingView

RANDOM_STREAM = 71  # separates the random numbers of backgrounds from others of the same seed


def set_background(integrator: mi.Integrator, color: np.ndarray) -> None:
    """Set the colour behind the splats, display space."""
    params = mi.traverse(integrator)
    params["background"] = mi.Color3f(*map(float, color))
    params.update()


@EFFECTS.register("background")
class RandomBackground(TrainingEffect):
    """A new background colour for each image: only opaque splats can match the photograph.

    The colours are functions of seed and iteration.
    """

    order = 30
    upload_bytes = 12

    @classmethod
    @override
    def summarize(cls, config: FitConfig, dataset: Dataset) -> list[SimulatedEffect]:
        if not config.data.random_background:
            return []
        what = "a random colour at each iteration"
        return [SimulatedEffect("background", what, "data.random_background")]

    @classmethod
    @override
    def from_config(cls, config: FitConfig, dataset: Dataset, section: None) -> RandomBackground:
        if any(view.alpha is None for view in dataset.train):
            raise UserError(
                "data.random_background: the photographs must be transparent where the background "
                "is to be seen, got opaque ones"
            )
        return cls(config.seed, dataset.background)

    def __init__(self, seed: int, background: tuple[float, float, float]) -> None:
        """background: behind the photographs, display space."""
        self.seed, self.background = seed, np.array(background)

    @override
    def upload(self, view: View) -> TensorXf:
        """Return 1 - alpha, (H, W, 3); 0 where a mask leaves the background out as well."""
        transparent = 1 - np.asarray(view.alpha)
        if view.mask is not None:
            transparent = transparent * np.asarray(view.mask)
        return as_channels(transparent)

    @override
    def before_render(self, fit: FitState, view: TrainingView) -> None:
        color = np.random.default_rng([self.seed, RANDOM_STREAM, fit.iteration]).uniform(size=3)
        set_background(fit.integrator, color)
        # No literal, or every colour would be a new kernel.
        shift = mi.Color3f(*map(float, color - self.background))
        dr.make_opaque(shift)
        transparent = view.uploads[self.name]
        channel = dr.arange(mi.UInt32, dr.width(transparent.array)) % 3
        shift = dr.select(channel == 0, shift.x, dr.select(channel == 1, shift.y, shift.z))
        image = view.photograph.image.array + transparent.array * shift
        view.replace_photograph(type(transparent)(image, transparent.shape))

    @override
    def after_backward(
        self, fit: FitState, view: TrainingView, derivatives: Mapping[str, dr.ArrayBase]
    ) -> None:
        set_background(fit.integrator, self.background)
        view.replacement = None
