"""Rows that are spread over processes: which ones each has, and how they change.

All rows together are in the order in which a single process would have them, and each process has
an interval of them, all of the same length but for one. Whoever decides about rows sees them all
(:meth:`SpreadPopulation.host`), everywhere alike; only the numbers of the rows themselves, with
their moments, are in one place each.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from drgs.core.arrays import from_host, types_of
from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.training.density.strategy import Population
from drgs.training.optimizer import num_rows, take_rows
from drgs.training.parallel.ranks import Ranks


class AgreedError(UserError):
    """What all processes raise together."""


def too_few(num_gaussians: int, size: int) -> str:
    """Why so many processes cannot share Gaussians; empty: they can."""
    if num_gaussians >= size:
        return ""
    return f"{size} processes cannot share {num_gaussians} Gaussians; start fewer of them"


def renderer_of(place: int, views_per_step: int, size: int) -> int:
    """Which of ``size`` processes renders a view of a step: places are dealt out in equal parts."""
    return place * size // views_per_step


def own_views(count: int, views_per_step: int, rank: int, size: int) -> set[int]:
    """Which of ``count`` training views a process renders: see ``drgs.training.stages.view_of``."""
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
        """Of this process."""
        first, end = self.bounds[self.rank : self.rank + 2]
        return slice(int(first), int(end))

    def owners(self, rows: np.ndarray) -> np.ndarray:
        """Which process has each of these rows."""
        return np.searchsorted(self.bounds, rows, side="right") - 1

    def of(self, gaussians: Gaussians) -> Gaussians:
        """This process's rows of Gaussians (numpy)."""
        rows = {name: getattr(gaussians, name)[self.own] for name in PARAMETER_NAMES}
        smoothing = None if gaussians.smoothing is None else gaussians.smoothing[self.own]
        return replace(gaussians, **rows, smoothing=smoothing)


@dataclass(frozen=True, kw_only=True)
class SpreadPopulation(Population):
    """The rows of a fit, an interval of which is in the optimizer here.

    Every process calls the same methods in the same order. What they are given, and row numbers,
    concern all rows; what :meth:`value` returns and what :meth:`replace` and :meth:`set_values`
    take are the rows of this process.
    """

    ranks: Ranks
    shard: Shard  # what this process has

    @property
    def num_rows(self) -> int:
        """N at the moment, of all processes."""
        return self.shard.total

    @property
    def num_own(self) -> int:
        """How many of them this process has."""
        return num_rows(self.optimizer, self.prefix)

    def of_all(self, values: Any) -> np.ndarray:
        """Values for the rows of all processes: see ``Population.of_all``."""
        return self.ranks.rows_of_all(np.array(values)).astype(np.float64)

    def own(self, values: np.ndarray) -> np.ndarray:
        """Of values for all rows, those of this process."""
        return values[self.shard.own]

    def row_numbers(self) -> Any:
        """Of the rows that :meth:`value` has: UInt32."""
        index_type = dr.uint32_array_t(type(self.value("means").array))
        first = dr.opaque(index_type, self.shard.own.start)
        return dr.arange(index_type, self.num_own) + first

    def take(self, rows: Any) -> dict[str, Any]:
        """Copies of some of all rows, of every parameter by name."""
        shard, wanted = self.shard, np.array(rows)
        owners = shard.owners(wanted)
        own = self.rows(wanted[owners == shard.rank] - shard.own.start)
        packed = self._packed(take_rows(self.optimizer, own, self.prefix), dr.width(own))
        found = np.empty((len(wanted), packed.shape[1]), packed.dtype)
        found[np.argsort(owners, kind="stable")] = self.ranks.rows_of_all(packed)
        return self._unpacked(found)

    def edit(self, keep: Any, append: Mapping[str, Any] | None = None) -> None:
        """Keep some of all rows in the order given and append others: see ``Population.edit``."""
        before, kept = replace(self.shard), np.array(keep)
        appended = np.empty((0, 0))
        if append is not None:
            appended = self._packed(append, append["means"].shape[0])
        after = Shard(len(kept) + len(appended), before.rank, before.size)
        if refusal := too_few(after.total, after.size):
            raise AgreedError(refusal)
        moved = self._moved(before, after, kept)
        own = appended[max(after.own.start - len(kept), 0) : max(after.own.stop - len(kept), 0)]
        self._replace(moved, own)
        self.shard.total = after.total

    def _moved(self, before: Shard, after: Shard, kept: np.ndarray) -> np.ndarray:
        """Values and moments of the kept rows that are this process's from now on, in order."""
        sources, goals = before.owners(kept), after.owners(np.arange(len(kept)))
        from_here = sources == before.rank
        local, to = kept[from_here] - before.own.start, goals[from_here]
        everything = np.concatenate(self._everything(), axis=1)
        parts = [everything[local[to == rank]] for rank in range(after.size)]
        del everything
        with self.ranks.exchanging():
            found = self.ranks.exchanged(parts, parts[0].dtype, parts[0].shape[1])
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
                arrays.append(np.array(flat).reshape(self.num_own, self._width(key)))
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
