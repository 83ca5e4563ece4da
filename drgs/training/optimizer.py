"""The rows of a fit: the parameters of the Gaussians, with Adam's moments.

Every change of the number of Gaussians goes through :meth:`Population.edit`, which moves a row's
value and moments together: see :mod:`drgs.core.adam`.

Parameters are named as in ``gaussians.PARAMETER_NAMES``. One of zero size, ``shN`` at degree 0,
cannot be registered and is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import drjit as dr
import numpy as np

from drgs.core.adam import LeanAdam
from drgs.core.arrays import Array, from_host
from drgs.core.types import Float, UInt32
from drgs.gaussians.parameters import Gaussians


@dataclass(frozen=True)
class Population:
    """The rows of a fit, which a strategy may read and change.

    A row is a Gaussian: its parameters, named as in ``gaussians.PARAMETER_NAMES``, and the moments
    that Adam keeps of them. Everything is detached. Where several processes fit, each has some rows
    (:class:`drgs.training.parallel.population.ShardedPopulation`).
    """

    optimizer: LeanAdam
    extent: float  # of the scene, world units
    seed: int

    @property
    def num_rows(self) -> int:
        """The number of Gaussians at the moment."""
        return self.num_local_rows

    @property
    def num_local_rows(self) -> int:
        """The number of rows of :meth:`value`."""
        return self.optimizer["means"].shape[0]

    @property
    def first_row(self) -> int:
        """The number of the first row of this process."""
        return 0

    def value(self, name: str) -> dr.ArrayBase:
        """Return the current values of a parameter, on the device: the rows of this process."""
        return dr.detach(self.optimizer[name])

    def host(self, name: str) -> np.ndarray:
        """Return a parameter of all rows on the host, float64; waits for the device."""
        return self.gather(self.value(name))

    def gather(self, values: dr.ArrayBase | np.ndarray) -> np.ndarray:
        """Return the values of all rows, given those of this process: on the host, float64."""
        return np.array(values, dtype=np.float64)

    def local(self, values: np.ndarray) -> np.ndarray:
        """Return the values of this process's rows, given those of all rows."""
        return values

    def zeros(self) -> Float:
        """Return a number 0 for each row of this process: Float."""
        return dr.zeros(type(self.value("means").array), self.num_local_rows)

    def to_device_indices(self, numbers: np.ndarray) -> UInt32:
        """Return row numbers, (M,) integers on the host, as ``UInt32`` on the device."""
        return from_host(self._index_type, numbers.astype(np.uint32))

    def row_numbers(self) -> UInt32:
        """Return the numbers of the rows of this process: UInt32."""
        return dr.arange(self._index_type, self.num_local_rows)

    @property
    def _index_type(self) -> type:
        return dr.uint32_array_t(type(self.value("means").array))

    def take(self, rows: UInt32) -> dict[str, dr.ArrayBase]:
        """Return copies of some rows of every parameter by name; rows: (M,) ``UInt32``."""
        result = {}
        for name in self.optimizer.state:
            value = self.value(name)
            row_shape = tuple(value.shape[1:])
            flat = value.array
            flat = dr.gather(type(flat), flat, _elements(rows, math.prod(row_shape)))
            is_tensor = dr.is_tensor_v(value)
            result[name] = type(value)(flat, (dr.width(rows), *row_shape)) if is_tensor else flat
        return result

    def edit(
        self,
        keep: UInt32,
        append: Mapping[str, dr.ArrayBase | np.ndarray] | None = None,
    ) -> None:
        """Keep some rows of every parameter, in the order given, and append new ones.

        keep: (K,) ``UInt32``, as :meth:`to_device_indices` makes it. append: M new rows of every
        parameter by name, on the device or in numpy, or None. Afterwards
        row i is former row keep[i] for i < K, and appended row i - K from there on. Kept rows have
        their moments, bit by bit, and appended ones moments of zero; step counts and learning rates
        stay. Waits for the device once, to check ``keep``.
        """
        optimizer, total = self.optimizer, self.num_local_rows
        if not isinstance(keep, self._index_type):
            raise TypeError(
                "Population.edit(): keep must be row numbers, UInt32 of the device, got "
                f"{type(keep).__name__}; to_device_indices() uploads them"
            )
        if dr.width(keep) > 0 and dr.max(keep)[0] >= total:
            raise ValueError(f"Population.edit(): keep must hold row numbers below {total}")
        added = self._num_appended(append)
        if dr.width(keep) + added == 0:
            raise ValueError("Population.edit(): at least one row must remain, got none")
        for name, (value, promoted, rate, (step, first, second, _)) in optimizer.state.items():
            row_shape = tuple(value.shape[1:])
            width = math.prod(row_shape)
            elements = _elements(keep, width)
            new_rows = no_moments = None
            if append is not None and added > 0:
                rows = append[name]
                is_host = isinstance(rows, np.ndarray)
                new_rows = from_host(type(value.array), rows.ravel()) if is_host else rows.array
                no_moments = dr.zeros(type(new_rows), added * width)

            flat = _gather_and_append(dr.detach(value).array, elements, new_rows)
            first, second = (_gather_and_append(m, elements, no_moments) for m in (first, second))
            if dr.is_tensor_v(value):
                flat = type(value)(flat, (dr.width(flat) // width, *row_shape))
            dr.enable_grad(flat)
            dr.schedule(flat, first, second)
            optimizer.state[name] = flat, promoted, rate, (step, first, second, None)
        dr.eval()

    def _num_appended(self, rows: Mapping[str, dr.ArrayBase | np.ndarray] | None) -> int:
        """Return the number of ``rows``, which must be given for every parameter in its shape."""
        if rows is None:
            return 0
        count = max((value.shape[0] for value in rows.values()), default=0)
        for name, value in self.optimizer.items():
            expected = (count, *value.shape[1:])
            got = tuple(rows[name].shape) if name in rows else "none"
            if got != expected:
                raise ValueError(
                    f"Population.edit(): appended rows of {name} must have the shape {expected}, "
                    f"got {got}"
                )
        return count

    def replace(self, name: str, value: dr.ArrayBase) -> None:
        """Give a parameter new values of the same shape, and moments of zero.

        The step count and the learning rate stay: as in the reference's opacity reset, Adam's bias
        correction does not start again.
        """
        self.set_values(name, value)
        new, promoted, rate, (step, first, second, _) = self.optimizer.state[name]
        first, second = (dr.opaque(type(m), 0, m.shape) for m in (first, second))
        self.optimizer.state[name] = new, promoted, rate, (step, first, second, None)

    def set_values(self, name: str, value: dr.ArrayBase) -> None:
        """Give a parameter new values of the same shape; its moments stay. Waits for nothing."""
        old, promoted, rate, extra = self.optimizer.state[name]
        if tuple(value.shape) != tuple(old.shape):
            raise ValueError(
                f"Population.set_values(): {name} has shape {tuple(old.shape)}, the new values "
                f"{tuple(value.shape)}: edit() adds and removes rows"
            )
        value = type(old)(dr.detach(value))
        dr.make_opaque(value)
        dr.enable_grad(value)
        self.optimizer.state[name] = value, promoted, rate, extra

    def gather_terms(
        self, terms: list[Float], compute: Callable[[Mapping[str, dr.ArrayBase]], list[Float]]
    ) -> list[Float] | list[np.ndarray]:
        """Return terms of the loss over all rows, detached.

        terms: over the rows of this process; compute: computes them from parameters by name.
        """
        return [dr.detach(term) for term in terms]

    def gather_gaussians(self, local: Gaussians) -> Gaussians:
        """Return all Gaussians, given those of this process."""
        return local

    def gather_state(
        self, state: dict[str, np.ndarray], is_by_row: Callable[[str], bool]
    ) -> dict[str, np.ndarray]:
        """Return a trainer's state with all rows, given that of this process."""
        return state

    def scatter_state(
        self, state: Mapping[str, np.ndarray], is_by_row: Callable[[str], bool]
    ) -> Mapping[str, np.ndarray]:
        """Return the part of a whole state that this process has."""
        return state


def _elements(rows: UInt32, width: int) -> UInt32:
    """Return the places of ``rows`` in a flat row-major array of ``width`` columns."""
    if dr.width(rows) == 0:
        return rows  # Dr.Jit does not compute with empty arrays
    element = dr.arange(type(rows), dr.width(rows) * width)
    return dr.gather(type(rows), rows, element // width) * width + element % width


def _gather_and_append(flat: Array, elements: UInt32, added: Array | None) -> Array:
    kept = dr.gather(type(flat), flat, elements)
    if added is None:
        return kept
    index_type, num_kept, num_added = type(elements), dr.width(kept), dr.width(added)
    result = dr.empty(type(flat), num_kept + num_added)
    if num_kept > 0:
        dr.scatter(result, kept, dr.arange(index_type, num_kept))
    # Opaque: as a literal (and in dr.concat) the offset would make each call a new kernel.
    offset = dr.opaque(index_type, num_kept)
    dr.scatter(result, added, dr.arange(index_type, num_added) + offset)
    return result
