"""The approximations that a picture is made with, by name.

The configuration (``drgs.config.schema``) and the plugin hold :class:`Approximations`;
``drgs.accuracy.pipeline`` makes a pipeline of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from drgs.core.constants import ALPHA_CUT, ALPHA_MAX, LOW_PASS, TRANSMITTANCE_STOP

PROJECTIONS = ("ewa", "unscented", "exact")
ORDERS = ("center", "pixel")
SH_DIRECTIONS = ("mean", "pixel")


WINDOW = 4
"""Splats that a pixel keeps waiting: see ``drgs.accuracy.pixel_order``."""


@dataclass(frozen=True)
class Approximations:
    """The approximations that a picture is made with; the defaults are those of 3DGS.

    projection: ``ewa``, the affine approximation at the mean; ``unscented``, mean and covariance
    of projected sigma points; ``exact``, the peak of the 3D Gaussian along each pixel's ray.

    order: ``center``, by the depth of the means; ``pixel``, by the depth of the peaks along each
    pixel's ray, re-sorted within ``order_window`` splats.

    sh_direction: ``mean``, colours are seen in the direction of the mean; ``pixel``, in that of
    each pixel.
    """

    projection: str = "ewa"
    order: str = "center"
    order_window: int = WINDOW
    sh_direction: str = "mean"
    alpha_max: float = ALPHA_MAX
    alpha_cut: float = ALPHA_CUT  # 0: none
    transmittance_stop: float = TRANSMITTANCE_STOP  # 0: none
    extent: float = math.inf  # standard deviations at which splats end; inf: at alpha_cut
    low_pass: float = LOW_PASS  # px^2; 0: none
    antialiased: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError for a value that is none of a choice's."""
        for name, known in (
            ("projection", PROJECTIONS),
            ("order", ORDERS),
            ("sh_direction", SH_DIRECTIONS),
        ):
            if getattr(self, name) not in known:
                raise ValueError(
                    f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}"
                )
        for name, expected, holds in (
            ("order_window", "from 1 to 64", 1 <= self.order_window <= 64),
            ("alpha_max", "above 0 and below 1 in float32", 0 < np.float32(self.alpha_max) < 1),
            ("alpha_cut", "from 0 to below 1", 0 <= self.alpha_cut < 1),
            ("transmittance_stop", "from 0 to below 1", 0 <= self.transmittance_stop < 1),
            ("extent", "positive", self.extent > 0),
            ("low_pass", "finite and not negative", 0 <= self.low_pass < math.inf),
        ):
            if not holds:
                raise ValueError(f"{name} must be {expected}, got {getattr(self, name)!r}")

    @staticmethod
    def of(source: Any) -> Approximations:
        """The choices among the attributes of ``source``."""
        return Approximations(**{f.name: getattr(source, f.name) for f in fields(Approximations)})

    @property
    def others_than_default(self) -> dict[str, Any]:
        """What was chosen."""
        default = Approximations()
        return {
            f.name: getattr(self, f.name)
            for f in fields(Approximations)
            if getattr(self, f.name) != getattr(default, f.name)
        }
