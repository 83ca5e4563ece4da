"""Learning rates over the iterations, and plans that are revised on the way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drgs.config.changes import with_changes
from drgs.config.density import StopAim
from drgs.config.schema import FitConfig

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
        """Return s, from 0 to 1."""
        s = 0.0
        for (after, end), until in zip(self.aims, [*self.aims[1:], (math.inf,)], strict=True):
            passed = min(max(iteration, after), until[0]) - after
            s += (1 - s) * min(passed / (end - after), 1.0)
        return s


@dataclass(frozen=True)
class LearningRates:
    """The rates of all parameters of the Gaussians, over the iterations.

    The means' rate decays from the start; the others decay to ``decay`` times their initial value,
    by a constant factor per iteration, after the share ``decay_from`` of the iterations that follow
    coarse stages.
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
    first, last = (
        longer * rate * extent for rate in (optimizer.means_lr, optimizer.means_lr_final)
    )
    others = {
        "quats": longer * optimizer.quats_lr,
        "log_scales": longer * optimizer.scales_lr,
        "logit_opacities": longer * optimizer.opacities_lr,
        "sh0": longer * optimizer.sh0_lr,
        "shN": longer * optimizer.shN_lr,
    }
    means = ExponentialDecay(first, last, tuple(_rate_aims(config)))
    return LearningRates(means, others, optimizer.decay, optimizer.decay_from)


def revised_plan(config: FitConfig, now: int, iterations: int, densify_stop: int) -> FitConfig:
    """Return the configuration with other last iterations of the fit and of population changes.

    The ``now`` iterations so far are the same with the result from the start.
    """
    begun = [(after, end) for after, end in _rate_aims(config) if after < now]
    if now < iterations:
        begun.append(_aim(config, now, iterations))
    changes = {
        "iterations": iterations,
        "densify.stop": densify_stop,
        **_prune_window(config, now, iterations, densify_stop),
        "densify.stop_aims": revised_stops(config, now, densify_stop),
        "optimizer.means_lr_aims": [
            {"after": after, "end": end} for after, end in begun or _rate_aims(config)
        ],
    }
    return with_changes(config, changes)


def _rate_aims(config: FitConfig) -> list[tuple[int, int]]:
    aims = [(aim.after, aim.end) for aim in config.optimizer.means_lr_aims]
    return aims or [_aim(config, 0, config.iterations)]


def _aim(config: FitConfig, after: int, end: int) -> tuple[int, int]:
    """Return the aim, (after, end), of a plan that is made, or revised, after an iteration.

    Rates do not fall while images are coarse, since means move far then
    (DashGaussian, Chen et al. 2025).
    """
    coarse_until = config.coarse[-1].until if config.coarse else 0
    return max(after, min(coarse_until, end - 1)), end


def revised_stops(config: FitConfig, now: int, stop: int) -> list[dict[str, int]]:
    """Return ``densify.stop_aims`` of a plan whose growth ends at ``stop``; ``now`` are done."""
    densify = config.densify
    if now == 0:
        return []
    begun = densify.stop_aims
    if stop != densify.stop:
        begun = [aim for aim in begun if aim.after < now] or [StopAim(after=0, stop=densify.stop)]
        begun = [*begun, StopAim(after=now, stop=stop)]
    return [aim.model_dump() for aim in begun]


def _prune_window(
    config: FitConfig, now: int, iterations: int, densify_stop: int
) -> dict[str, int | None]:
    """Return the last phase of pruning: unchanged if it has begun, else with its share of the
    rest."""
    prune, names = config.densify.prune, ("densify.prune.start", "densify.prune.stop")
    window = config.densify.prune_window(config.iterations)
    if prune.to is None:
        return {}
    if now > window[0]:
        return dict(zip(names, window, strict=True))
    start, stop = (
        None if given is None else round(given * iterations / config.iterations)
        for given in (prune.start, prune.stop)
    )
    if start is not None:
        start = max(1, start, now)
    if stop is not None:
        stop = max(stop, densify_stop + 1, (start or 0) + 1)
    return dict(zip(names, (start, stop), strict=True))
