"""The section ``densify`` of a configuration, with a section for each density strategy."""

from __future__ import annotations

from typing import Literal, NamedTuple

from pydantic import Field, field_validator

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
    "budget": DEFAULT_SCHEDULE,
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
    """The strategy adc, adaptive density control: clone, split, prune, opacity reset."""

    grad_threshold: float = Field(
        2e-4,
        gt=0,
        description="A Gaussian is cloned or split if the mean norm of its 2D position gradient, "
        "in NDC units, over the views that saw it reaches this.",
    )
    clone_scale: float = Field(
        0.01,
        gt=0,
        description="Cloned if its largest scale is at most this, split if larger; x extent.",
    )
    split_count: int = Field(
        2, ge=2, le=1_000_000, description="Samples that replace a Gaussian that is split."
    )
    split_shrink: float = Field(1.6, gt=1, description="Their scales are the parent's / this.")
    prune_opacity: float = Field(0.005, ge=0, lt=1, description="Removed if less opaque.")
    prune_scale: float = Field(
        0.1,
        gt=0,
        description="Removed after the first reset if its largest scale is larger; x extent.",
    )
    reset_every: Count = Field(
        3000, ge=1, description="Iterations between opacity resets, which end with densify.stop."
    )
    reset_opacity: float = Field(0.01, gt=0, lt=1, description="A reset lowers opacities to this.")
    white_background_reset: Count | None = Field(
        500, ge=1, description="Iteration of an extra reset if the background is white; null: none."
    )


class BudgetConfig(Section):
    """The strategy budget: growth to a number of Gaussians, where errors are."""

    gaussians: Resolved[Count] = Field(
        UNRESOLVED,
        ge=4,
        description="Number at densify.stop. null: 250 times the square root of an image's number "
        "of pixels, 100,000 for 400 x 400 px.",
    )
    error_every: Count = Field(
        10,
        ge=1,
        description="Iterations between measured errors, which take half an iteration.",
    )
    prune_opacity: float = Field(0.005, ge=0, lt=1, description="Removed if less opaque.")


class McmcConfig(Section):
    """The strategy ``mcmc`` (Kheradmand et al. 2024): relocation, noise and regularisers."""

    gaussians: Resolved[Count] = Field(
        UNRESOLVED,
        ge=4,
        description="The population grows to this, and no further. null: as with budget.",
    )
    growth: float = Field(0.05, ge=0, le=10, description="Of the population, at each change.")
    spread: float = Field(
        1.0,
        ge=0,
        le=10,
        description="Distance of copies from their originals, in standard deviations; 0 in the "
        "paper.",
    )
    min_opacity: float = Field(
        0.005, gt=0, lt=1, description="Gaussians that are not more opaque are moved elsewhere."
    )
    noise_lr: float = Field(
        1e5,
        ge=0,
        le=1e12,
        description="Of the noise on means, times their rate and the covariance in squared scene "
        "extents. The paper's, about 1e7, costs 2 dB in small images.",
    )
    opacity_weight: float = Field(
        0.01, ge=0, le=1e6, description="Of the mean opacity, in the loss."
    )
    scale_weight: float = Field(
        0.05, ge=0, le=1e6, description="Of the mean scale, in scene extents, in the loss."
    )


class PruneConfig(Section):
    """The population's last phase: down to a number of Gaussians, after any strategy."""

    to: Count | None = Field(
        None, ge=1, description="Gaussians that are left in the end, at most; null: no such phase."
    )
    method: Literal["selection", "importance"] = Field(
        "selection",
        description="selection: opacities are lowered against the loss until enough Gaussians are "
        "transparent. importance: those that contribute least to images are removed.",
    )
    start: Count | None = Field(
        None,
        ge=1,
        description="Begin after this iteration and densify.stop. null: after densify.stop.",
    )
    stop: Count | None = Field(
        None,
        ge=2,
        description="Iteration of the last change. null: half of the remaining ones.",
    )
    every: Count = Field(50, ge=1, description="Iterations between two changes.")
    opacity: float = Field(
        0.005, gt=0, lt=1, description="selection: Gaussians that become less opaque are removed."
    )
    opacity_rate: float = Field(
        4.0, gt=0, le=100, description="selection: factor of optimizer.opacities_lr meanwhile."
    )


class StopAim(Section):
    """Target of growth after an iteration."""

    after: Count = Field(ge=0, description="The last iteration that is not affected.")
    stop: Count = Field(ge=1, description="What densify.stop was then.")


class DensifyConfig(Section):
    """Changes of the number of Gaussians."""

    strategy: StrategyName = Field(
        "budget",
        description="What changes the population. adc: adaptive density control, as in the paper "
        "(Kerbl et al. 2023); budget: growth to a number of Gaussians, where errors are; mcmc: "
        "relocation and noise, up to a number of Gaussians (Kheradmand et al. 2024). Or the name "
        "of an extension.",
    )
    start: Resolved[Count] = Field(
        REFERENCE_START,
        ge=0,
        description="The population changes only after this iteration. Not given, or null: 500; "
        "less where that is more than half of stop, or, with budget and mcmc, than a twentieth of "
        "all iterations.",
    )
    stop: Resolved[Count] = Field(
        REFERENCE_STOP,
        ge=1,
        description="It changes, and is reset, only before this iteration; with budget, at it for "
        "the last time. Not given, or null: 15,000; less in shorter fits: with budget a half of "
        "the iterations, else 5/7.",
    )
    stop_aims: list[StopAim] = Field(
        default_factory=list,
        description="Earlier values of stop, before revisions of --budget: a list of "
        "{after: iteration, stop: iteration}.",
    )
    every: Count = Field(100, ge=1, description="Iterations between two changes.")
    max_gaussians: int = Field(
        1_000_000, ge=4, le=100_000_000, description="Cap that is never exceeded."
    )
    adc: AdcConfig = subsection(AdcConfig)
    budget: BudgetConfig = subsection(BudgetConfig)
    mcmc: McmcConfig = subsection(McmcConfig)
    prune: PruneConfig = subsection(PruneConfig)

    def stop_at_iteration(self, iteration: int) -> int:
        """Return the value of ``stop`` at this iteration."""
        aims = [aim.stop for aim in self.stop_aims if aim.after < iteration]
        return aims[-1] if aims else self.stop

    @field_validator("stop_aims")
    @classmethod
    def _check_order(cls, aims: list[StopAim]) -> list[StopAim]:
        starts = [aim.after for aim in aims]
        if starts != sorted(set(starts)) or starts[:1] not in ([], [0]):
            raise ValueError("must begin after iteration 0, with growing after")
        return aims

    def prune_window(self, iterations: int) -> tuple[int, int]:
        """Return the iteration after which pruning begins, and that of its last change.

        iterations: of the fit. There is no pruning if it would begin after its end.
        """
        start = max(self.stop, self.prune.start or 0)
        return start, self.prune.stop or (start + iterations + 1) // 2

    def first_fixed_iteration(self, iterations: int) -> int:
        """Return the iteration from which on no row is added or removed; iterations: of the fit."""
        last = self.stop if self.prune.to is None else self.prune_window(iterations)[1]
        return max(self.stop, last) + 1
