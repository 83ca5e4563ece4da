"""The strategy ``mcmc``: relocation, noise and regularisers, up to a number of Gaussians.

3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024): the Gaussians are
samples of a distribution that the photographs define, and Adam's steps with noise are a random walk
in it. There is no threshold for cloning or splitting. Transparent Gaussians are relocated to opaque
ones, such that the image changes as little as possible.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import drjit as dr
import numpy as np
from pydantic import Field
from scipy.special import comb, expit, logit
from typing_extensions import override

from drgs.config.density import DensifyConfig
from drgs.config.extensions import STRATEGIES
from drgs.config.schema import FitConfig
from drgs.config.section import UNRESOLVED, Count, Resolved, Section
from drgs.core.arrays import from_host, types_of
from drgs.core.errors import UserError
from drgs.core.types import Array3f, Float, UInt32
from drgs.datasets.types import Dataset
from drgs.gaussians.parameters import quat_to_rotation
from drgs.training.density.strategy import (
    DensityReport,
    DensityStrategy,
    Population,
    displace_means,
)

MAX_COPIES = 51
"""Most copies of a Gaussian at a time, as in the paper's code; up to here, binomials are exact."""

MAX_OPACITY = 1 - 2.0**-23  # largest opacity of copies: the largest in float32 that has a logit

NOISE_STEEPNESS = 100.0  # noise fades out over some 0.05 of opacity: the paper's equation 8

_UNIT_OF_WORD = 2.0**-24
"""Scales the upper 24 bits of a random word, which float32 holds exactly, to [0, 1)."""


class McmcConfig(Section):
    """The strategy ``mcmc`` (Kheradmand et al. 2024): relocation, noise and regularisers."""

    gaussians: Resolved[Count] = Field(UNRESOLVED, ge=4)
    """Final number of Gaussians. null: as with budget."""
    growth: float = Field(0.05, ge=0, le=10)
    """Relative growth of the population at each change."""
    spread: float = Field(1.0, ge=0, le=10)
    """Displacement of copies, in standard deviations; 0 in the paper."""
    min_opacity: float = Field(0.005, gt=0, lt=1)
    """Relocate Gaussians up to this opacity."""
    noise_lr: float = Field(1e5, ge=0, le=1e12)
    """Factor of the noise on means, times their rate and the covariance in squared scene extents.
    The paper's value, about 1e7, costs 2 dB in small images."""
    opacity_weight: float = Field(0.01, ge=0, le=1e6)
    """Weight of the mean opacity in the loss."""
    scale_weight: float = Field(0.05, ge=0, le=1e6)
    """Weight of the mean scale, in scene extents, in the loss."""

    @override
    def check(self, config: FitConfig) -> None:
        """Refuse more points at the start than Gaussians in the end."""
        if config.densify.strategy == "mcmc":
            config.require_room("densify.mcmc.gaussians", self.gaussians)


