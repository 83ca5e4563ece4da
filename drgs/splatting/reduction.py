"""Reduction of partial derivatives in a fixed order, without atomic additions.

In the adjoint of compositing, a lane sums the partial derivatives of a splat over 16 pixels. Each
composited (entry, micro-tile) pair has a *slot*, which only this lane writes. (Lanes without a pair
write behind the slots, which nobody reads.) Then one lane per entry adds the entry's slots, and one
lane per splat its entries. The result is the same to the last bit in every run.

To save memory, an image of many entries is divided into *bands* of tiles, and only the slots of one
band exist at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import drjit as dr
import numpy as np

from drgs.core.arrays import Rows, divide, interleave, repeat_array, types_of
from drgs.core.private import access_all_lanes
from drgs.core.types import Array2u, Bool, Float, UInt32
from drgs.splatting.grid import MICROS
from drgs.splatting.tiles import WORD, Entries, TileBins, find_lowest_bit, transpose_masks

BAND_SLOTS = 1 << 20
"""Slots of a band, as far as whole tiles allow: 38 MB, three colours in single precision.
Smaller bands cost more in tracing and launches than they save."""

PAIRS_AT_ONCE = 1 << 23
"""Pairs of entries and micro-tiles up to which the film is one band, so that the host need not wait
for their slots to be counted. About a fourth have one; other memory is never written to, which
costs nothing on the CPU."""


@dataclass(frozen=True)
class CompositedPairs:
    """Pairs of an entry and a micro-tile that were composited, in each of S samples.

    An entry with such a pair is *seen* and has a row of sums; those of a splat follow each other.
    Numbers of entries, sorted and unsorted, and splats continue from sample to sample.
    """

    masks: UInt32  # (S * M padded,): sorted -> bit per micro-tile
    words: UInt32  # (S * M padded / 32 * 16,): (group of 32, micro-tile) -> bit per entry
    row: UInt32  # (S * M + 1,): unsorted -> row of sums, or of the next entry that is seen
    first_row: UInt32  # (S * (N + 1),): splat -> first of its rows; one more for each sample
    samples: range  # of the image

    @staticmethod
    def find(bins: TileBins, stop: UInt32, samples: range) -> CompositedPairs:
        """Find the pairs before each micro-tile's ``stop``; see :class:`.CompositedTiles`."""
        t, count = types_of(bins.rows.Float), len(samples)
        padded, num_entries = dr.width(bins.masks), bins.num_entries
        _, entry = divide(dr.arange(t.UInt32, count * padded), padded, count)
        first_tile = dr.opaque(t.UInt32, bins.grid.tiles_of(samples).start)
        tiles = first_tile + repeat_array(bins.tiles, count, bins.grid.num_tiles)
        masks = t.UInt32(0)
        for k in range(MICROS // 4):
            stops = dr.gather(t.Array4u, stop, tiles * (MICROS // 4) + k)
            for m, of_micro in enumerate(stops):
                masks |= dr.select(entry < of_micro, t.UInt32(1 << (4 * k + m)), 0)
        masks &= repeat_array(bins.masks, count)
        dr.eval(masks)
        words = transpose_masks(masks)
        seen = dr.zeros(t.UInt32, count * num_entries + 1)
        dr.scatter(seen, t.UInt32(1), repeat_array(bins.source, count, num_entries), masks != 0)
        row = dr.prefix_sum(seen)
        first_row = dr.gather(t.UInt32, row, repeat_array(bins.first_entry, count, num_entries))
        dr.eval(words, first_row)
        return CompositedPairs(masks, words, row, first_row, samples)

    def run(self, splat: UInt32, sample: UInt32) -> tuple[UInt32, UInt32]:
        """Return the first of a splat's rows and their end; sample: number among the samples."""
        UInt32, size = type(splat), dr.width(self.first_row) // len(self.samples)
        place = sample * dr.opaque(UInt32, size) + splat
        first, end = (dr.gather(UInt32, self.first_row, place + k) for k in (0, 1))
        return first, end


@dataclass(frozen=True)
class Band:
    """Consecutive tiles, their sorted entries, and the most slots that these may have."""

    tiles: range  # of all samples of the image
    entries: range  # of all samples of the pairs
    num_slots: int

    @property
    def groups(self) -> range:
        """The groups of 32 entries that the entries are in; one at least."""
        first = self.entries.start // WORD
        return range(first, max(-(-self.entries.stop // WORD), first + 1))


def split_bands(bins: TileBins, pairs: CompositedPairs) -> list[Band]:
    """Cut the film of each sample into bands.

    If all pairs of entries and micro-tiles have room, the film is one band. Otherwise, the host
    reads the slots and entries of each tile.
    """
    t, count = types_of(bins.rows.Float), len(pairs.samples)
    entries, tiles = range(count * dr.width(bins.masks)), bins.grid.tiles_of(pairs.samples)
    if MICROS * len(entries) <= PAIRS_AT_ONCE:
        return [Band(tiles, entries, MICROS * len(entries))]
    running = dr.cumsum(dr.popcnt(pairs.masks))
    starts = repeat_array(bins.tile_start, count, dr.width(bins.masks))
    slots = dr.gather(t.UInt32, running, starts - 1, starts > 0)
    dr.eval(starts, slots)
    # The starts of all tiles and the last end, from a column with an end for each sample.
    columns = (np.array(column, np.int64).reshape(count, -1) for column in (starts, slots))
    starts, slots = (np.append(each[:, :-1], each[-1, -1]) for each in columns)
    count = -(-max(slots[-1], 1) // BAND_SLOTS)
    targets = slots[-1] * np.arange(1, count) / count
    edges = np.unique([0, *np.searchsorted(slots, targets, side="right") - 1, len(slots) - 1])
    first = bins.grid.tiles_of(pairs.samples).start
    return [
        Band(range(first + a, first + b), range(starts[a], starts[b]), int(slots[b] - slots[a]))
        for a, b in pairwise(edges.tolist())
    ]


@dataclass(frozen=True)
class Slots:
    """Indices of slots of the composited (entry, micro-tile) pairs of a band.

    The pairs of all tiles' first micro-tiles come first, in the order of the sorted entries, then
    those of the second ones, and so on: a lane writes contiguous memory. (In the order of the sums,
    each write would miss the cache.) Pairs behind a micro-tile's stop have no slot, so every slot
    is written exactly once.
    """

    pairs: UInt32  # (groups * 16 * 2,): (group, micro-tile) -> first slot, bits
    first_group: UInt32  # (1,): of the band
    band: Band
    samples: range  # of the pairs
    groups_of_sample: int

    def locate(self, group: UInt32, micro: UInt32, active: Bool | bool = True) -> Array2u:
        """Return the first slot of a group of entries in a micro-tile, and its composited bits.

        group: among those of all samples of the pairs.
        """
        index = (group - self.first_group) * MICROS + micro
        return dr.gather(types_of(type(group)).Array2u, self.pairs, index, active)

    def end(self, entries: Entries) -> UInt32:
        """Return the end of each lane's slots."""
        last = self._first_of_sample(entries) + entries.last
        first, word = self.locate(last, entries.micro, entries.head != 0)
        return first + dr.popcnt(word & entries.tail)

    def number(self, entries: Entries) -> UInt32:
        """Return the number of slots of each lane."""
        occupied = entries.head != 0
        first_group = self._first_of_sample(entries) + entries.first
        first, word = self.locate(first_group, entries.micro, occupied)
        begin = first + dr.popcnt(word & ~entries.head)
        return dr.select(occupied, self.end(entries) - begin, 0)

    def _first_of_sample(self, entries: Entries) -> UInt32:
        start, groups = self.samples.start, self.groups_of_sample
        start, groups = (dr.opaque(type(self.first_group), number) for number in (start, groups))
        return (entries.sample - start) * groups


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
    of_sample = dr.width(pairs.words) // MICROS // len(pairs.samples)
    return Slots(table, first_group, band, pairs.samples, of_sample)


def _words(pairs: CompositedPairs, band: Band, group: UInt32, micro: UInt32) -> UInt32:
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
    zero, micros = dr.zeros(t.Float, count), dr.gather(t.UInt32, pairs.masks, entry)
    # Lanes that only fill up a vector read what exists.
    group = dr.select(micros != 0, group, slots.first_group)
    spare = dr.opaque(t.UInt32, slots.band.num_slots)

    def body(micros: UInt32, totals: list) -> tuple:
        for _ in range(2):  # two at a time wait for memory together
            active = micros != 0
            with access_all_lanes(t.Float):
                first, word = slots.locate(group, find_lowest_bit(micros))
                slot = dr.select(active, first + dr.popcnt(word & below), spare)
                numbers = partials.load(slot)
            totals = [a + dr.select(active, b, 0) for a, b in zip(totals, numbers, strict=True)]
            micros = micros & (micros - 1)
        return micros, totals

    _, totals = dr.while_loop(
        state=(t.UInt32(micros), [t.Float(zero) for _ in range(partials.width)]),
        cond=lambda micros, totals: micros != 0,
        body=body,
    )
    rows = Rows.from_columns(totals)  # not as columns, which would share the sets of a cache
    dr.eval(rows)
    lane = dr.arange(t.UInt32, count)
    sample, entry = divide(entry, dr.width(bins.masks), len(pairs.samples))
    first_source = sample * dr.opaque(t.UInt32, bins.num_entries)
    source = first_source + dr.gather(t.UInt32, bins.source, entry)
    is_row = micros != 0
    sums.store(rows.load(lane), dr.gather(t.UInt32, pairs.row, source, is_row), is_row)
    dr.eval(sums)


def sum_runs(
    Float: type, begin: UInt32, end: UInt32, load: Callable[[UInt32], Sequence[Float]]
) -> list[Float]:
    """Sums over runs, one lane a run, of elements from ``begin`` to ``end``.

    load: the numbers of an element of a run.
    """
    width, zero = len(load(begin)), dr.zeros(Float, dr.width(begin))

    def body(element: UInt32, totals: list) -> tuple:
        return element + 1, [a + b for a, b in zip(totals, load(element), strict=True)]

    _, totals = dr.while_loop(
        state=(type(begin)(begin), [Float(zero) for _ in range(width)]),
        cond=lambda element, totals: element < end,
        body=body,
    )
    return totals
