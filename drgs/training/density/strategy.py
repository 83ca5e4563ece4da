"""What the trainer asks of a strategy that changes the population, and what it hands to it.

Each iteration, :class:`drgs.training.trainer.Trainer` tells the strategy what it has seen
(:class:`StepInfo`) and lets it act on the rows of the optimizer (:class:`Population`).
``drgs.training.density.registry`` makes the strategy that a configuration chooses.

Iterations are counted from 1. A strategy is a function of the configuration and of
:meth:`DensityStrategy.state`: where a plan is revised, another one is made and given the state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import numpy as np

from drgs.config.density import DEFAULT_SCHEDULE_SHARES
from drgs.config.schema import FitConfig
from drgs.core.arrays import from_host, types_of
from drgs.datasets.types import Dataset
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.quaternions import quat_to_rotation
from drgs.results.history import DensityReport
from drgs.training.optimizer import (
    LeanAdam,
    edit_rows,
    num_rows,
    replace_values,
    set_values,
    take_rows,
)


@dataclass(frozen=True)
class StepInfo:
    """Statistics of an iteration, for a strategy; nothing of it is differentiated.

    N are the rows that :meth:`Population.value` has.
    """

    iteration: int
    width: int  # px, of the film of the iteration's view
    height: int
    means2d_grad: Any  # d loss / d mean2d, per px: Array2f, or a tensor (N, 2)
    visible: Any  # Bool (N,)
    weighted_sums: Mapping[str, Any]  # Float (N,): see DensityStrategy.pixel_weights


PixelWeight = Callable[[Any, Any], Any]
"""Computes a plane, Float (H W,), from what was rendered and the photograph: tensors (H, W, 3) in
display space."""


def absolute_errors(image: Any, photograph: Any) -> Any:
    """Return the mean absolute difference of each pixel's channels: Float (H W,)."""
    return dr.mean(dr.abs(image - photograph), axis=2).array


@dataclass(frozen=True)
class Population:
    """The rows of a fit: what a strategy may read and change.

    A row is a Gaussian: its parameters, named as in ``gaussians.PARAMETER_NAMES``, and the moments
    that Adam keeps of them. Everything is detached.
    """

    optimizer: LeanAdam
    prefix: str  # what precedes a parameter's name in the optimizer
    extent: float  # of the scene, world units
    seed: int

    @property
    def num_rows(self) -> int:
        """N at the moment."""
        return num_rows(self.optimizer, self.prefix)

    @property
    def num_own(self) -> int:
        """How many of them :meth:`value` has: all, where no other process has some."""
        return self.num_rows

    @property
    def first_row(self) -> int:
        """The number of the first row that this process has."""
        return 0

    def terms_of_all(self, terms: list[Any], compute: Callable[[Any], list[Any]]) -> list[Any]:
        """Return terms of the loss that were computed from the rows here, for all rows.

        compute: computes them from parameters by name.
        """
        del compute
        return [dr.detach(term) for term in terms]

    def gather_gaussians(self, own: Gaussians) -> Gaussians:
        """Return all Gaussians, from those of this process."""
        return own

    def gather_state(
        self, state: dict[str, np.ndarray], is_by_row: Callable[[str], bool]
    ) -> dict[str, np.ndarray]:
        """Return a trainer's state with all rows, from that of this process."""
        del is_by_row
        return state

    def scatter_state(
        self, state: Mapping[str, np.ndarray], is_by_row: Callable[[str], bool]
    ) -> Mapping[str, np.ndarray]:
        """Return the part of a whole state that this process has."""
        del is_by_row
        return state

    def value(self, name: str) -> Any:
        """A parameter as it is at the moment, on the device."""
        return dr.detach(self.optimizer[self.prefix + name])

    def host(self, name: str) -> np.ndarray:
        """The same on the host, float64; waits for the device."""
        return self.of_all(self.value(name))

    def of_all(self, values: Any) -> np.ndarray:
        """Of values for the rows that :meth:`value` has, those of all rows: on the host, float64.

        Waits for the device.
        """
        return np.array(values, dtype=np.float64)

    def own(self, values: np.ndarray) -> np.ndarray:
        """The inverse: of values for all rows, those for the rows that :meth:`value` has."""
        return values

    def rows(self, numbers: np.ndarray) -> Any:
        """Row numbers, (M,) integers on the host, as ``UInt32`` on the device."""
        index_type = dr.uint32_array_t(type(self.value("means").array))
        return from_host(index_type, numbers.astype(np.uint32))

    def row_numbers(self) -> Any:
        """Of the rows that :meth:`value` has: UInt32."""
        index_type = dr.uint32_array_t(type(self.value("means").array))
        return dr.arange(index_type, self.num_own)

    def take(self, rows: Any) -> dict[str, Any]:
        """Copies of some rows of every parameter by name; rows: (M,) ``UInt32``."""
        return take_rows(self.optimizer, rows, self.prefix)

    def edit(self, keep: Any, append: Mapping[str, Any] | None = None) -> None:
        """Keep some rows in the order given and append others: see ``optimizer.edit_rows``.

        keep: (K,) ``UInt32``. append: M new rows of every parameter by name, or None. Kept rows
        take their moments along, appended ones start with moments of zero.
        """
        edit_rows(self.optimizer, keep, append, self.prefix)

    def replace(self, name: str, value: Any) -> None:
        """Give a parameter new values of the same shape, and moments of zero."""
        replace_values(self.optimizer, name, value, self.prefix)

    def set_values(self, name: str, value: Any) -> None:
        """Give a parameter new values of the same shape; its moments stay. Waits for nothing."""
        set_values(self.optimizer, name, value, self.prefix)


