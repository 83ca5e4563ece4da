"""Adaptive density control, the strategy ``adc``: clone, split, prune and the opacity reset.

Section 5 of the 3DGS paper (Kerbl et al. 2023) with the details of its reference implementation,
except where a docstring states otherwise. Rows are chosen on the host; ties are broken by index.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, cast

import drjit as dr
import numpy as np
from pydantic import Field
from scipy.special import expit
from typing_extensions import override

from drgs.config.density import REFERENCE_STOP
from drgs.config.extensions import STRATEGIES
from drgs.config.schema import DensifyConfig, FitConfig
from drgs.config.section import Count, Section
from drgs.core.arrays import from_host, types_of
from drgs.core.errors import UserError
from drgs.core.types import Array2f, Float
from drgs.datasets.types import Dataset
from drgs.training.density.strategy import (
    NOT_BEGUN,
    DensityReport,
    DensityStrategy,
    Population,
    StepInfo,
    displace_means,
)


class AdcConfig(Section):
    """The strategy ``adc``, adaptive density control: clone, split, prune, opacity reset."""

    scaled: ClassVar = ("reset_every", "white_background_reset")

    grad_threshold: float = Field(2e-4, gt=0)
    """Clone or split a Gaussian whose 2D position gradient has at least this mean norm, in NDC
    units, over the views that it is visible in."""
    clone_scale: float = Field(0.01, gt=0)
    """Clone up to this largest scale, split above it; in scene extents."""
    split_count: int = Field(2, ge=2, le=1_000_000)
    """Number of samples that replace a split Gaussian."""
    split_shrink: float = Field(1.6, gt=1)
    """Divisor of the samples' scales."""
    prune_opacity: float = Field(0.005, ge=0, lt=1)
    """Remove less opaque Gaussians."""
    prune_scale: float = Field(0.1, gt=0)
    """Remove Gaussians of a larger scale after the first reset; in scene extents."""
    reset_every: Count = Field(3000, ge=1)
    """Iterations between opacity resets, up to densify.stop."""
    reset_opacity: float = Field(0.01, gt=0, lt=1)
    """Maximum opacity after a reset."""
    white_background_reset: Count | None = Field(500, ge=1)
    """Iteration of an extra reset if the background is white; null: none."""

    @override
    def check(self, config: FitConfig) -> None:
        """Refuse resets that remove everything."""
        if self.prune_opacity >= self.reset_opacity:
            raise ValueError(
                "densify.adc.prune_opacity must be < densify.adc.reset_opacity "
                f"({self.reset_opacity}), or a reset removes everything, got {self.prune_opacity}"
            )


