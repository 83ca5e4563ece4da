"""A term of the loss: opacities are drawn to 0 and 1."""

import drjit as dr
from pydantic import Field

from drgs.config.extensions import LOSS_TERMS
from drgs.config.section import Section
from drgs.training.losses import LossTerm


class BinaryOpacitySection(Section):
    """The section ``binary_opacity``."""

    weight: float = Field(0.01, ge=0, description="Weight of the mean of o (1 - o).")


@LOSS_TERMS.register("binary_opacity", section=BinaryOpacitySection)
class BinaryOpacity(LossTerm):
    """The mean of o (1 - o) over all Gaussians, o their opacities."""

    def __init__(self, section: BinaryOpacitySection) -> None:
        self.weight = section.weight

    def of_gaussians(self, parameters, num_rows):
        """Return the term; ``logit_opacities`` is the raw parameter, (N,)."""
        opacities = 1 / (1 + dr.exp(-parameters["logit_opacities"].array))
        return self.weight / num_rows * dr.sum(opacities * (1 - opacities))
