"""Learning rates over the iterations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drgs.config.density import StopAim
from drgs.config.schema import FitConfig, OptimizerConfig


@dataclass(frozen=True)
class ExponentialDecay:
    """A learning rate that falls by the same factor at every iteration.

    rate(i) = initial^(1 - s) final^s with s = i / n clamped to [0, 1]: the reference 3DGS schedule
    of the means. n may be revised on the way: each of ``aims``, (after, end), spreads what is left
    of s at iteration ``after`` until ``end``.
    """

    initial: float
    final: float
    aims: tuple[tuple[int, int], ...]

    def __post_init__(self) -> None:
        """Refuse rates that have no logarithm."""
        if not (self.initial > 0 and self.final > 0 and all(a < b for a, b in self.aims)):
            raise ValueError(
                "ExponentialDecay(): initial and final must be > 0 and each aim's end > after, got "
                f"{self.initial}, {self.final} and {self.aims}"
            )

    def __call__(self, iteration: int) -> float:
        """Return the learning rate of an iteration."""
        s = self.progress(iteration)
        return math.exp((1 - s) * math.log(self.initial) + s * math.log(self.final))

    def progress(self, iteration: int) -> float:
        """s, from 0 to 1."""
        s = 0.0
        for (after, end), until in zip(self.aims, [*self.aims[1:], (math.inf,)], strict=True):
            passed = min(max(iteration, after), until[0]) - after
            s += (1 - s) * min(passed / (end - after), 1.0)
        return s


@dataclass(frozen=True)
class LearningRates:
    """Those of all parameters of the Gaussians, over the iterations.

    The means' rate falls all the time; the others fall to ``decay`` times themselves, by the same
    factor at every iteration, behind the share ``decay_from`` of the iterations that follow coarse
    stages. Rates that are high at first find colours and shapes sooner than constant ones, and
    leave less noise at the end.
    """

    means: ExponentialDecay
    others: Mapping[str, float]  # at the start, by parameter
    decay: float
    decay_from: float  # share of the iterations behind coarse stages

    def __call__(self, iteration: int) -> dict[str, float]:
        """The rates of an iteration that are not those of the start; by parameter."""
        rates = {"means": self.means(iteration)}
        if self.decay < 1:
            late = (self.means.progress(iteration) - self.decay_from) / (1 - self.decay_from)
            factor = self.decay ** max(late, 0.0)
            rates |= {name: factor * rate for name, rate in self.others.items()}
        return rates


def rates_over_time(config: FitConfig, extent: float) -> LearningRates:
    """Of all parameters; extent: world units."""
    optimizer, others = config.optimizer, learning_rates(config.optimizer, extent)
    others.pop("means")
    means = means_rate(config, extent)
    return LearningRates(means, others, optimizer.decay, optimizer.decay_from)


def learning_rates(config: OptimizerConfig, extent: float) -> dict[str, float]:
    """Rate per step of each parameter; extent: world units.

    Steps of B views are sqrt(B) times as long, and moments forget as much in a step as in B steps
    of one view (Malladi et al. 2022, "On the SDEs and Scaling Rules for Adaptive Gradient
    Algorithms"; for splats Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training").
    """
    longer = math.sqrt(config.views_per_step)
    return {
        "means": longer * config.means_lr * extent,
        "quats": longer * config.quats_lr,
        "log_scales": longer * config.scales_lr,
        "logit_opacities": longer * config.opacities_lr,
        "sh0": longer * config.sh0_lr,
        "shN": longer * config.shN_lr,
    }


def rate_aims(config: FitConfig) -> list[tuple[int, int]]:
    """(after, end) of the means' rate: see :class:`drgs.training.rates.ExponentialDecay`."""
    aims = [(aim.after, aim.end) for aim in config.optimizer.means_lr_aims]
    return aims or [aim_until(config, 0, config.iterations)]


def aim_until(config: FitConfig, after: int, end: int) -> tuple[int, int]:
    """What a plan heads for that is made, or revised, after an iteration: (after, end).

    Rates do not fall as long as pictures are coarse, where means have a long way to go
    (DashGaussian, Chen et al. 2025).
    """
    coarse_until = config.coarse[-1].until if config.coarse else 0
    return max(after, min(coarse_until, end - 1)), end


def revised_aims(config: FitConfig, now: int, iterations: int) -> list[tuple[int, int]]:
    """Those of a plan that ends after ``iterations``, where ``now`` of them are done.

    What has begun stays.
    """
    begun = [(after, end) for after, end in rate_aims(config) if after < now]
    if now < iterations:
        begun.append(aim_until(config, now, iterations))
    return begun or rate_aims(config)


def revised_stops(config: FitConfig, now: int, stop: int) -> list[dict[str, int]]:
    """``densify.stop_aims`` of a plan whose growth ends at ``stop``, where ``now`` are done.

    What has begun stays.
    """
    densify = config.densify
    if now == 0:
        return []
    begun = densify.stop_aims
    if stop != densify.stop:
        begun = [aim for aim in begun if aim.after < now] or [StopAim(after=0, stop=densify.stop)]
        begun = [*begun, StopAim(after=now, stop=stop)]
    return [aim.model_dump() for aim in begun]


def means_rate(config: FitConfig, extent: float) -> ExponentialDecay:
    """The rate of the means over the iterations; extent: world units."""
    rates, longer = config.optimizer, math.sqrt(config.optimizer.views_per_step)
    first, last = (longer * rate * extent for rate in (rates.means_lr, rates.means_lr_final))
    return ExponentialDecay(first, last, tuple(rate_aims(config)))
