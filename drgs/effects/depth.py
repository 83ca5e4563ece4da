"""Supervision by the depth that the data has.

Dr.Jit differentiates a gather by adding atomically, in an order that no two runs share: here, as in
``colors.py``, operations on pixels have adjoints that scatter nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import drjit as dr
import numpy as np
from typing_extensions import override

from drgs.config.extensions import EFFECTS
from drgs.core.arrays import image_of, planes_of
from drgs.core.types import Float, TensorXf
from drgs.effects.base import SimulatedEffect, TrainingEffect, as_numbers

if TYPE_CHECKING:
    from drgs.config.schema import FitConfig
    from drgs.datasets.types import Dataset, View
    from drgs.training.views import TrainingView


@EFFECTS.register("depth")
class DepthSupervision(TrainingEffect):
    """Penalty on the difference between the composited depth and the data's.

    The term is weight / extent times the mean of |D - A d| over the pixels whose depth d is known
    and not masked, D being the alpha-weighted sum of the splats' depths and A the alpha.
    """

    order = -10  # the others get the colours only
    aovs = "depth:depth, alpha:alpha"
    upload_bytes = 8

    @classmethod
    @override
    def summarize(cls, config: FitConfig, dataset: Dataset) -> list[SimulatedEffect]:
        depths = [view.depth for view in dataset.train]
        effect = SimulatedEffect.from_data("depth", depths, "supervision")
        effect = effect.unless_ignored(config.loss.depth_weight == 0)
        return [replace(effect, ignored=effect.ignored or "depth" in dataset.ignored)]

    @classmethod
    @override
    def from_config(cls, config: FitConfig, dataset: Dataset, section: None) -> DepthSupervision:
        return cls(config.loss.depth_weight, dataset.extent)

    def __init__(self, weight: float, extent: float) -> None:
        """weight: of the term, per scene extent."""
        self.weight = weight / extent
        self.depths: TensorXf  # depth and alpha, of the view that is rendered

    @override
    def upload(self, view: View) -> tuple[Float, Float] | None:
        """Return depths, and weights of the pixels; None for a view without any."""
        if view.depth is None:
            return None
        depth = np.asarray(view.depth)
        known = depth > 0
        if view.mask is not None:
            known &= np.asarray(view.mask) > 0
        if not known.any():
            return None
        weights = self.weight * known / known.sum()
        return as_numbers(depth), as_numbers(weights)

    @override
    def adjust(self, image: TensorXf, view: TrainingView) -> TensorXf:
        """Return the colours; depth and alpha are kept for the penalty."""
        image, self.depths = split(image, 3)
        return image

    @override
    def penalties(self, view: TrainingView) -> Iterator[Float]:
        """Yield the difference in depth."""
        if (known := view.uploads[self.name]) is not None:
            yield depth_error(self.depths, *known)


def split(image: TensorXf, count: int) -> tuple[TensorXf, TensorXf]:
    """Return the first ``count`` channels of an image (H, W, C), and the rest."""
    return dr.custom(_Split, image=image, count=count)


class _Split(dr.CustomOp):
    @override
    def eval(self, image: TensorXf, count: int) -> tuple[TensorXf, TensorXf]:
        self.count = count
        planes = planes_of(image)
        return image_of(planes[:count], image), image_of(planes[count:], image)

    @override
    def forward(self) -> None:
        self.set_grad_out(self.eval(cast(TensorXf, self.grad_in("image")), self.count))

    @override
    def backward(self) -> None:
        first, rest = cast("tuple[TensorXf, TensorXf]", self.grad_out())
        self.set_grad_in("image", image_of(planes_of(first) + planes_of(rest), first))


def depth_error(depths: TensorXf, target: Float, weights: Float) -> Float:
    """Return sum_i w_i |D_i - A_i d_i| over pixels, a Float of one value.

    depths: (H, W, 2), D and A; target: d, Float (H * W,); weights: w, Float (H * W,). The
    derivative of |x| at 0 is taken as 0. Not differentiated: target and weights.
    """
    return dr.custom(_DepthError, depths=depths, target=target, weights=weights)


class _DepthError(dr.CustomOp):
    @override
    def eval(self, depths: TensorXf, target: Float, weights: Float) -> Float:
        self.like, self.target, self.weights = dr.detach(depths), target, weights
        depth, alpha = planes_of(depths)
        difference = dr.fma(-alpha, target, depth)
        self.slope = weights * dr.select(difference == 0, 0, dr.sign(difference))
        return dr.sum(weights * dr.abs(difference))

    @override
    def forward(self) -> None:
        d_depth, d_alpha = planes_of(cast(TensorXf, self.grad_in("depths")))
        self.set_grad_out(dr.sum(self.slope * dr.fma(-d_alpha, self.target, d_depth)))

    @override
    def backward(self) -> None:
        g = self.slope * cast(Float, self.grad_out())
        self.set_grad_in("depths", image_of([g, -g * self.target], self.like))
