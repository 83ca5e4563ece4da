"""Learning rates over the iterations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drgs.config.schema import FitConfig
from drgs.gaussians.parameters import PARAMETER_NAMES

TOUCH_UP_RATES = {
    "means_lr": 1.6e-5,
    "means_lr_final": 1.6e-5,
    "quats_lr": 4e-3,
    "scales_lr": 0.02,
    "opacities_lr": 0.07,
    "sh0_lr": 0.03,
    "shN_lr": 4e-3,
    "decay": 0.1,
}
"""Learning rates of a few iterations after a fit: high because they are few."""

RATE_KEYS = {name: f"{name.rpartition('_')[2]}_lr" for name in PARAMETER_NAMES}
"""Names of the initial learning rates in the section ``optimizer``, by parameter."""


@dataclass(frozen=True)
class ExponentialDecay:
    """A learning rate that falls by the same factor at every iteration from ``start`` to ``end``.

    rate(i) = initial^(1 - s) final^s with s = (i - start) / (end - start) clamped to [0, 1]: the
    reference 3DGS schedule of the means.
    """

    initial: float
    final: float
    start: int
    end: int

    def __post_init__(self) -> None:
        """Refuse rates that have no logarithm."""
        if not (self.initial > 0 and self.final > 0 and self.start < self.end):
            raise ValueError(
                "ExponentialDecay(): initial and final must be > 0 and end > start, got "
                f"{self.initial}, {self.final}, {self.end} and {self.start}"
            )

    def __call__(self, iteration: int) -> float:
        """Return the learning rate of an iteration."""
        s = self.progress(iteration)
        return math.exp((1 - s) * math.log(self.initial) + s * math.log(self.final))

    def progress(self, iteration: int) -> float:
        """Return s, from 0 to 1."""
        return min(max(iteration - self.start, 0) / (self.end - self.start), 1.0)


@dataclass(frozen=True)
class LearningRates:
    """The rates of all parameters of the Gaussians, over the iterations.

    The means' rate decays from the start; the others decay to ``decay`` times their initial value,
    by a constant factor per iteration, after a share ``decay_from`` of those after coarse stages.
    """

    means: ExponentialDecay
    others: Mapping[str, float]  # at the start, by parameter
    decay: float
    decay_from: float  # share of the iterations after coarse stages

    def __call__(self, iteration: int) -> dict[str, float]:
        """Return the rates of an iteration, by parameter."""
        late = (self.means.progress(iteration) - self.decay_from) / (1 - self.decay_from)
        factor = self.decay ** max(late, 0.0)
        others = {name: factor * rate for name, rate in self.others.items()}
        return {"means": self.means(iteration), **others}


def rates_over_time(config: FitConfig, extent: float) -> LearningRates:
    """Return the rates per step of all parameters; extent: world units.

    Steps of B views are sqrt(B) times as long, and moments forget as much in a step as in B steps
    of one view (Malladi et al. 2022, "On the SDEs and Scaling Rules for Adaptive Gradient
    Algorithms"; for splats Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training").
    """
    optimizer = config.optimizer
    longer = math.sqrt(optimizer.views_per_step)
    last = longer * optimizer.means_lr_final * extent
    others = {name: longer * getattr(optimizer, key) for name, key in RATE_KEYS.items()}
    first = others.pop("means") * extent
    # Rates do not fall while images are coarse, since means move far then
    # (DashGaussian, Chen et al. 2025).
    coarse_until = config.coarse[-1].until if config.coarse else 0
    start = min(coarse_until, config.iterations - 1)
    means = ExponentialDecay(first, last, start, config.iterations)
    return LearningRates(means, others, optimizer.decay, optimizer.decay_from)
