"""Adaptive density control, the strategy ``adc``: clone, split, prune and the opacity reset.

Section 5 of the 3DGS paper (Kerbl et al. 2023) with the details of its reference implementation,
except where a docstring says otherwise. Rows are chosen on the host, every hundred iterations or
so, and moved by ``drgs.training.optimizer`` together with their moments. Equal inputs give equal
bytes: no atomics, ties are broken by index, and random numbers depend on seed and iteration alone.

``config`` is the section ``densify`` of the configuration. Iterations are counted from 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from scipy.special import expit

from drgs.config.density import SCHEDULE_SHARES
from drgs.config.extensions import STRATEGIES
from drgs.config.schema import DensifyConfig, FitConfig
from drgs.core.arrays import from_host, types_of
from drgs.core.errors import UserError
from drgs.datasets.types import Dataset
from drgs.training.density.strategy import (
    DensityReport,
    DensityStrategy,
    Population,
    StepInfo,
    displaced,
)


@dataclass(frozen=True)
class DensityStatistics:
    """What the views since the last change say about each Gaussian."""

    gradient_norms: Any  # (N,) Float, sum over views of |d loss / d mean2d| in NDC units
    views: Any  # (N,) Float, number of views in which the Gaussian was visible

    @staticmethod
    def zeros(float_type: type, num_gaussians: int) -> DensityStatistics:
        """Return the statistics of no views."""
        zeros = dr.zeros(float_type, num_gaussians)
        return DensityStatistics(zeros, zeros)

    def mean_gradient_norms(self) -> np.ndarray:
        """Mean over the views that saw a Gaussian, (N,) float64 on the host; 0 if none did."""
        sums, views = np.array(self.gradient_norms, float), np.array(self.views, float)
        return sums / np.maximum(views, 1)


@STRATEGIES.register("adc")
@dataclass
class AdaptiveDensityControl(DensityStrategy):
    """Clones and splits where gradients are large, prunes what is transparent or too large."""

    config: DensifyConfig
    white_background: bool
    statistics: DensityStatistics | None = None  # until it begins
    by_row = ("gradient_norms", "views")
    start_share, stop_share = SCHEDULE_SHARES["adc"]

    @classmethod
    def from_config(
        cls, config: FitConfig, dataset: Dataset | None, section: None
    ) -> AdaptiveDensityControl:
        """Return the strategy of the section ``densify``."""
        del section
        is_white = dataset is not None and tuple(dataset.background) == (1.0, 1.0, 1.0)
        return cls(config.densify, is_white)

    def begin(self, population: Population) -> None:
        """Start with the statistics of no views."""
        float_type = type(population.value("means").array)
        self.statistics = DensityStatistics.zeros(float_type, population.num_own)

    def needs_statistics(self, iteration: int) -> bool:
        """See :func:`needs_statistics`."""
        return needs_statistics(self.config, iteration)

    def update_statistics(self, step: StepInfo) -> None:
        """Add the gradients of one more view."""
        self.statistics = accumulate(
            self.statistics, step.means2d_grad, step.visible, step.width, step.height
        )

    def is_due(self, iteration: int) -> bool:
        """Whether the population changes, or opacities are reset."""
        return should_densify(self.config, iteration) or self._resets(iteration)

    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Clone, split and prune, then lower opacities, each where it is due."""
        report = None
        if should_densify(self.config, iteration):
            report = densify_and_prune(population, self.statistics, self.config, iteration)
            self.begin(population)
        if self._resets(iteration):
            reset_opacities(population, self.config)
        return report

    def state(self) -> dict[str, np.ndarray]:
        """The statistics."""
        sums, views = self.statistics.gradient_norms, self.statistics.views
        return {"gradient_norms": np.array(sums), "views": np.array(views)}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue with the statistics of :meth:`state`."""
        float_type = type(self.statistics.views)
        self.statistics = DensityStatistics(
            from_host(float_type, state["gradient_norms"]), from_host(float_type, state["views"])
        )

    def most_gaussians(self, start: int, iterations: int) -> int:
        """Each change adds a row for each, or more, until there are ``max_gaussians``."""
        config, last = self.config, min(iterations, self.config.stop - 1)
        changes = max(0, last // config.every - config.start // config.every)
        doublings = math.log2(max(config.max_gaussians, start) / start)
        if changes * math.log2(config.adc.split_count) >= doublings:
            return max(start, config.max_gaussians)
        return start * config.adc.split_count**changes

    def _resets(self, iteration: int) -> bool:
        return should_reset(self.config, iteration, self.white_background)


def accumulate(
    statistics: DensityStatistics, means2d_grad: Any, visible: Any, width: int, height: int
) -> DensityStatistics:
    """Return the statistics with one more view.

    means2d_grad: d loss / d mean2d, per pixel: ``Array2f`` or (N, 2) tensor. visible: (N,)
    ``Bool``. width, height: of that view's film, px. A pixel gradient times (W/2, H/2) is the
    gradient with respect to normalised device coordinates, the unit of the threshold.
    """
    grad_x, grad_y = _columns(means2d_grad)
    norm = dr.sqrt(dr.square(grad_x * (0.5 * width)) + dr.square(grad_y * (0.5 * height)))
    updated = DensityStatistics(
        statistics.gradient_norms + dr.select(visible, norm, 0),
        statistics.views + dr.select(visible, 1, 0),
    )
    dr.eval(updated)
    return updated


def needs_statistics(config: DensifyConfig, iteration: int) -> bool:
    """Whether the gradients of this iteration can still lead to a change."""
    return iteration < config.stop


def should_densify(config: DensifyConfig, iteration: int) -> bool:
    """Whether the population changes after this iteration."""
    return config.start < iteration < config.stop and iteration % config.every == 0


def should_reset(config: DensifyConfig, iteration: int, white_background: bool) -> bool:
    """Whether opacities are lowered after this iteration: only while densifying.

    White backgrounds get one more: white Gaussians in front of white would otherwise stay.
    """
    extra = white_background and iteration == config.adc.white_background_reset
    return iteration < config.stop and (iteration % config.adc.reset_every == 0 or extra)


def prunes_large(config: DensifyConfig, iteration: int) -> bool:
    """Whether large Gaussians are pruned: once the first regular opacity reset is over."""
    return iteration > config.adc.reset_every


def densify_and_prune(
    population: Population, statistics: DensityStatistics, config: DensifyConfig, iteration: int
) -> DensityReport:
    """Clone, split and prune; the caller then starts again with zero statistics.

    A Gaussian whose mean gradient norm reaches the threshold is cloned in place if it is small;
    otherwise it is replaced by samples of itself, which are smaller. Of more candidates than
    ``max_gaussians`` has room for, those with the largest gradients are taken. Rows end up as:
    survivors in their order, clones, samples.

    Added rows are spared by the prune of the same step. Hence a Gaussian that is too transparent
    is never cloned or split: its copies, as transparent as itself, would stay.

    Raises ``UserError`` if no Gaussian would remain: such a fit cannot recover.
    """
    num_before, extent = population.num_rows, population.extent
    if dr.width(statistics.views) != population.num_own:
        raise ValueError(
            f"densify_and_prune(): statistics of {dr.width(statistics.views)} Gaussians for "
            f"{population.num_own} in the optimizer: they start again after every change"
        )
    limit = config.adc.prune_scale * extent if prunes_large(config, iteration) else np.inf
    with np.errstate(over="ignore"):
        scales = np.exp(population.host("log_scales")).max(axis=1)
    chosen = _choose_rows(
        gradient_norms=population.of_all(statistics.mean_gradient_norms()),
        opacities=expit(population.host("logit_opacities")),
        scales=scales,
        config=config,
        scene_extent=extent,
        largest_scale=limit,
    )
    num_added = len(chosen.clone) + len(chosen.split) * config.adc.split_count
    if len(chosen.keep) + num_added == 0:
        raise UserError(
            f"iteration {iteration}: every Gaussian would be pruned (opacity below densify.adc."
            f"prune_opacity = {config.adc.prune_opacity}, or scale above densify.adc.prune_scale = "
            f"{config.adc.prune_scale} x {extent:g}): do the cameras see the start points?"
        )
    if num_added > 0 or len(chosen.keep) < num_before:
        keep = population.rows(chosen.keep)
        append = _new_rows(population, chosen, config, iteration) if num_added > 0 else None
        population.edit(keep, append)
    return DensityReport(
        num_added=num_added - len(chosen.split),
        cloned=len(chosen.clone),
        split=len(chosen.split),
        pruned=num_before - len(chosen.keep) - len(chosen.split),
        refused=chosen.num_refused,
        num_gaussians=len(chosen.keep) + num_added,
    )


def reset_opacities(population: Population, config: DensifyConfig) -> None:
    """Lower every opacity to at most ``reset_opacity`` and forget its moments.

    What the photographs need regains opacity; what floats before the cameras is pruned.
    """
    ceiling = math.log(config.adc.reset_opacity / (1 - config.adc.reset_opacity))
    logits = population.value("logit_opacities")
    population.replace("logit_opacities", dr.select(logits > ceiling, ceiling, logits))


@dataclass(frozen=True)
class _ChosenRows:
    """Row numbers, ascending."""

    keep: np.ndarray  # stay, those to be cloned among them
    clone: np.ndarray
    split: np.ndarray
    num_refused: int


def _choose_rows(
    gradient_norms: np.ndarray,
    opacities: np.ndarray,
    scales: np.ndarray,
    config: DensifyConfig,
    scene_extent: float,
    largest_scale: float,
) -> _ChosenRows:
    """Decide about every row; scales: (N,) largest standard deviation, world units.

    Comparisons are written such that NaN counts as transparent and as too large.
    """
    small = scales <= config.adc.clone_scale * scene_extent
    transparent = ~(opacities >= config.adc.prune_opacity)
    too_large = ~(scales <= largest_scale)
    candidate = (gradient_norms >= config.adc.grad_threshold) & ~transparent & np.isfinite(scales)
    candidate &= ~(small & too_large)  # a clone would be as large

    # Room is what is left if every candidate survives, so that no choice can exceed it.
    survivors = np.count_nonzero(candidate | ~(transparent | too_large))
    rows = np.flatnonzero(candidate)
    rows = rows[np.argsort(-gradient_norms[rows], kind="stable")]
    cost = np.where(small[rows], 1, config.adc.split_count - 1)
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
    population: Population, chosen: _ChosenRows, config: DensifyConfig, iteration: int
) -> dict[str, Any]:
    """The clones, then ``split_count`` samples of each row that is split.

    A sample is drawn from its parent's own Gaussian: mean + R(q) (s * n), n standard normal. A
    clone is the same with n = 0.
    """
    num_clones = len(chosen.clone)
    samples_of = np.repeat(chosen.split, config.adc.split_count)
    normals = np.zeros((num_clones + len(samples_of), 3))
    random = np.random.default_rng([population.seed, iteration])
    normals[num_clones:] = random.standard_normal((len(samples_of), 3))
    log_shrink = np.zeros_like(normals)
    log_shrink[num_clones:] = math.log(config.adc.split_shrink)

    t = types_of(type(population.value("means").array))
    rows = population.take(population.rows(np.append(chosen.clone, samples_of)))
    rows["means"] = displaced(rows, normals)
    shrink = t.TensorXf(from_host(t.Float, log_shrink), normals.shape)
    rows["log_scales"] = rows["log_scales"] - shrink
    return rows


def _columns(gradient: Any) -> tuple[Any, Any]:
    """The x and y of an ``Array2f`` or of an (N, 2) tensor."""
    if not dr.is_tensor_v(gradient):
        return gradient.x, gradient.y
    x, y = dr.unravel(types_of(type(gradient.array)).Array2f, gradient.array)
    return x, y
