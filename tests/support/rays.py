"""Rays for tests of light, and splats as they meet them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from drgs.core.arrays import types_of
from drgs.light.walk import RaySplats, Segment
from drgs.reference import splatting
from drgs.splatting.footprint import Cutoffs
from drgs.splatting.projection import load_rows
from support.helpers import device_gaussians
from support.studies import reference_rays as rays


@dataclass(frozen=True)
class Rays:
    origins: np.ndarray
    directions: np.ndarray
    far: np.ndarray

    @staticmethod
    def towards(origins, targets, far=np.inf) -> Rays:
        directions = np.asarray(targets) - origins
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return Rays(*map(_single, (origins, directions, np.broadcast_to(far, len(directions)))))

    def segments(self, precision) -> Segment:
        types = types_of(precision.Float)
        return Segment(
            precision.vectors(self.origins),
            precision.vectors(self.directions),
            precision.array(self.far),
            dr.full(types.Bool, True, len(self.far)),
        )


def _single(values) -> np.ndarray:
    return np.asarray(values, np.float32).astype(np.float64)


def splats_of(gaussians: splatting.Gaussians, precision, cutoffs=Cutoffs()) -> RaySplats:  # noqa: B008
    loaded = load_rows(device_gaussians(gaussians, precision), gaussians.sh_degree)
    return RaySplats.from_gaussians(loaded, gaussians.sh_degree, cutoffs)


@dataclass(frozen=True)
class SegmentRadiance:
    """Light along R segments as the reference composites it: Gaussians with their peak on one."""

    colors: np.ndarray  # (R, 3) display space, sum of w_i c_i
    transmittances: np.ndarray  # (R,)
    is_close: np.ndarray  # (R,) bool: a decision was taken by less than ``close``, relative


def composite_segments(gaussians, origins, directions, far, close=0.0, **choices):
    """Composite each segment by itself; choices: of ``ImageModel``, such as ``alpha_cut``."""
    model = rays.ImageModel("exact", order="pixel", low_pass=0, **choices)
    given = (each[None] for each in (origins, directions))  # an image of one row
    seen = rays.render_along(gaussians, *given, far=far, model=model, threshold_width=close)
    return SegmentRadiance(seen.image[0], seen.transmittance[0], seen.near_threshold[0])


def num_met(gaussians, origins, directions, far, **choices) -> np.ndarray:
    """Number of Gaussians that each of R segments meets: all have the same small alpha."""
    alpha = 1e-6
    choices |= {"alpha_max": alpha, "transmittance_stop": 0}
    seen = composite_segments(gaussians, origins, directions, far, **choices)
    return np.rint(np.log(seen.transmittances) / np.log1p(-alpha))
