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