@STRATEGIES.register("mcmc", section=McmcConfig)
@dataclass
class MarkovChain(DensityStrategy):
    """Relocates transparent Gaussians, and adds noise to means."""

    config: DensifyConfig
    settings: McmcConfig
    extent: float = math.nan  # of the scene, world units; known when it begins
    stop_share = 5 / 7

    @classmethod
    @override
    def from_config(
        cls, config: FitConfig, dataset: Dataset | None, section: McmcConfig
    ) -> MarkovChain:
        return cls(config.densify, section)

    @override
    def begin(self, population: Population) -> None:
        self.extent = population.extent

    @property
    def cap(self) -> int:
        """Final number of Gaussians; a larger initial population does not grow."""
        return min(self.settings.gaussians, self.config.max_gaussians)

    @override
    def penalties(self, parameters: Mapping[str, dr.ArrayBase], num_rows: int) -> Iterator[Float]:
        """Yield the paper's equation 10: mean opacity, and mean scale in scene extents."""
        config, logits = self.settings, parameters["logit_opacities"]
        log_scales = parameters["log_scales"].array
        if config.opacity_weight > 0:
            yield _mean(1 / (1 + dr.exp(-logits)), config.opacity_weight, num_rows)
        if config.scale_weight > 0:
            yield _mean(dr.exp(log_scales), config.scale_weight / self.extent, 3 * num_rows)

    @override
    def perturb(self, population: Population, iteration: int, means_lr: float) -> None:
        """Add noise to the means (the paper's equation 8), which keep their moments.

        Sigma n sigmoid(100 (min_opacity - o)) x strength, n standard normal: along the Gaussian's
        own axes, and of transparent ones only. The strength is noise_lr times the means' rate;
        Sigma is in squared scene extents, so that a scene of another size is the same fit.
        """
        config = self.settings
        if config.noise_lr == 0:
            return
        names = ("means", "quats", "log_scales", "logit_opacities")
        means, quats, log_scales, logits = map(population.value, names)
        t = types_of(type(logits))
        strength = dr.opaque(t.Float, config.noise_lr * means_lr / self.extent**2)
        key = (dr.opaque(t.UInt32, v) for v in (iteration, population.seed))
        normal = normals(t.Float, population.row_numbers(), *key)
        opacity = 1 / (1 + dr.exp(-logits))
        fading = 1 / (1 + dr.exp(NOISE_STEEPNESS * (opacity - config.min_opacity)))
        rotation = quat_to_rotation(dr.unravel(t.Array4f, quats.array))
        variances = dr.exp(2 * dr.unravel(t.Array3f, log_scales.array))
        noise = rotation @ (variances * (rotation.T @ normal))
        shift = fading * strength * noise
        mean = dr.unravel(t.Array3f, means.array)
        moved = dr.select(dr.isfinite(shift), mean + shift, mean)  # scales may have no square
        population.set_values("means", type(means)(dr.ravel(moved), means.shape))

    @override
    def is_due(self, iteration: int) -> bool:
        config = self.config
        return config.start < iteration < config.stop and iteration % config.every == 0

    @override
    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Relocate transparent Gaussians to others, and add copies.

        These are drawn in proportion to opacity. Rows end up as: those not drawn, in order and with
        their moments; the drawn; the copies. The last two begin with moments of zero.

        Raises ``UserError`` if all are too transparent.
        """
        config, before = self.settings, population.num_rows
        opacities = expit(population.host("logit_opacities"))
        alive = opacities > config.min_opacity  # a NaN is not
        num_alive = int(np.count_nonzero(alive))
        if num_alive == 0:
            raise UserError(
                f"iteration {iteration}: no Gaussian is more opaque than densify.mcmc.min_opacity "
                f"= {config.min_opacity}: do the cameras see the start points?"
            )
        grown = max(int(before * (1 + config.growth)), before + (config.growth > 0))
        aim = max(num_alive, min(self.cap, grown))
        key = [population.seed, iteration]
        copied = sample_in_proportion(np.where(alive, opacities, 0), aim - num_alive, key)
        if len(copied):
            drawn, rows = _copies(population, copied, opacities, config.min_opacity)
            offsets = np.random.default_rng([*key, 1]).standard_normal(rows["means"].shape)
            offsets[: len(drawn)] = 0
            rows["means"] = displace_means(rows, config.spread * offsets)
            alive[drawn] = False
            population.edit(population.to_device_indices(np.flatnonzero(alive)), rows)
        elif num_alive < before:
            population.edit(population.to_device_indices(np.flatnonzero(alive)))
        relocated = min(before - num_alive, len(copied))
        return DensityReport(
            num_gaussians=aim,
            num_added=len(copied) - relocated,
            relocated=relocated,
            pruned=before - num_alive - relocated,
        )

    @override
    def max_num_gaussians(self, start: int, iterations: int) -> int:
        """Return the cap, or the number at the start."""
        return max(start, self.cap)


def correct_copies(opacities: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return opacities of n coincident Gaussians that look like one, and factors of their scales.

    opacities: (M,) of the one; counts: (M,), n, at most ``MAX_COPIES``. The paper's equation 9:
    composited, the copies are as opaque at their centre, and along a line through it:

    o' = 1 - (1 - o)^(1/n),   s'/s = o / sum_{j=1..n} C(n, j) (-1)^(j-1) o'^j / sqrt(j)

    (with the paper's sum over i of C(i-1, k) summed up: C(n, k+1)).
    """
    counts = np.minimum(counts, MAX_COPIES)
    opacities = np.minimum(opacities, MAX_OPACITY)
    copies = -np.expm1(np.log1p(-opacities) / counts)
    j = np.arange(1, MAX_COPIES + 1)
    terms = comb(counts[:, None], j) * np.where(j % 2, 1, -1) / np.sqrt(j)
    return copies, opacities / (terms * copies[:, None] ** j).sum(axis=1)