@STRATEGIES.register("adc", section=AdcConfig)
@dataclass
class AdaptiveDensityControl(DensityStrategy):
    """Clones and splits where gradients are large, prunes transparent and large Gaussians."""

    config: DensifyConfig
    settings: AdcConfig
    white_background: bool = False
    gradient_norms: Float = NOT_BEGUN  # (N,): sum over views of |d loss / d mean2d| in NDC units
    views: Float = NOT_BEGUN  # (N,): number of views in which the Gaussian was visible
    by_row = ("gradient_norms", "views")
    # Of 7,000 iterations, 2,000 are left for the last opacities to settle.
    start_share, stop_share, latest_stop, rate_decay = 1 / 2, 5 / 7, REFERENCE_STOP, 1.0
    begins_coarse = False

    @classmethod
    @override
    def from_config(
        cls, config: FitConfig, dataset: Dataset | None, section: AdcConfig
    ) -> AdaptiveDensityControl:
        is_white = dataset is not None and tuple(dataset.background) == (1.0, 1.0, 1.0)
        return cls(config.densify, section, is_white)

    @override
    def begin(self, population: Population) -> None:
        self.gradient_norms, self.views = population.zeros(), population.zeros()

    @override
    def needs_statistics(self, iteration: int) -> bool:
        return iteration < self.config.stop

    @override
    def update_statistics(self, step: StepInfo) -> None:
        """Add a view's gradients; times (W/2, H/2), they are in NDC units, as the threshold."""
        gradient = step.means2d_grad
        if dr.is_tensor_v(gradient):
            gradient = dr.unravel(types_of(type(gradient.array)).Array2f, gradient.array)
        means2d = cast(Array2f, gradient)
        x, y = means2d.x * (0.5 * step.width), means2d.y * (0.5 * step.height)
        norm = dr.sqrt(dr.square(x) + dr.square(y))
        self.gradient_norms = self.gradient_norms + dr.select(step.visible, norm, 0)
        self.views = self.views + dr.select(step.visible, 1, 0)
        dr.eval(self.gradient_norms, self.views)

    @override
    def is_due(self, iteration: int) -> bool:
        return self.densifies(iteration) or self.resets(iteration)

    def densifies(self, iteration: int) -> bool:
        """Return whether the population changes after this iteration."""
        config = self.config
        return config.start < iteration < config.stop and iteration % config.every == 0

    def resets(self, iteration: int) -> bool:
        """Return whether opacities are lowered after this iteration: only while densifying.

        White backgrounds get one more: white Gaussians in front of white would otherwise stay.
        """
        adc = self.settings
        is_extra = self.white_background and iteration == adc.white_background_reset
        return iteration < self.config.stop and (iteration % adc.reset_every == 0 or is_extra)

    @override
    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Clone, split and prune, then lower opacities, each where it is due."""
        report = None
        if self.densifies(iteration):
            report = self.densify_and_prune(population, iteration)
            self.begin(population)
        if self.resets(iteration):
            self.reset_opacities(population)
        return report

    def densify_and_prune(self, population: Population, iteration: int) -> DensityReport:
        """Clone, split and prune.

        A Gaussian whose mean gradient norm reaches the threshold is cloned in place if it is small;
        otherwise it is replaced by samples of itself, which are smaller. Of more candidates than
        ``max_gaussians`` has room for, those with the largest gradients are taken. Rows end up as:
        survivors in their order, clones, samples.

        Added rows are spared by the prune of the same step. Hence a Gaussian that is too
        transparent is never cloned or split: its copies, as transparent as itself, would stay.

        Raises ``UserError`` if no Gaussian would remain: such a fit cannot recover.
        """
        adc, num_before = self.settings, population.num_rows
        chosen = self._choose_rows(population, iteration)
        num_added = len(chosen.clone) + len(chosen.split) * adc.split_count
        if len(chosen.keep) + num_added == 0:
            raise UserError(
                f"iteration {iteration}: every Gaussian would be pruned (opacity below densify.adc."
                f"prune_opacity = {adc.prune_opacity}, or scale above densify.adc.prune_scale = "
                f"{adc.prune_scale} x {population.extent:g}): do the cameras see the start points?"
            )
        if num_added > 0 or len(chosen.keep) < num_before:
            append = self._new_rows(population, chosen, iteration) if num_added > 0 else None
            population.edit(population.to_device_indices(chosen.keep), append)
        return DensityReport(
            num_added=num_added - len(chosen.split),
            cloned=len(chosen.clone),
            split=len(chosen.split),
            pruned=num_before - len(chosen.keep) - len(chosen.split),
            refused=chosen.num_refused,
            num_gaussians=len(chosen.keep) + num_added,
        )

    def reset_opacities(self, population: Population) -> None:
        """Lower opacities to at most ``reset_opacity``; without moments, floaters stay there."""
        opacity = self.settings.reset_opacity
        ceiling = math.log(opacity / (1 - opacity))
        logits = population.value("logit_opacities")
        population.replace("logit_opacities", dr.select(logits > ceiling, ceiling, logits))

    @override
    def max_num_gaussians(self, start: int, iterations: int) -> int:
        """Return ``max_gaussians``, or fewer if changes that double the rows do not reach it."""
        config, last = self.config, min(iterations, self.config.stop - 1)
        changes = max(0, last // config.every - config.start // config.every)
        doublings = math.log2(max(config.max_gaussians, start) / start)
        if changes * math.log2(self.settings.split_count) >= doublings:
            return max(start, config.max_gaussians)
        return start * self.settings.split_count**changes

    def _choose_rows(self, population: Population, iteration: int) -> _ChosenRows:
        """Decide about every row.

        Comparisons are written such that NaN counts as transparent and as too large. Large ones are
        pruned once the first regular opacity reset is over.
        """
        config, adc, extent = self.config, self.settings, population.extent
        views = np.maximum(np.array(self.views, float), 1)
        norms = population.gather(np.array(self.gradient_norms, float) / views)
        with np.errstate(over="ignore"):
            scales = np.exp(population.host("log_scales")).max(axis=1)  # largest deviations
        opacities = expit(population.host("logit_opacities"))
        small = scales <= adc.clone_scale * extent
        transparent = ~(opacities >= adc.prune_opacity)
        limit = adc.prune_scale * extent if iteration > adc.reset_every else np.inf
        too_large = ~(scales <= limit)
        candidate = (norms >= adc.grad_threshold) & ~transparent & np.isfinite(scales)
        candidate &= ~(small & too_large)  # a clone would be as large

        # Conservative: the remaining number if every candidate survives.
        survivors = np.count_nonzero(candidate | ~(transparent | too_large))
        rows = np.flatnonzero(candidate)
        rows = rows[np.argsort(-norms[rows], kind="stable")]
        cost = np.where(small[rows], 1, adc.split_count - 1)
        affordable = rows[np.cumsum(cost) <= config.max_gaussians - survivors]

        taken = np.zeros_like(candidate)
        taken[affordable] = True
        split = taken & ~small
        return _ChosenRows(
            keep=np.flatnonzero(~(split | transparent | too_large)),
            clone=np.flatnonzero(taken & small),
            split=np.flatnonzero(split),
            num_refused=len(rows) - len(affordable),
        )

    def _new_rows(
        self, population: Population, chosen: _ChosenRows, iteration: int
    ) -> dict[str, dr.ArrayBase]:
        """Return the clones, then ``split_count`` samples of each row that is split.

        A sample of its parent is mean + R(q) (s * n), n standard normal; a clone has n = 0.
        """
        num_clones = len(chosen.clone)
        samples_of = np.repeat(chosen.split, self.settings.split_count)
        normals = np.zeros((num_clones + len(samples_of), 3))
        random = np.random.default_rng([population.seed, iteration])
        normals[num_clones:] = random.standard_normal((len(samples_of), 3))
        log_shrink = np.zeros_like(normals)
        log_shrink[num_clones:] = math.log(self.settings.split_shrink)

        t = types_of(type(population.value("means").array))
        rows = population.take(population.to_device_indices(np.append(chosen.clone, samples_of)))
        rows["means"] = displace_means(rows, normals)
        shrink = t.TensorXf(from_host(t.Float, log_shrink), normals.shape)
        rows["log_scales"] = rows["log_scales"] - shrink
        return rows


@dataclass(frozen=True)
class _ChosenRows:
    """Row numbers, ascending."""

    keep: np.ndarray  # stay, those to be cloned among them
    clone: np.ndarray
    split: np.ndarray
    num_refused: int
