"""Growth to a number of Gaussians, the strategy ``budget``.

The number of Gaussians is given: it grows along a curve, not by a threshold. At each change, the
Gaussians with the largest sums of errors are split,

    s_i = sum over pixels of w_i(p) |C(p) - C*(p)|

with the weights w of compositing, measured in every tenth view by default: the adjoint's kernels
compute s with the errors as cotangent. Two halves replace a Gaussian along its longest axis.
Transparent Gaussians are removed, and there are no opacity resets.

The split along the longest axis is from Improved-GS (Deng et al. 2025), the sum of errors from Rota
Bulo et al. 2024 ("Revising Densification in Gaussian Splatting"). Rows are chosen on the host.
Nothing is random, and ties are broken by index.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import drjit as dr
import numpy as np
from pydantic import Field
from scipy.special import expit, logit
from typing_extensions import override

from drgs.config.density import DensifyConfig
from drgs.config.extensions import STRATEGIES
from drgs.config.schema import CoarseStage, FitConfig
from drgs.config.section import UNRESOLVED, Count, Resolved, Section
from drgs.core.arrays import from_host, types_of
from drgs.core.errors import UserError
from drgs.core.types import Float
from drgs.datasets.types import Dataset
from drgs.training.density.strategy import (
    NOT_BEGUN,
    DensityReport,
    DensityStrategy,
    PixelWeight,
    Population,
    StepInfo,
    absolute_errors,
    displace_means,
)

GROWTH_SHARE = 2 / 3
"""Share of the changes after which there are as many as allowed; later ones replace some."""

HALF_OFFSET = 1.35
"""Distance of the halves' means from the Gaussian's, in standard deviations of its longest axis."""

HALF_LONG_SCALE, HALF_SHORT_SCALE = 0.55, 0.893
"""Factors of the halves' scales: along that axis, and along the other two."""

HALF_OPACITY, HALF_OPACITY_RANGE = 0.6, (1e-4, 1 - 1e-4)
"""Factor of the halves' opacities, which overlap; and their range, so that logits stay small."""


class BudgetConfig(Section):
    """The strategy ``budget``: growth to a given number of Gaussians, where errors are largest."""

    gaussians: Resolved[Count] = Field(UNRESOLVED, ge=4)
    """Number of Gaussians after two thirds of the changes. null: 250 times the square root of an
    image's number of pixels, 100,000 for 400 x 400 px."""
    error_every: Count = Field(10, ge=1)
    """Iterations between measurements of errors; each takes half an iteration."""
    prune_opacity: float = Field(0.05, ge=0, lt=1)
    """Replace less opaque Gaussians by halves of others."""


