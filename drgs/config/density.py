"""The section ``densify`` of a configuration, with a section for each density strategy."""

from __future__ import annotations

from typing import Literal, NamedTuple

from pydantic import Field

from drgs.config.extensions import STRATEGIES, StrategyName
from drgs.config.section import UNRESOLVED, Count, Resolved, Section, subsection

REFERENCE_START, REFERENCE_STOP = 500, 15_000  # iterations: the reference's schedule, for 30,000


class Schedule(NamedTuple):
    """Defaults of a strategy: see ``drgs.training.density.strategy.DensityStrategy``."""

    start_share: float  # of the iterations
    stop_share: float
    rate_decay: float = 0.1  # of the learning rates, over the fit


DEFAULT_SCHEDULE = Schedule(1 / 20, 1 / 2)

SCHEDULES = {
    "adc": Schedule(1 / 2, 5 / 7, rate_decay=1.0),
    "budget": Schedule(1 / 20, 3 / 4, rate_decay=0.03),
    "mcmc": Schedule(1 / 20, 5 / 7),
}
"""Schedules by strategy. Of 7,000 iterations, adc leaves 2,000 for the last opacities to settle."""


def schedule_of(strategy: str) -> Schedule:
    """Return the defaults of a strategy; no shipped one is imported."""
    if strategy in SCHEDULES:
        return SCHEDULES[strategy]
    extension = STRATEGIES.get(strategy).value
    return Schedule(extension.start_share, extension.stop_share, extension.rate_decay)


class AdcConfig(Section):
    """The strategy ``adc``, adaptive density control: clone, split, prune, opacity reset."""

    grad_threshold: float = Field(
        2e-4,
        gt=0,
        description="Clone or split a Gaussian whose 2D position gradient has at least this mean "
        "norm, in NDC units, over the views that it is visible in.",
    )
    clone_scale: float = Field(
        0.01,
        gt=0,
        description="Clone up to this largest scale, split above it; in scene extents.",
    )
    split_count: int = Field(
        2, ge=2, le=1_000_000, description="Number of samples that replace a split Gaussian."
    )
    split_shrink: float = Field(1.6, gt=1, description="Divisor of the samples' scales.")
    prune_opacity: float = Field(0.005, ge=0, lt=1, description="Remove less opaque Gaussians.")
    prune_scale: float = Field(
        0.1,
        gt=0,
        description="Remove Gaussians of a larger scale after the first reset; in scene extents.",
    )
    reset_every: Count = Field(
        3000, ge=1, description="Iterations between opacity resets, up to densify.stop."
    )
    reset_opacity: float = Field(0.01, gt=0, lt=1, description="Maximum opacity after a reset.")
    white_background_reset: Count | None = Field(
        500, ge=1, description="Iteration of an extra reset if the background is white; null: none."
    )


class BudgetConfig(Section):
    """The strategy ``budget``: growth to a given number of Gaussians, where errors are largest."""

    gaussians: Resolved[Count] = Field(
        UNRESOLVED,
        ge=4,
        description="Number of Gaussians after two thirds of the changes. null: 250 times the "
        "square root of an image's number of pixels, 100,000 for 400 x 400 px.",
    )
    error_every: Count = Field(
        10,
        ge=1,
        description="Iterations between measurements of errors; each takes half an iteration.",
    )
    prune_opacity: float = Field(
        0.05, ge=0, lt=1, description="Replace less opaque Gaussians by halves of others."
    )


