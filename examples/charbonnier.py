"""A loss: the smooth absolute difference of Charbonnier et al. (1994)."""

import drjit as dr
from pydantic import Field

from drgs.config.extensions import LOSSES
from drgs.config.section import Section
from drgs.training.losses import Loss


class CharbonnierSection(Section):
    """The section ``charbonnier``."""

    epsilon: float = Field(0.01, gt=0, description="Differences below this count as squares.")


@LOSSES.register("charbonnier", section=CharbonnierSection)
class Charbonnier(Loss):
    """The mean of sqrt((x - y)^2 + epsilon^2) - epsilon over pixels and channels."""

    def __init__(self, section: CharbonnierSection) -> None:
        self.epsilon = section.epsilon

    def __call__(self, image, target):
        """Return the loss; image: (H, W, 3), display space."""
        difference = image.array - target.image.array
        distance = dr.sqrt(dr.square(difference) + self.epsilon**2)
        return dr.mean(distance - self.epsilon)
