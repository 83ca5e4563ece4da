"""The decisions of the image model that are cut-offs: values, adjustable down to none.

Their defaults, with sources and gradients, are in ``drgs.core.constants``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr

from drgs.core.constants import ALPHA_CUT, ALPHA_MAX, NEGLIGIBLE_ALPHA, TRANSMITTANCE_STOP
from drgs.core.types import Float


@dataclass(frozen=True)
class Cutoffs:
    """Limits at which splats and pixels end. Host numbers: each value compiles its own kernels.

    None of these decisions is differentiated.
    """

    alpha_max: float = ALPHA_MAX  # largest alpha, below 1
    alpha_cut: float = ALPHA_CUT  # smallest alpha that is composited; 0: none
    transmittance_stop: float = TRANSMITTANCE_STOP  # a pixel's last transmittance; 0: none
    extent: float = math.inf  # standard deviations from the mean beyond which a splat ends

    @property
    def least_alpha(self) -> float:
        """``alpha_cut``; where that is 0, an alpha too small to change any sum."""
        return max(self.alpha_cut, NEGLIGIBLE_ALPHA)

    def log2_floor(self, log2_opacity: Float) -> Float | float:
        """The base-2 logarithm of the smallest alpha of a splat."""
        least = math.log2(self.least_alpha)
        if math.isinf(self.extent):
            return least
        at_extent = log2_opacity - 0.5 * math.log2(math.e) * self.extent**2
        return dr.select(at_extent > least, at_extent, least)
