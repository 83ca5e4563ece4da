"""An effect of a fit: the lens darkens the corners of photographs, by a factor that is fitted."""

import mitsuba as mi
import numpy as np
from pydantic import Field

from drgs.config.extensions import EFFECTS
from drgs.config.section import Section
from drgs.effects.base import as_tensor
from drgs.effects.optimised import OptimisedEffect


class VignettingSection(Section):
    """The section ``vignetting``."""

    lr: float = Field(0.01, gt=0, description="First rate of the strength; falls as the means'.")


@EFFECTS.register("vignetting", section=VignettingSection)
class Vignetting(OptimisedEffect):
    """Renderings are darkened towards the corners, as the photographs are."""

    def __init__(self, section: VignettingSection) -> None:
        strength = {"strength": np.zeros((1, 1))}  # one for all views
        super().__init__(strength, {"strength": section.lr})

    def upload(self, view):
        """Return half of the squared distance from the middle, (H, W, 3); 1 in the corners."""
        y, x = np.mgrid[: view.height, : view.width] + 0.5
        x, y = 2 * x / view.width - 1, 2 * y / view.height - 1
        return as_tensor(np.repeat(((x**2 + y**2) / 2)[:, :, None], 3, axis=2))

    def adjust(self, image, view):
        """Return the rendering as the camera would have taken it."""
        strength = self.parameters(view)["strength"]
        falloff = 1 - strength * view.uploads[self.name].array
        return mi.TensorXf(image.array * falloff, image.shape)