@STRATEGIES.register("budget", section=BudgetConfig)
@dataclass
class GrowthToNumber(DensityStrategy):
    """Splits the Gaussians with the largest errors, up to the number allowed."""

    config: DensifyConfig
    settings: BudgetConfig
    coarse: Sequence[CoarseStage] = ()
    errors: Float = NOT_BEGUN  # (N,): sum over views of s
    first: int = 0  # Gaussians at the start
    by_row = ("errors",)
    stop_share, rate_decay = 3 / 4, 0.03

    @classmethod
    @override
    def from_config(
        cls, config: FitConfig, dataset: Dataset | None, section: BudgetConfig
    ) -> GrowthToNumber:
        return cls(config.densify, section, config.coarse or ())

    @override
    def begin(self, population: Population) -> None:
        self.first = self.first or population.num_rows
        self.errors = population.zeros()

    @override
    def needs_statistics(self, iteration: int) -> bool:
        """Return whether errors count: every so many views, at least once before a change."""
        every, stop = self.settings.error_every, self.config.stop
        if iteration < stop and iteration % every == 0:
            return True
        last_change = (iteration - 1) // self.config.every * self.config.every
        return self.is_due(iteration) and (iteration - 1) // every * every <= last_change

    @override
    def pixel_weights(self, iteration: int) -> Mapping[str, PixelWeight]:
        return {"errors": absolute_errors}

    @override
    def update_statistics(self, step: StepInfo) -> None:
        self.errors = self.errors + step.weighted_sums["errors"]
        dr.eval(self.errors)

    @override
    def is_due(self, iteration: int) -> bool:
        config = self.config
        turn = iteration % config.every == 0 or iteration == config.stop
        return config.start < iteration <= config.stop and turn

    @override
    def refine(self, population: Population, iteration: int) -> DensityReport:
        """Remove transparent Gaussians, and split those with the largest errors."""
        before, least = population.num_rows, self.settings.prune_opacity
        keep = expit(population.host("logit_opacities")) >= least  # NaN is transparent
        if not keep.any():
            raise UserError(
                f"iteration {iteration}: every Gaussian would be pruned (opacity below densify."
                f"budget.prune_opacity = {least}): do the cameras see the start points?"
            )
        kept = int(np.count_nonzero(keep))
        room = max(0, self.goal(iteration) - kept)
        errors = np.where(keep, population.gather(self.errors), 0)
        candidates = np.flatnonzero(errors > 0)
        candidates = candidates[np.argsort(-errors[candidates], kind="stable")]
        split = np.sort(candidates[:room])
        if len(split) > 0 or kept < before:
            keep[split] = False
            rows = population.to_device_indices(np.flatnonzero(keep))
            population.edit(rows, halves(population, split) if len(split) > 0 else None)
        self.begin(population)
        return DensityReport(
            num_gaussians=population.num_rows,
            num_added=len(split),
            split=len(split),
            pruned=before - kept,
            refused=self._uncapped_goal(iteration) - self.goal(iteration),
        )

    def goal(self, iteration: int) -> int:
        """Return the number of Gaussians after the change of this iteration."""
        return min(self._uncapped_goal(iteration), max(self.config.max_gaussians, self.first))

    def _uncapped_goal(self, iteration: int) -> int:
        """N_0 + (N - N_0) u / r^(2 - u), where u rises from 0 at ``start`` to 1.

        u is 1 after ``GROWTH_SHARE`` of the time until ``stop``.

        r: what the images' sizes are divided by: coarse images need fewer (DashGaussian, Chen
        et al. 2025). 1 at ``stop``: no change comes after it.
        """
        start, stop = self.config.start, self.config.stop
        u = min(max((iteration - start) / max(GROWTH_SHARE * (stop - start), 1), 0), 1)
        size = next((stage.factor for stage in self.coarse if iteration <= stage.until), 1)
        r = size if iteration < stop else 1
        final = max(self.settings.gaussians, self.first)
        return self.first + round((final - self.first) * u / r ** (2 - u))

    @override
    def state(self) -> dict[str, np.ndarray]:
        return {**super().state(), "first": np.array(self.first)}

    @override
    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        super().restore(state)
        self.first = int(state["first"])

    @override
    def max_num_gaussians(self, start: int, iterations: int) -> int:
        return max(start, min(self.settings.gaussians, self.config.max_gaussians))


def halves(population: Population, rows: np.ndarray) -> dict[str, dr.ArrayBase]:
    """Return both halves of ``rows``, the first ones first, on each side along the longest axis."""
    twice = np.tile(rows, 2)
    new = population.take(population.to_device_indices(twice))
    longest = population.host("log_scales")[twice].argmax(axis=1)
    offsets = np.zeros((len(twice), 3))
    offsets[np.arange(len(twice)), longest] = np.repeat([HALF_OFFSET, -HALF_OFFSET], len(rows))
    factors = np.where(offsets != 0, HALF_LONG_SCALE, HALF_SHORT_SCALE)
    opacities = HALF_OPACITY * expit(population.host("logit_opacities")[twice])
    opacities = np.clip(opacities, *HALF_OPACITY_RANGE)

    t = types_of(type(new["logit_opacities"]))
    log_factors = t.TensorXf(from_host(t.Float, np.log(factors)), factors.shape)
    return {
        **new,
        "means": displace_means(new, offsets),
        "log_scales": new["log_scales"] + log_factors,
        "logit_opacities": from_host(t.Float, logit(opacities)),
    }