def _copies(
    population: Population, copied: np.ndarray, opacities: np.ndarray, min_opacity: float
) -> tuple[np.ndarray, dict[str, dr.ArrayBase]]:
    """Return the rows that are drawn, and their successors: themselves, corrected, then copies.

    copied: row numbers, ascending; opacities: (N,), of all rows.
    """
    drawn, counts = np.unique(copied, return_counts=True)
    shared, factors = correct_copies(opacities[drawn], counts + 1)
    shared = np.clip(shared, min_opacity, MAX_OPACITY)
    rows = population.take(population.to_device_indices(np.append(drawn, copied)))
    # Of each new row, the place of its source among those that were drawn.
    source = np.append(np.arange(len(drawn)), np.searchsorted(drawn, copied))
    t = types_of(type(rows["logit_opacities"]))
    log_factors = from_host(t.Float, np.repeat(np.log(factors)[source], 3))
    log_scales = rows["log_scales"]
    rows["logit_opacities"] = from_host(t.Float, logit(shared)[source])
    rows["log_scales"] = log_scales + t.TensorXf(log_factors, log_scales.shape)
    return drawn, rows


def _mean(values: Float, weight: float, count: int) -> Float:
    """Return the weighted mean; no literals: the number of values changes."""
    return dr.sum(values) * dr.opaque(type(values), weight / count)


def sample_in_proportion(weights: np.ndarray, count: int, key: list[int]) -> np.ndarray:
    """Return ``count`` row numbers, ascending, each as often as its weight requires.

    weights: (N,) of at least 0, not all of them 0; NaN counts as 0. key: of the random numbers.

    Systematic sampling (Madow 1949): the row of share p among the weights is drawn
    floor(count p) or ceil(count p) times, count p on average; one of weight 0 is never drawn.

    Raises ValueError if no weight is positive and finite.
    """
    weights = np.where(weights > 0, weights, 0.0)
    ends = np.cumsum(weights)
    if not (len(ends) and 0 < ends[-1] < np.inf):
        raise ValueError(
            "sample_in_proportion(): the sum of the weights must be positive and finite"
        )
    offset = np.random.default_rng(key).random()
    positions = (np.arange(count) + offset) * (ends[-1] / count if count else 0.0)
    # Rounding may put the last position onto the end, behind the last row of any weight.
    last = np.flatnonzero(weights)[-1]
    return np.minimum(np.searchsorted(ends, positions, side="right"), last)


def normals(float_type: type, rows: UInt32, iteration: UInt32, seed: UInt32) -> Array3f:
    """Return standard normal vectors, Array3f (N,), a function of iteration, seed and row.

    rows: UInt32 (N,); iteration, seed: UInt32 (1,), opaque, so that each value is no new kernel.

    Box and Muller's transform of a hash of the three (``pcg4d``: Jarzynski and Olano 2020).
    """
    t = types_of(float_type)
    words = pcg4d(rows, t.UInt32(iteration), t.UInt32(seed), t.UInt32(0))
    first, second, third, fourth = (t.Float(word >> 8) * _UNIT_OF_WORD for word in words)
    # 1 - u is above 0, of which there is a logarithm.
    radius, other = (dr.sqrt(-2 * dr.log(1 - u)) for u in (first, third))
    sine, cosine = dr.sincos(dr.two_pi * second)
    return t.Array3f(radius * cosine, radius * sine, other * dr.cos(dr.two_pi * fourth))


def pcg4d(x: UInt32, y: UInt32, z: UInt32, w: UInt32) -> tuple[UInt32, UInt32, UInt32, UInt32]:
    """Return four random words of four numbers, UInt32 each."""
    x, y, z, w = (1664525 * v + 1013904223 for v in (x, y, z, w))
    x, y, z, w = _mix(x, y, z, w)
    x, y, z, w = (v ^ (v >> 16) for v in (x, y, z, w))
    return _mix(x, y, z, w)


def _mix(x: UInt32, y: UInt32, z: UInt32, w: UInt32) -> tuple[UInt32, UInt32, UInt32, UInt32]:
    x = x + y * w
    y = y + z * x
    z = z + x * y
    w = w + y * z
    return x, y, z, w
