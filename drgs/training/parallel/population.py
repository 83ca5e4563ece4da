"""The rows of a fit that several processes share: which ones each has, and how they change.

All rows together are in the order in which a single process would have them, and each process has
an interval of them, all of the same length but for one. Decisions about rows are made on every
process alike, from values of all rows (:meth:`ShardedPopulation.host`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np
from typing_extensions import override

from drgs.config.schema import FitConfig
from drgs.core.adam import LeanAdam
from drgs.core.arrays import from_host
from drgs.core.errors import UserError
from drgs.core.types import Float, UInt32
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.training.optimizer import Population
from drgs.training.parallel.communicator import Communicator


def make_population(
    optimizer: LeanAdam, extent: float, seed: int, comm: Communicator, total: int
) -> Population:
    """Return the rows of a fit; total: their number, of all processes."""
    if comm.size == 1:
        return Population(optimizer, extent, seed)
    shard = Shard(total, comm.rank, comm.size)
    return ShardedPopulation(optimizer, extent, seed, comm=comm, shard=shard)


def local_gaussians(gaussians: Gaussians, comm: Communicator) -> Gaussians:
    """Return the rows of this process; gaussians: numpy arrays, of all."""
    if comm.size == 1:
        return gaussians
    own = Shard(gaussians.num_gaussians, comm.rank, comm.size).local
    names = (*PARAMETER_NAMES, *(() if gaussians.smoothing is None else ("smoothing",)))
    return replace(gaussians, **{name: getattr(gaussians, name)[own] for name in names})


def check_shardable(config: FitConfig, size: int, num_gaussians: int) -> None:
    """Raise ``UserError`` for a fit that ``size`` processes cannot share."""
    views = config.optimizer.views_per_step
    if views < size:
        raise UserError(
            f"optimizer.views_per_step must be at least the number of processes ({size}), which "
            f"share the views of a step, got {views}; give it with --set"
        )
    _check_count(min(num_gaussians, config.densify.prune.to or num_gaussians), size)


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
    def local(self) -> slice:
        """The interval of this process."""
        first, end = self.bounds[self.rank : self.rank + 2]
        return slice(int(first), int(end))

    def owners(self, rows: np.ndarray) -> np.ndarray:
        """Return the rank that has each of these rows."""
        return np.searchsorted(self.bounds, rows, side="right") - 1


@dataclass(frozen=True, kw_only=True)
class ShardedPopulation(Population):
    """The rows of a fit, an interval of which is in the optimizer here.

    Every process calls the same methods in the same order. Arguments and row numbers concern all
    rows; :meth:`value`, :meth:`replace` and :meth:`set_values` those of this process.
    """

    comm: Communicator
    shard: Shard  # of this process

    @property
    @override
    def num_rows(self) -> int:
        return self.shard.total

    @property
    @override
    def first_row(self) -> int:
        return self.shard.local.start

    @override
    def gather(self, values: dr.ArrayBase | np.ndarray) -> np.ndarray:
        return self.comm.all_gather_rows(np.array(values)).astype(np.float64)

    @override
    def local(self, values: np.ndarray) -> np.ndarray:
        return values[self.shard.local]

    @override
    def row_numbers(self) -> UInt32:
        return super().row_numbers() + dr.opaque(self._index_type, self.first_row)

    @override
    def take(self, rows: UInt32) -> dict[str, dr.ArrayBase]:
        wanted = np.array(rows)
        owners = self.shard.owners(wanted)
        place = np.argsort(owners, kind="stable")
        local = self.to_device_indices(wanted[owners == self.shard.rank] - self.first_row)
        taken = {}
        for name, values in super().take(local).items():
            gathered = self.comm.all_gather_rows(np.array(values).reshape(values.shape))
            result = np.empty_like(gathered)
            result[place] = gathered
            taken[name] = _on_device(values, result)
        return taken

    @override
    def edit(
        self, keep: UInt32, append: Mapping[str, dr.ArrayBase | np.ndarray] | None = None
    ) -> None:
        kept, optimizer = np.array(keep), self.optimizer
        num_appended = 0 if append is None else append["means"].shape[0]
        after = replace(self.shard, total=len(kept) + num_appended)
        _check_count(after.total, after.size)
        move = self._row_moves(after, kept)
        first, end = (max(row - len(kept), 0) for row in (after.local.start, after.local.stop))
        for name, (value, promoted, rate, (step, *moments, maximum)) in optimizer.state.items():
            appended = np.empty((0, *value.shape[1:]), np.float32)
            if append is not None:
                appended = np.array(append[name])[first:end]
            rows = np.concatenate([move(np.array(dr.detach(value))), appended])
            none = np.zeros_like(appended)
            moved = (move(np.array(moment).reshape(value.shape)) for moment in moments)
            first_moment, second_moment = (
                from_host(type(moment), np.concatenate([kept_rows, none]))
                for moment, kept_rows in zip(moments, moved, strict=True)
            )
            new_value = _on_device(value, rows)
            dr.make_opaque(new_value, first_moment, second_moment)
            dr.enable_grad(new_value)
            extra = step, first_moment, second_moment, maximum
            optimizer.state[name] = new_value, promoted, rate, extra
        self.shard.total = after.total

    def _row_moves(self, after: Shard, kept: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Return the function from this process's rows to the kept rows of its next interval."""
        before = self.shard
        sources, goals = before.owners(kept), after.owners(np.arange(len(kept)))
        from_here = sources == before.rank
        local, to = kept[from_here] - self.first_row, goals[from_here]
        wanted = sources[goals == after.rank]

        def move(rows: np.ndarray) -> np.ndarray:
            parts = self.comm.exchange_rows([rows[local[to == r]] for r in range(after.size)])
            result = np.empty((len(wanted), *rows.shape[1:]), rows.dtype)
            for rank, part in enumerate(parts):
                result[wanted == rank] = part
            return result

        return move

    @override
    def gather_terms(
        self, terms: list[Float], compute: Callable[[Mapping[str, dr.ArrayBase]], list[Float]]
    ) -> list[np.ndarray]:
        """Compute terms over all rows anew, as sums of the ranks' shares would round otherwise."""
        if not terms:
            return []
        return [np.array(term, np.float32) for term in compute(_AllRows(self))]

    @override
    def gather_gaussians(self, local: Gaussians) -> Gaussians:
        columns = {name: getattr(local, name) for name in (*PARAMETER_NAMES, "smoothing")}
        columns = {name: rows for name, rows in columns.items() if rows is not None}
        gathered = {name: self.comm.gather_rows(rows) for name, rows in columns.items()}
        return replace(local, **gathered) if self.comm.is_root else local

    @override
    def gather_state(
        self, state: dict[str, np.ndarray], is_by_row: Callable[[str], bool]
    ) -> dict[str, np.ndarray]:
        for name in filter(is_by_row, state):
            array = state[name]
            rows = self.comm.gather_rows(array.reshape(self.num_local_rows, -1))
            if rows is not None:
                shape = (-1,) if array.ndim == 1 else (self.num_rows, *array.shape[1:])
                state[name] = rows.reshape(shape)
        return state

    @override
    def scatter_state(
        self, state: Mapping[str, np.ndarray], is_by_row: Callable[[str], bool]
    ) -> dict[str, np.ndarray]:
        described = [[name, array.dtype.str, array.shape] for name, array in state.items()]
        described = json.loads(self.comm.broadcast_text(json.dumps(described)))
        (total,) = (shape[0] for name, _, shape in described if name == "means.value")
        _check_count(total, self.comm.size)
        self.shard.total = total
        own, count = {}, self.shard.local.stop - self.shard.local.start
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


def _on_device(like: dr.ArrayBase, rows: np.ndarray) -> dr.ArrayBase:
    """Return rows as the tensor, or array, that other rows of a parameter are in."""
    flat = from_host(type(dr.detach(like).array), rows)
    return type(like)(flat, rows.shape) if dr.is_tensor_v(like) else flat


class _AllRows(dict[str, dr.ArrayBase]):
    """Parameters of the Gaussians of all processes by name, gathered when they are read."""

    def __init__(self, population: ShardedPopulation) -> None:
        super().__init__()
        self._population = population

    def __missing__(self, name: str) -> dr.ArrayBase:
        """Return a tensor of all rows."""
        value = self._population.value(name)
        self[name] = type(value)(self._population.comm.all_gather_rows(np.array(value)))
        return self[name]
