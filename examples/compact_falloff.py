"""An approximation from outside of drgs: splats that end by themselves; ``falloff: compact``.

A Gaussian never reaches zero; 3DGS ends it where its alpha is below 1 / 255, which leaves an edge.
This falloff reaches zero smoothly, three standard deviations from the mean. With U d the offset
from the mean in standard deviations,

    alpha = opacity (1 - t / 9)^4.5,  t = |U d|^2 < 9.

Close to the mean that is the Gaussian, opacity exp(-t / 2), and nowhere is it more: the bounds that
:class:`GaussianFalloff` gives to a splat hold.
"""

import math
from dataclasses import replace

import drjit as dr

from drgs.config.approximations import FALLOFFS
from drgs.splatting.footprint import GaussianFalloff

POWER = 4.5
END = 9 / (2 * math.log(2))  # kernels scale U such that a Gaussian is 2^-t


@FALLOFFS.register("compact")
class CompactFalloff(GaussianFalloff):
    """alpha = opacity (1 - t / END)^POWER; what is stored of a splat is as for a Gaussian."""

    def footprint(self, geometry, offsets_from, active):
        """Evaluate log2(alpha) at the 16 pixels of a micro-tile; -inf beyond the end."""
        gaussian = super().footprint(geometry, offsets_from, active)
        opacity = dr.select(active, self.log2_opacity(geometry), -dr.inf)
        values = [
            dr.select(slope > 0, dr.fma(-POWER, dr.log2(slope), opacity), -dr.inf)
            for slope in _slopes(gaussian)
        ]
        return replace(gaussian, log2_alpha=values)

    def moments(self, footprint, weights, positions):
        """Sum d loss / d ln(alpha) over the pixels, and what it contributes to each derivative."""
        scaled = [w * slope for w, slope in zip(weights, _slopes(footprint), strict=True)]
        return [positions.sum(weights), *super().moments(footprint, scaled, positions)[1:]]

    def tangent(self, geometry, footprint, d_geometry):
        """Return the tangent of ln(alpha) at the 16 pixels."""
        *d_shape, d_log_opacity = d_geometry
        gaussian = super().tangent(geometry, footprint, [*d_shape, 0 * d_log_opacity])
        pairs = zip(gaussian, _slopes(footprint), strict=True)
        return [dr.fma(d, slope, d_log_opacity) for d, slope in pairs]


def _slopes(footprint):
    """Return 1 / (1 - t / END), the slope of ln(alpha) over that of a Gaussian's; 0 at the end."""
    pairs = zip(footprint.u, footprint.v, strict=True)
    rests = [1 - (u * u + v * v) / END for u, v in pairs]
    return [dr.select(rest > 0, 1 / dr.select(rest > 0, rest, 1), 0) for rest in rests]
