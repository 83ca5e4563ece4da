"""A density strategy: the more opaque half of the Gaussians is kept, once."""

import mitsuba as mi
import numpy as np
from pydantic import Field

from drgs.config.extensions import STRATEGIES
from drgs.config.section import Section
from drgs.core.arrays import from_host
from drgs.training.density.strategy import DensityReport, DensityStrategy


class HalvingSection(Section):
    """The section ``densify.halving``."""

    after: int = Field(10, ge=1, description="The iteration after which half are removed.")


@STRATEGIES.register("halving", section=HalvingSection)
class Halving(DensityStrategy):
    """Keeps the more opaque half of the Gaussians after an iteration."""

    def __init__(self, section: HalvingSection) -> None:
        self.after = section.after

    def is_due(self, iteration):
        """Return whether rows change after this iteration."""
        return iteration == self.after

    def refine(self, population, iteration):
        """Keep half of the rows, in their order."""
        count = population.num_rows // 2
        order = np.argsort(-population.host("logit_opacities"), kind="stable")
        keep = np.sort(order[: population.num_rows - count]).astype(np.uint32)
        population.edit(from_host(mi.UInt32, keep))
        return DensityReport(population.num_rows, pruned=count)