def displaced(rows: Mapping[str, Any], offsets: np.ndarray) -> Any:
    """Means of ``rows``, moved along their own axes: mean + R(q) (s * offset), tensor (M, 3).

    rows: of every parameter by name; offsets: (M, 3), in standard deviations.
    """
    means, log_scales = rows["means"], rows["log_scales"]
    t = types_of(type(means.array))
    offset = dr.unravel(t.Array3f, from_host(t.Float, offsets))
    scale = dr.exp(dr.unravel(t.Array3f, log_scales.array))
    rotation = quat_to_rotation(dr.unravel(t.Array4f, rows["quats"].array))
    moved = dr.unravel(t.Array3f, means.array) + rotation @ (scale * offset)
    return t.TensorXf(dr.ravel(moved), offsets.shape)


class DensityStrategy(Protocol):
    """What the trainer asks of a strategy; strategies derive from it and override what they need.

    As it is here, a strategy leaves the population as it is. Equal inputs give equal bytes: what is
    random is a function of seed, iteration and row.

    Where several processes have some of the rows each, so do their strategies, of which each takes
    note of its own; whoever acts asks for :meth:`Population.of_all`, and all decide alike.
    """

    @classmethod
    def from_config(cls, config: FitConfig, dataset: Dataset | None, section: Any) -> Any:
        """Return the strategy of a fit.

        section: the section that the strategy has registered, with the values of the
        configuration, or the model's defaults; by default the only argument of the class. None:
        the strategy has no section. dataset: None where only :meth:`most_gaussians` is called.
        """
        del config, dataset
        return cls() if section is None else cls(section)

    by_row: Sequence[str] = ()
    """Names in :meth:`state` of what has a row for each Gaussian."""

    start_share, stop_share = DEFAULT_SCHEDULE_SHARES
    """Shares of the iterations, for schedules that are not given: ``densify.start`` is at most the
    first (and half of stop), ``densify.stop`` at most the second."""

    def begin(self, population: Population) -> None:
        """Start with the statistics of no views.

        Called before the first iteration, and when others have changed the rows.
        """
        del population

    def needs_statistics(self, iteration: int) -> bool:
        """Return whether :meth:`update_statistics` is called for this iteration."""
        del iteration
        return False

    def pixel_weights(self, iteration: int) -> Mapping[str, PixelWeight]:
        """Return the planes, by name, that this iteration sums over the pixels of each Gaussian.

        ``StepInfo.weighted_sums`` has, for each Gaussian, the sum over pixels of the plane times
        the Gaussian's weight there: alpha times transmittance.
        """
        del iteration
        return {}

    def update_statistics(self, step: StepInfo) -> None:
        """Take note of an iteration, after its optimizer step."""
        del step

    def penalties(self, parameters: Mapping[str, Any], num_rows: int) -> Iterator[Any]:
        """Terms of the loss, Float of one value each.

        parameters: raw values by name, with derivatives, of ``num_rows`` Gaussians or of some.
        """
        del parameters, num_rows
        yield from ()

    def rate_factors(self, iteration: int) -> Mapping[str, float]:
        """What the learning rates of this iteration are multiplied by, by parameter.

        A parameter that is named in one iteration is named in all.
        """
        del iteration
        return {}

    def perturb(self, population: Population, iteration: int, means_lr: float) -> None:
        """Change values after each optimizer step; waits for nothing.

        means_lr: the step's rate of the means, world units.
        """
        del population, iteration, means_lr

    def is_due(self, iteration: int) -> bool:
        """Return whether :meth:`refine` is called after this iteration.

        It is called after :meth:`update_statistics` and :meth:`perturb`, when all is known to be
        finite.
        """
        del iteration
        return False

    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        """Change rows or values; None: it was no change of the population."""
        del population, iteration

    def state(self) -> dict[str, np.ndarray]:
        """What the coming iterations depend on: by name, a row for each Gaussian here, or a number.

        All of it has to be finite.
        """
        return {}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from :meth:`state`, where :meth:`begin` was called; unknown names are left."""
        del state

    def most_gaussians(self, start: int, iterations: int) -> int:
        """How many a fit of so many iterations can have that starts with ``start``.

        Called for an estimate, without :meth:`begin`.
        """
        del iterations
        return start
