"""What accuracy a picture is made with: named choices, and the pipeline that follows from them.

Layer 3. The configuration (``drgs.config``) and the plugin hold :class:`Choices`. Everything but
the defaults is in modules of its own, imported when it is chosen: what is not chosen costs nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from drgs.constants import ALPHA_CUT, ALPHA_MAX, LOW_PASS, TRANSMITTANCE_STOP
from drgs.cutoffs import Cutoffs
from drgs.image_model import DEFAULT, ImageModel
from drgs.projection import color_at_mean, compensated_opacity, ewa, plain_opacity
from drgs.rendering import CenterOrder, Pipeline

PROJECTIONS = ("ewa", "unscented", "exact")
ORDERS = ("center", "pixel")
SH_DIRECTIONS = ("mean", "pixel")

LEAST_STOP = 1e-30
"""Where no stop is asked for: past it float32 has no transmittance to go back from."""

WINDOW = 4
"""Splats that a pixel keeps waiting: see ``drgs.pixel_order``."""


@dataclass(frozen=True)
class Choices:
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
    def of(source: Any) -> Choices:
        """The choices among the attributes of ``source``."""
        return Choices(**{f.name: getattr(source, f.name) for f in fields(Choices)})

    @property
    def others_than_default(self) -> dict[str, Any]:
        """What was chosen."""
        default = Choices()
        return {
            f.name: getattr(self, f.name)
            for f in fields(Choices)
            if getattr(self, f.name) != getattr(default, f.name)
        }

    def pipeline(self, sh_degree: int, **others: Any) -> Pipeline:
        """What renders with these choices; others: further fields of the pipeline."""
        stop = max(self.transmittance_stop, LEAST_STOP)
        cutoffs = Cutoffs(self.alpha_max, self.alpha_cut, stop, self.extent)
        model = DEFAULT if cutoffs == Cutoffs() else ImageModel(cutoffs=cutoffs)
        shape, order, color = ewa, CenterOrder(), color_at_mean
        if self.projection == "exact":
            from drgs.perspective import RayResponse, exact

            shape, model = exact, replace(model, response=RayResponse())
        elif self.projection == "unscented":
            from drgs.unscented import unscented

            shape = unscented
        if self.order == "pixel":
            from drgs.pixel_order import PixelOrder

            shape, depths = self._with_depths(shape)
            order = PixelOrder(self.order_window, depths)
        if self.sh_direction == "pixel":
            from drgs.ray_colors import RayColors, stored_coefficients

            color, model = stored_coefficients, replace(model, features=RayColors(sh_degree))
        return Pipeline(
            sh_degree=sh_degree,
            opacity_rule=compensated_opacity if self.antialiased else plain_opacity,
            shape=shape,
            color=color,
            low_pass=self.low_pass,
            model=model,
            order=order,
            **others,
        )

    def _with_depths(self, shape: Any) -> tuple[Any, Any]:
        """A projection that knows depths at a pixel, and who computes them."""
        from drgs.perspective import ewa_with_depth
        from drgs.pixel_order import AffineDepths, RayDepths

        if self.projection == "exact":
            return shape, RayDepths()
        if self.projection == "unscented":
            from drgs.unscented import unscented_with_depth

            return unscented_with_depth, AffineDepths()
        return ewa_with_depth, AffineDepths()
