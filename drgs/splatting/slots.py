"""Slots: where partial derivatives wait until they are added up, in an order of their own.

In the adjoint of compositing, a lane sums the partial derivatives of a splat over 16 pixels. Each
composited (entry, micro-tile) pair has a *slot*, which that lane alone writes; then one lane per
entry adds up the entry's slots, and one lane per splat its entries. Nothing is added atomically:
the result is the same to the last bit in every run.

Slots are written and read once. To save memory, the film is cut into *bands* of tiles whose slots
exist at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import drjit as dr
import numpy as np

from drgs.core.arrays import Rows, interleave, types_of
from drgs.splatting.grid import MICROS
from drgs.splatting.lanes import Entries
from drgs.splatting.tiles import WORD, TileBins, transpose_masks

BAND_SLOTS = 1 << 20
"""Slots of a band, as far as whole tiles allow: 38 MB, three colours in single precision.
With fewer, Dr.Jit traces and launches more often than it saves."""


@dataclass(frozen=True)
class CompositedPairs:
    """Which pairs of an entry and a micro-tile were composited.

    An entry with such a pair is *seen* and has a row of sums; those of a splat follow each other.
    """

    masks: Any  # UInt32 (M padded,): sorted -> bit per micro-tile
    words: Any  # UInt32 (M padded / 32 * 16,): (group of 32, micro-tile) -> bit per entry
    row: Any  # UInt32 (M + 1,): unsorted -> row of sums, or of the next entry that is seen
    first_row: Any  # UInt32 (N + 1,): rank -> first of its rows

    @staticmethod
    def of(bins: TileBins, stop: Any) -> CompositedPairs:
        """Those before each micro-tile's ``stop``, see :class:`drgs.splatting.rasterize.Layers`."""
        t = types_of(bins.rows.Float)
        entry = dr.arange(t.UInt32, dr.width(bins.masks))
        masks = t.UInt32(0)
        for k in range(MICROS // 4):
            stops = dr.gather(t.Array4u, stop, bins.tiles * (MICROS // 4) + k)
            for m, of_micro in enumerate(stops):
                masks |= dr.select(entry < of_micro, t.UInt32(1 << (4 * k + m)), 0)
        masks &= bins.masks
        dr.eval(masks)
        words = transpose_masks(masks)
        seen = dr.zeros(t.UInt32, bins.num_entries + 1)
        dr.scatter(seen, t.UInt32(1), bins.source, masks != 0)
        row = dr.prefix_sum(seen)
        first_row = dr.gather(t.UInt32, row, bins.first_entry)
        dr.eval(words, first_row)
        return CompositedPairs(masks, words, row, first_row)

    @property
    def num_rows(self) -> int:
        """Entries that are seen. Waits for the device."""
        return int(self.row[dr.width(self.row) - 1])


@dataclass(frozen=True)
class Band:
    """Consecutive tiles, their sorted entries, and how many slots these have."""

    tiles: range
    entries: range
    num_slots: int

    @property
    def groups(self) -> range:
        """The groups of 32 entries that the entries are in; one at least."""
        first = self.entries.start // WORD
        return range(first, max(-(-self.entries.stop // WORD), first + 1))


def bands_of(bins: TileBins, pairs: CompositedPairs) -> list[Band]:
    """The film in bands. The host reads how many entries and slots each tile has."""
    t = types_of(bins.rows.Float)
    running = dr.cumsum(dr.popcnt(pairs.masks))
    before = bins.tile_start > 0
    slots = dr.gather(t.UInt32, running, bins.tile_start - 1, before)
    dr.eval(slots)
    starts, slots = np.array(bins.tile_start, np.int64), np.array(slots, np.int64)
    count = -(-max(slots[-1], 1) // BAND_SLOTS)
    targets = slots[-1] * np.arange(1, count) / count
    edges = np.unique([0, *np.searchsorted(slots, targets, side="right") - 1, len(slots) - 1])
    return [
        Band(range(a, b), range(starts[a], starts[b]), int(slots[b] - slots[a]))
        for a, b in pairwise(edges.tolist())
    ]


@dataclass(frozen=True)
class Slots:
    """Where each composited (entry, micro-tile) pair of a band stores its partial derivatives.

    First come the pairs of all tiles' first micro-tiles, in the order of the sorted entries, then
    those of the second ones, and so on: what a lane writes is contiguous. (In the order in which
    the slots are added up, each write would wait for memory of its own.) Pairs behind a
    micro-tile's stop have no slot, so that every slot is written exactly once.
    """

    pairs: Any  # UInt32 (groups * 16 * 2,): (group, micro-tile) -> first slot, bits
    first_group: Any  # UInt32 (1,): of the band
    band: Band

    def at(self, group: Any, micro: Any, active: Any = True) -> tuple[Any, Any]:
        """First slot of a group of entries in a micro-tile, and the word of its composited bits."""
        index = (group - self.first_group) * MICROS + micro
        return dr.gather(types_of(type(group)).Array2u, self.pairs, index, active)

    def end(self, entries: Entries) -> Any:
        """Where each lane's slots end."""
        first, word = self.at(entries.last, entries.micro, entries.head != 0)
        return first + dr.popcnt(word & entries.tail)

    def number(self, entries: Entries) -> Any:
        """How many slots each lane has."""
        occupied = entries.head != 0
        first, word = self.at(entries.first, entries.micro, occupied)
        begin = first + dr.popcnt(word & ~entries.head)
        return dr.select(occupied, self.end(entries) - begin, 0)


def assign_slots(pairs: CompositedPairs, band: Band) -> Slots:
    """Number the slots of a band. Waits for nothing."""
    t = types_of(type(pairs.words))
    first_group = dr.opaque(t.UInt32, band.groups.start)
    num_groups = dr.opaque(t.UInt32, len(band.groups))
    index = dr.arange(t.UInt32, len(band.groups) * MICROS)
    micro = index // num_groups
    words = _words(pairs, band, first_group + (index - micro * num_groups), micro)
    first = dr.prefix_sum(dr.popcnt(words))

    group, micro = index // MICROS, index % MICROS
    words = _words(pairs, band, first_group + group, micro)
    table = interleave([dr.gather(t.UInt32, first, micro * num_groups + group), words])
    dr.eval(table)
    return Slots(table, first_group, band)


def _words(pairs: CompositedPairs, band: Band, group: Any, micro: Any) -> Any:
    """The composited bits of entries of the band."""
    UInt32 = type(group)
    start, stop = (dr.opaque(UInt32, n) for n in (band.entries.start, band.entries.stop))
    word = dr.gather(UInt32, pairs.words, group * MICROS + micro)
    ones, first = UInt32(0xFFFFFFFF), group * WORD
    word &= dr.select(first < start, ones << (start % WORD), ones)
    return word & dr.select(first + WORD > stop, ~(ones << (stop % WORD)), ones)


def sum_entries(
    bins: TileBins, pairs: CompositedPairs, slots: Slots, partials: Rows, sums: Rows
) -> None:
    """Sum over the micro-tiles of each entry of a band that is seen.

    partials: by slot; sums: its rows are filled, and evaluated.
    """
    t = types_of(partials.Float)
    count = max(len(slots.band.entries), 1)
    entry = dr.opaque(t.UInt32, slots.band.entries.start) + dr.arange(t.UInt32, count)
    group, below = entry // WORD, (t.UInt32(1) << (entry % WORD)) - 1

    def body(micros: Any, totals: list) -> tuple:
        for _ in range(2):  # two at a time wait for memory together
            active = micros != 0
            first, word = slots.at(group, dr.tzcnt(micros), active)
            numbers = partials.load(first + dr.popcnt(word & below), active)
            totals = [a + b for a, b in zip(totals, numbers, strict=True)]
            micros = micros & (micros - 1)
        return micros, totals

    zero, micros = dr.zeros(t.Float, count), dr.gather(t.UInt32, pairs.masks, entry)
    _, totals = dr.while_loop(
        state=(
            t.UInt32(micros),
            [t.Float(zero) for _ in range(partials.width)],
        ),
        cond=lambda micros, totals: micros != 0,
        body=body,
    )
    dr.eval(totals)
    source = dr.gather(t.UInt32, bins.source, entry)
    sums.store(totals, dr.gather(t.UInt32, pairs.row, source), micros != 0)
    dr.eval(sums)


def sum_runs(Float: type, first: Any, load: Callable[[Any], Sequence[Any]]) -> list[Any]:
    """Sums over runs, one lane a run: run r is from ``first[r]`` to ``first[r + 1]``.

    load: the numbers of an element of a run.
    """
    UInt32 = type(first)
    run = dr.arange(UInt32, dr.width(first) - 1)
    begin, end = (dr.gather(UInt32, first, run + k) for k in (0, 1))
    width = len(load(begin))

    def body(element: Any, totals: list) -> tuple:
        return element + 1, [a + b for a, b in zip(totals, load(element), strict=True)]

    zero = dr.zeros(Float, dr.width(run))
    _, totals = dr.while_loop(
        state=(begin, [Float(zero) for _ in range(width)]),
        cond=lambda element, totals: element < end,
        body=body,
    )
    return totals
