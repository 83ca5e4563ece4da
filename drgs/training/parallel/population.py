"""The rows of a fit that several processes share: which ones each has, and how they change.

All rows together are in the order in which a single process would have them, and each process has
an interval of them, all of the same length but for one. Decisions about rows are made from what is
known of all of them (:meth:`ShardedPopulation.host`), on every process alike; only the numbers of
the rows themselves, with their moments, are in one place each.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from drgs.config.schema import FitConfig
from drgs.core.arrays import from_host, types_of
from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.training.density.strategy import Population
from drgs.training.optimizer import LeanAdam, num_rows, take_rows
from drgs.training.parallel.communicator import Communicator


def make_population(
    optimizer: LeanAdam, prefix: str, extent: float, seed: int, comm: Communicator, total: int
) -> Population:
    """Return the rows of a fit; total: their number, of all processes."""
    if comm.size == 1:
        return Population(optimizer, prefix, extent, seed)
    shard = Shard(total, comm.rank, comm.size)
    return ShardedPopulation(optimizer, prefix, extent, seed, comm=comm, shard=shard)


def local_gaussians(gaussians: Gaussians, comm: Communicator) -> Gaussians:
    """Return the rows of this process; gaussians: numpy arrays, of all."""
    if comm.size == 1:
        return gaussians
    own = Shard(gaussians.num_gaussians, comm.rank, comm.size).own
    rows = {name: getattr(gaussians, name)[own] for name in PARAMETER_NAMES}
    smoothing = None if gaussians.smoothing is None else gaussians.smoothing[own]
    return replace(gaussians, **rows, smoothing=smoothing)


def check_can_be_shared(config: FitConfig, size: int, num_gaussians: int) -> None:
    """Raise ``UserError`` for a fit that ``size`` processes cannot share."""
    views = config.optimizer.views_per_step
    if views < size:
        raise UserError(
            f"optimizer.views_per_step must be at least the number of processes ({size}), which "
            f"share the views of a step, got {views}; give it with --set"
        )
    to = config.densify.prune.to
    _check_count(min(num_gaussians, to or num_gaussians), size)


def _check_count(num_gaussians: int, size: int) -> None:
    if num_gaussians < size:
        raise UserError(
            f"{size} processes cannot share {num_gaussians} Gaussians; start fewer of them"
        )


def renderer_of(place: int, views_per_step: int, size: int) -> int:
    """Return the rank that renders a view of a step: places are dealt out in equal parts."""
    return place * size // views_per_step


def own_views(count: int, views_per_step: int, rank: int, size: int) -> set[int]:
    """Return which of ``count`` training views a rank renders: see ``drgs.training.steps``."""
    places = (p for p in range(views_per_step) if renderer_of(p, views_per_step, size) == rank)
    return {view for p in places for view in range(p % count, count, views_per_step)}


@dataclass
class Shard:
    """The interval of ``total`` rows that one of ``size`` processes has."""

    total: int  # changes with the population
    rank: int
    size: int

    @property
    def bounds(self) -> np.ndarray:
        """(size + 1,): where the intervals of all processes begin, and the end."""
        return np.arange(self.size + 1) * self.total // self.size

    @property
    def own(self) -> slice:
        """The interval of this process."""
        first, end = self.bounds[self.rank : self.rank + 2]
        return slice(int(first), int(end))

    def owners(self, rows: np.ndarray) -> np.ndarray:
        """Return the rank that has each of these rows."""
        return np.searchsorted(self.bounds, rows, side="right") - 1


@dataclass(frozen=True, kw_only=True)
class ShardedPopulation(Population):
    """The rows of a fit, an interval of which is in the optimizer here.

    Every process calls the same methods in the same order. What they are given, and row numbers,
    concern all rows; what :meth:`value` returns and what :meth:`replace` and :meth:`set_values`
    take are the rows of this process.
    """

    comm: Communicator
    shard: Shard  # what this process has

    @property
    def num_rows(self) -> int:
        """N at the moment, of all processes."""
        return self.shard.total

    @property
    def first_row(self) -> int:
        """The number of the first row of this process."""
        return self.shard.own.start

    @property
    def num_local_rows(self) -> int:
        """How many of them this process has."""
        return num_rows(self.optimizer, self.prefix)

    def gather(self, values: Any) -> np.ndarray:
        """Values for the rows of all processes: see ``Population.gather``."""
        return self.comm.all_gather_rows(np.array(values)).astype(np.float64)

    def local(self, values: np.ndarray) -> np.ndarray:
        """Of values for all rows, those of this process."""
        return values[self.shard.own]

    def row_numbers(self) -> Any:
        """Of the rows that :meth:`value` has: UInt32."""
        index_type = dr.uint32_array_t(type(self.value("means").array))
        first = dr.opaque(index_type, self.shard.own.start)
        return dr.arange(index_type, self.num_local_rows) + first

    def take(self, rows: Any) -> dict[str, Any]:
        """Copies of some of all rows, of every parameter by name."""
        shard, wanted = self.shard, np.array(rows)
        owners = shard.owners(wanted)
        own = self.rows(wanted[owners == shard.rank] - shard.own.start)
        packed = self._packed(take_rows(self.optimizer, own, self.prefix), dr.width(own))
        found = np.empty((len(wanted), packed.shape[1]), packed.dtype)
        found[np.argsort(owners, kind="stable")] = self.comm.all_gather_rows(packed)
        return self._unpacked(found)

    def edit(self, keep: Any, append: Mapping[str, Any] | None = None) -> None:
        """Keep some of all rows in the order given and append others: see ``Population.edit``."""
        before, kept = replace(self.shard), np.array(keep)
        appended = np.empty((0, 0))
        if append is not None:
            appended = self._packed(append, append["means"].shape[0])
        after = Shard(len(kept) + len(appended), before.rank, before.size)
        _check_count(after.total, after.size)
        moved = self._moved(before, after, kept)
        own = appended[max(after.own.start - len(kept), 0) : max(after.own.stop - len(kept), 0)]
        self._replace(moved, own)
        self.shard.total = after.total

    def gather_terms(self, terms: list[Any], compute: Callable[[Any], list[Any]]) -> list[Any]:
        """Return terms of the loss over all rows: see ``Population.gather_terms``.

        They are computed again: the sum of what the ranks have would be rounded otherwise.
        """
        if not terms:
            return []
        return [np.array(term, np.float32) for term in compute(_AllRows(self))]

    def gather_gaussians(self, own: Gaussians) -> Gaussians:
        """Return the Gaussians of all ranks on rank 0, and ``own`` on others."""
        columns = {name: getattr(own, name) for name in (*PARAMETER_NAMES, "smoothing")}
        columns = {name: rows for name, rows in columns.items() if rows is not None}
        gathered = {name: self.comm.gather_rows(rows) for name, rows in columns.items()}
        return replace(own, **gathered) if self.comm.is_root else own

    def gather_state(
        self, state: dict[str, np.ndarray], is_by_row: Callable[[str], bool]
    ) -> dict[str, np.ndarray]:
        """Return a trainer's state with the rows of all ranks on rank 0."""
        for name in filter(is_by_row, state):
            array = state[name]
            rows = self.comm.gather_rows(array.reshape(self.num_local_rows, -1))
            if rows is not None:
                shape = (-1,) if array.ndim == 1 else (self.num_rows, *array.shape[1:])
                state[name] = rows.reshape(shape)
        return state

    def scatter_state(
        self, state: Mapping[str, np.ndarray], is_by_row: Callable[[str], bool]
    ) -> dict[str, np.ndarray]:
        """Return the part of rank 0's state that this rank has; its rows are those of the state."""
        described = [[name, array.dtype.str, array.shape] for name, array in state.items()]
        described = json.loads(self.comm.broadcast_text(json.dumps(described)))
        (total,) = (shape[0] for name, _, shape in described if name == "means.value")
        _check_count(total, self.comm.size)
        self.shard.total = total
        own, count = {}, self.shard.own.stop - self.shard.own.start
        for name, dtype, shape in described:
            array = state.get(name)
            if is_by_row(name):
                width = math.prod(shape) // total
                rows = None if array is None else array.reshape(total, width)
                rows = self.comm.scatter_rows(rows, np.empty((count, width), dtype))
                own[name] = rows.reshape((-1,) if len(shape) == 1 else (count, *shape[1:]))
            else:
                array = np.empty(shape, dtype) if array is None else array
                own[name] = self.comm.broadcast(array).reshape(shape)
        return own

    def _moved(self, before: Shard, after: Shard, kept: np.ndarray) -> np.ndarray:
        """Values and moments of the kept rows that are this process's from now on, in order."""
        sources, goals = before.owners(kept), after.owners(np.arange(len(kept)))
        from_here = sources == before.rank
        local, to = kept[from_here] - before.own.start, goals[from_here]
        everything = np.concatenate(self._everything(), axis=1)
        parts = [everything[local[to == rank]] for rank in range(after.size)]
        del everything
        with self.comm.exchanging():
            found = self.comm.exchange_rows(parts, parts[0].dtype, parts[0].shape[1])
        wanted = sources[goals == after.rank]
        result = np.empty((len(wanted), parts[0].shape[1]), parts[0].dtype)
        for rank, part in enumerate(found):
            result[wanted == rank] = part
        return result

    def _everything(self) -> list[np.ndarray]:
        """Of the rows of this process: values, first and second moments, (n, columns) each."""
        found: list[list[np.ndarray]] = [[], [], []]
        for key in self._keys:
            value, _, _, (_, first, second, _) = self.optimizer.state[key]
            for arrays, flat in zip(found, (dr.detach(value), first, second), strict=True):
                arrays.append(np.array(flat).reshape(self.num_local_rows, self._width(key)))
        return [np.concatenate(arrays, axis=1) for arrays in found]

    def _replace(self, kept: np.ndarray, appended: np.ndarray) -> None:
        """Give the optimizer other rows: kept ones with their moments, then new ones."""
        optimizer, start = self.optimizer, 0
        optimizer.forget_moments()
        columns = kept.shape[1] // 3
        for key in self._keys:
            value, promoted, rate, (step, first, *_, maximum) = optimizer.state[key]
            shape = tuple(value.shape[1:])
            width = math.prod(shape)

            def rows_of(which: int, begin: int = start, width: int = width) -> np.ndarray:
                at = columns * which + begin
                new = np.zeros((len(appended), width), kept.dtype)
                if which == 0 and len(appended):
                    new = appended[:, begin : begin + width]
                return np.concatenate([kept[:, at : at + width], new])

            flat_type, rows = type(first), rows_of(0)
            flat = from_host(flat_type, rows)
            new_value = type(value)(flat, (len(rows), *shape)) if dr.is_tensor_v(value) else flat
            moments = [from_host(flat_type, rows_of(which)) for which in (1, 2)]
            dr.make_opaque(new_value, moments)
            dr.enable_grad(new_value)
            optimizer.state[key] = new_value, promoted, rate, (step, *moments, maximum)
            start += width

    @property
    def _keys(self) -> list[str]:
        return [key for key in self.optimizer.state if key.startswith(self.prefix)]

    def _width(self, key: str) -> int:
        """Numbers of a row."""
        return math.prod(self.optimizer.state[key][0].shape[1:])

    def _packed(self, rows: Mapping[str, Any], count: int) -> np.ndarray:
        """(count, columns): rows of every parameter, side by side."""
        columns = [
            np.array(rows[key[len(self.prefix) :]]).reshape(count, self._width(key))
            for key in self._keys
        ]
        return np.concatenate(columns, axis=1)

    def _unpacked(self, packed: np.ndarray) -> dict[str, Any]:
        """The inverse, on the device."""
        result, start = {}, 0
        for key in self._keys:
            value = self.optimizer.state[key][0]
            shape = tuple(value.shape[1:])
            width = math.prod(shape)
            t = types_of(type(dr.detach(value).array))
            flat = from_host(t.Float, packed[:, start : start + width])
            is_tensor = dr.is_tensor_v(value)
            result[key[len(self.prefix) :]] = (
                type(value)(flat, (len(packed), *shape)) if is_tensor else flat
            )
            start += width
        return result


class _AllRows(dict[str, Any]):
    """Parameters of the Gaussians of all processes by name, gathered when they are read."""

    def __init__(self, population: ShardedPopulation) -> None:
        super().__init__()
        self._population = population

    def __missing__(self, name: str) -> Any:
        """Return a tensor of all rows."""
        value = self._population.value(name)
        self[name] = type(value)(self._population.comm.all_gather_rows(np.array(value)))
        return self[name]
