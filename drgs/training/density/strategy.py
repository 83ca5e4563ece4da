"""The interface of strategies that change the population, and the rows that they change.

Each iteration, :class:`drgs.training.trainer.Trainer` passes statistics (:class:`StepInfo`) to the
strategy and lets it act on the rows of the optimizer
(:class:`drgs.training.optimizer.Population`). Iterations are counted from 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

import drjit as dr
import numpy as np

from drgs.config.schema import FitConfig
from drgs.core.arrays import from_host, types_of
from drgs.core.types import Array2f, Bool, Float, TensorXf
from drgs.datasets.types import Dataset
from drgs.gaussians.parameters import quat_to_rotation
from drgs.training.optimizer import Population


@dataclass(frozen=True)
class DensityReport:
    """Changes of the rows by one call of a density strategy."""

    num_gaussians: int  # afterwards
    num_added: int = 0  # new rows, without split parents
    cloned: int = 0  # copied Gaussians
    split: int = 0  # Gaussians replaced by several
    relocated: int = 0  # rows replaced by copies of others
    pruned: int = 0  # removed rows, without split parents
    refused: int = 0  # Gaussians not cloned or split because of the limit


@dataclass(frozen=True)
class StepInfo:
    """Statistics of an iteration, not differentiated; N: the rows of :meth:`Population.value`."""

    iteration: int
    width: int  # px, of the film of the iteration's view
    height: int
    means2d_grad: Array2f | TensorXf  # (N, 2): d loss / d mean2d, per px
    visible: Bool  # (N,)
    weighted_sums: Mapping[str, Float]  # (N,): see DensityStrategy.pixel_weights


NOT_BEGUN: Any = None  # statistics before :meth:`DensityStrategy.begin`

PixelWeight = Callable[[TensorXf, TensorXf], Float]
"""Computes a plane, Float (H W,), of an image and its photograph (H, W, 3), display space."""


def absolute_errors(image: TensorXf, photograph: TensorXf) -> Float:
    """Return the mean absolute difference of each pixel's channels: Float (H W,)."""
    return dr.mean(dr.abs(image - photograph), axis=2).array


def displace_means(rows: Mapping[str, dr.ArrayBase], offsets: np.ndarray) -> TensorXf:
    """Return means moved along their axes by offsets (M, 3): mean + R(q) (s * offset), s: stds."""
    means, log_scales = rows["means"], rows["log_scales"]
    t = types_of(type(means.array))
    offset = dr.unravel(t.Array3f, from_host(t.Float, offsets))
    scale = dr.exp(dr.unravel(t.Array3f, log_scales.array))
    rotation = quat_to_rotation(dr.unravel(t.Array4f, rows["quats"].array))
    moved = dr.unravel(t.Array3f, means.array) + rotation @ (scale * offset)
    return t.TensorXf(dr.ravel(moved), offsets.shape)


class DensityStrategy(Protocol):
    """Base class of strategies, which does not change the population.

    Equal inputs give equal bytes: random numbers are functions of seed, iteration and row. Where
    several processes fit, each has a strategy with statistics of its own rows; decisions are made
    from :meth:`Population.gather`, on all of them alike.
    """

    @classmethod
    def from_config(
        cls, config: FitConfig, dataset: Dataset | None, section: Any
    ) -> DensityStrategy:
        """Return the strategy of a fit.

        section: the section that the strategy has registered, with the values of the
        configuration, or the model's defaults; by default the only argument of the class. None:
        the strategy has no section. dataset: None where only :meth:`max_num_gaussians` is called.
        """
        make = cast("Callable[..., DensityStrategy]", cls)
        return make() if section is None else make(section)

    by_row: Sequence[str] = ()
    """Names in :meth:`state` of arrays with a row for each Gaussian: by default, of attributes."""

    start_share, stop_share, latest_stop = 1 / 20, 1 / 2, math.inf
    """For schedules that are not given: shares of the iterations that are at most ``densify.start``
    (which is at most half of stop, too) and ``densify.stop``, and the latest iteration of it."""

    rate_decay = 0.1  # ``optimizer.decay`` that is not given
    begins_coarse = True  # whether ``coarse`` that is not given may be other than empty

    def begin(self, population: Population) -> None:
        """Reset the statistics: at the start, and after changes by other strategies."""

    def needs_statistics(self, iteration: int) -> bool:
        """Return whether :meth:`update_statistics` is called for this iteration."""
        return False

    def pixel_weights(self, iteration: int) -> Mapping[str, PixelWeight]:
        """Return the planes, by name, that this iteration sums over the pixels of each Gaussian.

        ``StepInfo.weighted_sums`` has, for each Gaussian, the sum over pixels of the plane times
        the Gaussian's weight there: alpha times transmittance.
        """
        return {}

    def update_statistics(self, step: StepInfo) -> None:
        """Add an iteration to the statistics, after its optimizer step."""

    def penalties(self, parameters: Mapping[str, dr.ArrayBase], num_rows: int) -> Iterator[Float]:
        """Yield terms of the loss, Float of one value each.

        parameters: raw values by name, with derivatives, of ``num_rows`` Gaussians or of some.
        """
        yield from ()

    def rate_factors(self, iteration: int) -> Mapping[str, float]:
        """Return factors of the learning rates of this iteration, by parameter."""
        return {}

    def perturb(self, population: Population, iteration: int, means_lr: float) -> None:
        """Change values after each step; waits for nothing. means_lr: their rate, world units."""

    def is_due(self, iteration: int) -> bool:
        """Return whether :meth:`refine` is called after this iteration, and after the other calls.

        All numbers are known to be finite then.
        """
        return False

    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Change rows or values; None: it was no change of the population.

        After a change, the rows are sorted by their places in space, and :attr:`by_row` with them.
        """

    def state(self) -> dict[str, np.ndarray]:
        """Return finite arrays by name: with a row for each Gaussian here, or a number."""
        return {name: np.array(getattr(self, name)) for name in self.by_row}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from :meth:`state`, where :meth:`begin` was called; other names are ignored."""
        for name in self.by_row:
            setattr(self, name, from_host(type(getattr(self, name)), state[name]))

    def max_num_gaussians(self, start: int, iterations: int) -> int:
        """Return the most Gaussians of a fit from ``start`` on; called without :meth:`begin`."""
        return start