class McmcConfig(Section):
    """The strategy ``mcmc`` (Kheradmand et al. 2024): relocation, noise and regularisers."""

    gaussians: Resolved[Count] = Field(
        UNRESOLVED,
        ge=4,
        description="Final number of Gaussians. null: as with budget.",
    )
    growth: float = Field(
        0.05, ge=0, le=10, description="Relative growth of the population at each change."
    )
    spread: float = Field(
        1.0,
        ge=0,
        le=10,
        description="Displacement of copies, in standard deviations; 0 in the paper.",
    )
    min_opacity: float = Field(
        0.005, gt=0, lt=1, description="Relocate Gaussians up to this opacity."
    )
    noise_lr: float = Field(
        1e5,
        ge=0,
        le=1e12,
        description="Factor of the noise on means, times their rate and the covariance in squared "
        "scene extents. The paper's value, about 1e7, costs 2 dB in small images.",
    )
    opacity_weight: float = Field(
        0.01, ge=0, le=1e6, description="Weight of the mean opacity in the loss."
    )
    scale_weight: float = Field(
        0.05, ge=0, le=1e6, description="Weight of the mean scale, in scene extents, in the loss."
    )


class PruneConfig(Section):
    """Pruning to a given number of Gaussians, after any strategy."""

    to: Count | None = Field(
        None, ge=1, description="Maximum number of Gaussians at the end; null: no pruning."
    )
    method: Literal["selection", "importance"] = Field(
        "selection",
        description="selection: opacities are lowered against the loss until enough Gaussians are "
        "transparent. importance: Gaussians that contribute least to images are removed.",
    )
    start: Count | None = Field(
        None,
        ge=1,
        description="Iteration after which it begins, at least densify.stop. null: densify.stop.",
    )
    stop: Count | None = Field(
        None,
        ge=2,
        description="Iteration of the last change. null: half of the remaining ones.",
    )
    every: Count = Field(50, ge=1, description="Iterations between two changes.")
    opacity: float = Field(
        0.005, gt=0, lt=1, description="selection: remove less opaque Gaussians."
    )
    opacity_rate: float = Field(
        4.0,
        gt=0,
        le=100,
        description="selection: factor of optimizer.opacities_lr during this phase.",
    )


class DensifyConfig(Section):
    """Changes of the number of Gaussians."""

    strategy: StrategyName = Field(
        "budget",
        description="How the population changes. adc: adaptive density control, as in the paper "
        "(Kerbl et al. 2023); budget: growth to a given number of Gaussians, where errors are "
        "largest; mcmc: relocation and noise (Kheradmand et al. 2024). Or the name of an "
        "extension.",
    )
    start: Resolved[Count] = Field(
        REFERENCE_START,
        ge=0,
        description="Last iteration before the first change. Not given, or null: 500, but at most "
        "half of stop and, with budget and mcmc, a twentieth of all iterations.",
    )
    stop: Resolved[Count] = Field(
        REFERENCE_STOP,
        ge=1,
        description="Changes and resets end before this iteration; with budget, the last change is "
        "at this iteration. Not given, or null: 3/4 of the iterations with budget, else 5/7 of "
        "them; with adc at most 15,000.",
    )
    every: Count = Field(100, ge=1, description="Iterations between two changes.")
    max_gaussians: int = Field(
        1_000_000, ge=4, le=100_000_000, description="Limit that the population never exceeds."
    )
    remove_floaters: bool = Field(
        True,
        description="Remove Gaussians close before a few cameras, after 50, 70 and 90 % of the "
        "iterations.",
    )
    adc: AdcConfig = subsection(AdcConfig)
    budget: BudgetConfig = subsection(BudgetConfig)
    mcmc: McmcConfig = subsection(McmcConfig)
    prune: PruneConfig = subsection(PruneConfig)

    def prune_window(self, iterations: int) -> tuple[int, int]:
        """Return the iteration after which pruning begins, and that of its last change.

        iterations: of the fit. There is no pruning if it would begin after its end.
        """
        start = max(self.stop, self.prune.start or 0)
        return start, self.prune.stop or (start + iterations + 1) // 2

    def first_fixed_iteration(self, iterations: int) -> int:
        """Return the first iteration after the last change of rows; iterations: of the fit."""
        last = self.stop if self.prune.to is None else self.prune_window(iterations)[1]
        return max(self.stop, last) + 1
