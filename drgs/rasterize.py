r"""Compositing splats front to back, its adjoint and its tangent.

Layer 2, the last stage: ``TileBins`` + features -> planes of pixels. The image model is
equation 3 of the 3DGS paper: with splats i = 1, 2, ... in front-to-back order,

    a_i = min(0.99, o_i exp(-|U_i d_i|^2 / 2)),  d_i = pixel centre - mean_i
    T_1 = 1,  T_{i+1} = T_i (1 - a_i),  w_i = T_i a_i
    C = sum_i w_i c_i,  T = T_last

where splats with a_i < 1/255 are skipped and a pixel stops before the splat that would take T
below 1e-4. c_i is a vector of any length, the splat's *features*: colour, depth, or whatever
else is to be composited. The background is added by the caller, from T.

**Adjoint.** Let g = dL/dC and G = dL/dT. Whatever lies behind splat i contributes to the loss
through the factor T_{i+1} = T_i (1 - a_i) only. Let R_i be what one unit of light that passes
splat i is worth: R_last = G, since it reaches the background, and

    R_{i-1} = a_i (c_i . g) + (1 - a_i) R_i.

    dL/dc_i = w_i g,   dL/da_i = T_i (c_i . g - R_i).

The adjoint walks the splats back to front, from the last one that the pixel composited, and
recovers T_i = T_{i+1} / (1 - a_i) (3DGS, section 6), which alpha <= 0.99 keeps accurate. R is a
convex combination of the values behind it: its rounding errors do not grow, and a splat that is
seen through little transmittance has a gradient as accurate, relative to its own size, as the
first. (The equivalent sums from front to back, S_i = S_{i-1} - w_i (c_i . g) and dL/da_i =
T_i (c_i . g) - S_i / (1 - a_i), cancel: they carry the error of the whole sum to the last splat.)
Nothing is stored per pixel pair, and all decisions of the forward pass are taken again exactly.

**Mapping to the machine.** One SIMD lane is one micro-tile of 4x4 pixels, its pixels unrolled:
the load of a splat's record is paid once for 16 pixels. Lanes that share a vector wait for the
last of them, so that lanes with similarly many splats are put together.

**Memory.** A read or a write that no cache foresees takes as long as a lane's arithmetic. Lanes
therefore walk through memory in order: splats are copied into the order of the entries, and what
a lane of the adjoint writes is contiguous.

**No atomics.** In the adjoint, a lane sums each splat's partial derivatives over its 16 pixels
and writes them into a slot that belongs to this (splat, micro-tile) alone. One lane per entry
adds up its slots, one lane per splat its entries, in an order of their own. The result is the
same to the last bit in every run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr

from drgs.arrays import (
    empty_rows,
    interleave,
    is_float64,
    load_row,
    pack_rows,
    scatter_rows,
    store_row,
    types_of,
)
from drgs.constants import (
    ALPHA_MAX,
    LOG2_ALPHA_CUT,
    TRANSMITTANCE_STOP,
    WHITENING_SCALE,
)
from drgs.tiles import (
    GEOMETRY,
    GRID,
    MICRO,
    MICROS,
    TILE,
    WORD,
    TileBins,
    TileGrid,
    transpose_masks,
)

PIXELS = MICRO * MICRO


@dataclass(frozen=True)
class Layers:
    """What compositing makes of the splats, stored one row per micro-tile."""

    values: Any  # Float (tiles * 16 * (1 + C) * 16,): row: transmittance, then each feature
    ends: Any  # UInt32 (tiles * 16 * 16,): sorted entry from which on a pixel composited nothing
    stop: Any  # UInt32 (tiles * 16,): the largest of them in each micro-tile
    count: int  # C
    grid: TileGrid

    def planes(self) -> list[Any]:
        """1 + C planes in row-major pixel order, Float (H * W,), not evaluated.

        The first is T, the transmittance left for the background; then sum_i w_i c_i for each
        feature.
        """
        t = types_of(type(self.values))
        pixel = dr.arange(t.UInt32, self.grid.width * self.grid.height)
        width = dr.opaque(t.UInt32, self.grid.width)
        y = pixel // width
        x = pixel - y * width
        tile = (y // TILE) * dr.opaque(t.UInt32, self.grid.columns) + x // TILE
        micro = ((y % TILE) // MICRO) * GRID + (x % TILE) // MICRO
        base = (tile * MICROS + micro) * (PIXELS * (1 + self.count))
        index = base + (y % MICRO) * MICRO + x % MICRO
        return [dr.gather(t.Float, self.values, index + PIXELS * k) for k in range(1 + self.count)]


# ----------------------------------------------------------------------------------------------
# Lanes: which micro-tile, which pixels, which splat next
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Lanes:
    """One lane per micro-tile, in the order in which Dr.Jit starts them."""

    micro_tile: Any  # UInt32: tile * 16 + micro-tile within the tile
    micro: Any  # UInt32: micro-tile within the tile
    tile: Any  # UInt32
    x: Any  # UInt32: first pixel column
    y: Any  # UInt32: first pixel row


def _make_lanes(Float: type, grid: TileGrid) -> _Lanes:
    """Lanes such that neighbours in time are far apart on the film.

    Dr.Jit cuts a small launch into few blocks of consecutive lanes. Tiles are visited with a
    stride near the golden section, so that each block gets its share of the busy centre.
    """
    t = types_of(Float)
    stride = _coprime_stride(grid.num_tiles)
    lane = dr.arange(t.UInt32, grid.num_tiles * MICROS)
    turn, micro = lane // MICROS, lane % MICROS
    tile = t.UInt32(
        (t.UInt64(turn) * dr.opaque(t.UInt64, stride)) % dr.opaque(t.UInt64, grid.num_tiles)
    )
    columns = dr.opaque(t.UInt32, grid.columns)
    row = tile // columns
    return _Lanes(
        micro_tile=tile * MICROS + micro,
        micro=micro,
        tile=tile,
        x=(tile - row * columns) * TILE + (micro % GRID) * MICRO,
        y=row * TILE + (micro // GRID) * MICRO,
    )


def _similar_together(lanes: _Lanes, work: Any) -> _Lanes:
    """The same lanes, in each block ordered by how many splats they visit, roughly."""
    level = work // 4
    level = dr.select(level < _LEVELS, level, _LEVELS - 1)
    dr.eval(level)
    order = dr.detail.block_mkperm(level, min(_BLOCK, dr.width(level)), _LEVELS)
    return dr.gather(_Lanes, lanes, order)


_BLOCK = 32 * MICROS
"""Lanes that are ordered together. In larger blocks the lanes of a tile, which read the same
records, are too far apart; in smaller ones they are less alike."""

_LEVELS = 256


def _coprime_stride(count: int) -> int:
    stride = max(1, round(count * (math.sqrt(5) - 1) / 2))
    while math.gcd(stride, count) != 1:
        stride += 1
    return stride


@dataclass
class _Cursor:
    """Walks the set bits of a micro-tile's words: the splats that touch it.

    Not frozen: Dr.Jit assigns the fields of a loop's state.
    """

    word: Any  # UInt32: bits of the current group that are still to come
    group: Any  # UInt32: index of the current group of 32 entries


class _Entries:
    """The entries [start, end) of each lane's tile that touch its micro-tile, front to back."""

    def __init__(self, bins: TileBins, lanes: _Lanes, end: Any) -> None:
        UInt32 = type(lanes.tile)
        self.words, self.micro = bins.words, lanes.micro
        start = dr.gather(UInt32, bins.tile_start, lanes.tile)
        occupied = start < end
        # An empty lane gets first == last and no bits: it is over before it begins.
        self.first = dr.select(occupied, start // WORD, 0)
        self.last = dr.select(occupied, (end - 1) // WORD, 0)
        ones = UInt32(0xFFFFFFFF)
        self.head = dr.select(occupied, ones << (start % WORD), 0)
        self.tail = dr.select(occupied, ones >> (WORD - 1 - (end - 1) % WORD), 0)

    def begin(self) -> _Cursor:
        """The cursor at the first entry."""
        return self._open(self.first, True)

    def pending(self, cursor: _Cursor) -> Any:
        """Whether entries may be left."""
        return (cursor.word != 0) | (cursor.group < self.last)

    @staticmethod
    def current(cursor: _Cursor) -> tuple[Any, Any]:
        """The current sorted entry, and whether there is one (a word may be empty).

        Where there is none, the index lies between the entries before and those to come.
        """
        return cursor.group * WORD + dr.tzcnt(cursor.word), cursor.word != 0

    def advance(self, cursor: _Cursor) -> _Cursor:
        """Drop the current entry; open the next group when this one is used up."""
        word = cursor.word & (cursor.word - 1)
        return self._go_on(cursor, word, cursor.group + 1, cursor.group < self.last)

    def _go_on(self, cursor: _Cursor, word: Any, neighbor: Any, has_neighbor: Any) -> _Cursor:
        used_up = (word == 0) & has_neighbor
        opened = self._open(dr.select(used_up, neighbor, cursor.group), used_up)
        return _Cursor(word=dr.select(used_up, opened.word, word), group=opened.group)

    def _open(self, group: Any, active: Any) -> _Cursor:
        word = dr.gather(type(group), self.words, group * MICROS + self.micro, active)
        word &= dr.select(group == self.first, self.head, 0xFFFFFFFF)
        word &= dr.select(group == self.last, self.tail, 0xFFFFFFFF)
        return _Cursor(word=word, group=group)


class _EntriesBackToFront(_Entries):
    """The same entries in the opposite order."""

    def begin(self) -> _Cursor:
        """The cursor at the last entry."""
        return self._open(self.last, True)

    def pending(self, cursor: _Cursor) -> Any:
        """Whether entries may be left."""
        return (cursor.word != 0) | (cursor.group > self.first)

    @staticmethod
    def current(cursor: _Cursor) -> tuple[Any, Any]:
        """The current sorted entry, and whether there is one (a word may be empty)."""
        return cursor.group * WORD + _highest_bit(cursor.word), cursor.word != 0

    def advance(self, cursor: _Cursor) -> _Cursor:
        """Drop the current entry; open the group before when this one is used up."""
        bit = (type(cursor.word)(1) << (WORD - 1)) >> dr.lzcnt(cursor.word)
        word = cursor.word & ~bit
        return self._go_on(cursor, word, cursor.group - 1, cursor.group > self.first)


def _count_entries(entries: _Entries) -> Any:
    """How many entries each lane has."""

    def body(group: Any, count: Any) -> tuple[Any, Any]:
        return group + 1, count + dr.popcnt(entries._open(group, True).word)

    UInt32 = type(entries.first)
    _, count = dr.while_loop(
        state=(UInt32(entries.first), dr.zeros(UInt32, dr.width(entries.first))),
        cond=lambda group, count: group <= entries.last,
        body=body,
    )
    return count


def _highest_bit(word: Any) -> Any:
    return (WORD - 1) - dr.lzcnt(word)


def _load_pixels(plane: Any, lanes: _Lanes, grid: TileGrid) -> list[Any]:
    """The 16 values of a row-major plane of pixels in each micro-tile; 0 off the film."""
    return [dr.gather(type(plane), plane, index, inside) for index, inside in _pixels(lanes, grid)]


def _pixels(lanes: _Lanes, grid: TileGrid) -> list[tuple[Any, Any]]:
    """For the 16 pixels of each micro-tile: row-major index, and whether it is on the film."""
    UInt32 = type(lanes.x)
    width, height = dr.opaque(UInt32, grid.width), dr.opaque(UInt32, grid.height)
    pixels = []
    for pixel in range(PIXELS):
        row, column = divmod(pixel, MICRO)
        x, y = lanes.x + column, lanes.y + row
        pixels.append((y * width + x, (x < width) & (y < height)))
    return pixels


# ----------------------------------------------------------------------------------------------
# One splat at the 16 pixels of a micro-tile
# ----------------------------------------------------------------------------------------------


def _exp2_short(x: Any) -> Any:
    """2^x for float32 x in [-126, 127]; relative error below 2.2e-7.

    x = n + f with |f| <= 1/2; 2^f by a minimax polynomial of degree 5 (coefficients from a
    Remez exchange on the relative error, 7.5e-8), 2^n by adding n to the exponent bits. Adding
    1.5 * 2^23 rounds x and leaves n in the low bits of the sum.
    """
    t = types_of(type(x))
    shifted = x + 12582912.0
    f = x - (shifted - 12582912.0)
    p = t.Float(0.0013276471979479397)
    for c in (
        0.009675541334216184,
        0.05550713273542589,
        0.24022119723848476,
        0.6931469670647331,
        1.0000000716546822,
    ):
        p = dr.fma(p, f, c)
    exponent = dr.reinterpret_array(t.Int32, shifted) << 23
    return dr.reinterpret_array(t.Float, dr.reinterpret_array(t.Int32, p) + exponent)


def _exp2_function(Float: type) -> Any:
    return dr.exp2 if is_float64(Float) else _exp2_short


@dataclass(frozen=True)
class _Footprint:
    """A splat's record and its offsets from the rows and columns of a micro-tile."""

    dx: list[Any]  # 4: pixel column centres - mean, px
    dy: list[Any]  # 4: pixel row centres - mean, px
    u: list[list[Any]]  # [row][column]: first component of U d (scaled to base 2)
    log2_alpha: list[list[Any]]  # [row][column]: unclamped

    @staticmethod
    def of(geometry: list[Any], lanes: _Lanes, active: Any) -> _Footprint:
        """Evaluate the exponent of a splat at the 16 pixels."""
        mean_x, mean_y, p, r, s, log2_opacity = geometry
        t = types_of(type(mean_x))
        # On an inactive lane every alpha is below the cut.
        log2_opacity = dr.select(active, log2_opacity, -dr.inf)
        first_x, first_y = t.Float(lanes.x) + 0.5 - mean_x, t.Float(lanes.y) + 0.5 - mean_y
        dx = [first_x + i for i in range(MICRO)]
        dy = [first_y + j for j in range(MICRO)]
        p_dx = [p * d for d in dx]
        u, log2_alpha = [], []
        for d in dy:
            r_dy, v = r * d, s * d
            row = dr.fma(-v, v, log2_opacity)
            u.append([a + r_dy for a in p_dx])
            log2_alpha.append([dr.fma(-a, a, row) for a in u[-1]])
        return _Footprint(dx=dx, dy=dy, u=u, log2_alpha=log2_alpha)


@dataclass(frozen=True)
class _Alpha:
    """Alpha at one pixel, with the decisions taken on the way."""

    value: Any  # 0 where the splat is skipped
    smooth: Any  # Bool: not clamped, so that the derivative flows

    @staticmethod
    def at(log2_alpha: Any, exp2: Any) -> _Alpha:
        """alpha = min(0.99, 2^log2_alpha), or 0 below the cut."""
        # Far below the cut the short exp2 returns garbage; the selection discards it.
        unclamped = exp2(log2_alpha)
        smooth = unclamped < ALPHA_MAX
        value = dr.select(smooth, unclamped, ALPHA_MAX)
        return _Alpha(value=dr.select(log2_alpha >= LOG2_ALPHA_CUT, value, 0), smooth=smooth)


def _step(transmittance: Any, alpha: Any) -> tuple[Any, Any, Any]:
    """Composite one alpha: (weight, next transmittance, whether the pixel goes on).

    A finished pixel keeps its transmittance with a negative sign, which fails the comparison
    ever after.
    """
    after = dr.fma(-alpha, transmittance, transmittance)
    goes_on = after >= TRANSMITTANCE_STOP
    weight = dr.select(goes_on, alpha * transmittance, 0)
    return weight, dr.select(goes_on, after, -dr.abs(transmittance)), goes_on


@dataclass(frozen=True)
class Records:
    """What compositing loads for each sorted entry: its splat's geometry and features.

    A splat that touches several tiles is stored several times, so that the lanes of a tile read
    memory in order instead of jumping from splat to splat.
    """

    rows: Any  # Float (M padded * packets * 4,): geometry, features, padding
    count: int  # C, features

    @staticmethod
    def of(bins: TileBins, numbers: Callable[[Any], list[Any]]) -> Records:
        """Copies, evaluated, of each rank's ``numbers``, such as those of ``bins.splats``."""
        rows = pack_rows(numbers(bins.ranks))
        dr.eval(rows)
        return Records(rows=rows, count=bins.num_features)

    def load(self, entry: Any, active: Any) -> tuple[list[Any], list[Any]]:
        """Geometry (6) and features (C) of a sorted entry."""
        numbers = load_row(self.rows, GEOMETRY + self.count, entry, active)
        return numbers[:GEOMETRY], numbers[GEOMETRY:]


# ----------------------------------------------------------------------------------------------
# Forward
# ----------------------------------------------------------------------------------------------


def composite(bins: TileBins, records: Records) -> Layers:
    """Composite the features of all splats.

    bins: from ``bin_splats``; records: ``Records.of(bins, bins.splats)``.
    """
    t = types_of(type(bins.rows))
    count = records.count
    lanes = _make_lanes(t.Float, bins.grid)
    end = dr.gather(t.UInt32, bins.tile_start, lanes.tile + 1)
    lanes = _similar_together(lanes, _count_entries(_Entries(bins, lanes, end)))
    entries = _Entries(bins, lanes, dr.gather(t.UInt32, bins.tile_start, lanes.tile + 1))
    exp2 = _exp2_function(t.Float)

    def body(cursor: _Cursor, T: list, C: list, ends: list, unfinished: Any) -> tuple:
        entry, active = entries.current(cursor)
        geometry, color = records.load(entry, active)
        footprint = _Footprint.of(geometry, lanes, active)
        T, C, ends = list(T), [list(c) for c in C], list(ends)
        behind = dr.select(active, entry + 1, entry)
        for pixel in range(PIXELS):
            row, column = divmod(pixel, MICRO)
            alpha = _Alpha.at(footprint.log2_alpha[row][column], exp2)
            weight, T[pixel], goes_on = _step(T[pixel], alpha.value)
            ends[pixel] = dr.select(goes_on, behind, ends[pixel])
            for k in range(count):
                C[k][pixel] = dr.fma(weight, color[k], C[k][pixel])
        return entries.advance(cursor), T, C, ends, _any_positive(T)

    size = dr.width(lanes.tile)
    zero = dr.zeros(t.Float, size)
    _, T, C, ends, _ = dr.while_loop(
        state=(
            entries.begin(),
            # Pixels off the film are finished before they begin.
            [dr.select(inside, t.Float(1), -1) for _, inside in _pixels(lanes, bins.grid)],
            [[t.Float(zero) for _ in range(PIXELS)] for _ in range(count)],
            [dr.zeros(t.UInt32, size) for _ in range(PIXELS)],
            dr.full(t.Bool, True, size),
        ),
        cond=lambda cursor, T, C, ends, unfinished: entries.pending(cursor) & unfinished,
        body=body,
    )
    dr.eval(T, C, ends)
    columns = [dr.abs(v) for v in T] + [v for plane in C for v in plane]
    stop = _largest(ends)
    dr.eval(columns, stop)
    return Layers(
        values=scatter_rows(columns, lanes.micro_tile, size),
        ends=scatter_rows(ends, lanes.micro_tile, size),
        stop=scatter_rows([stop], lanes.micro_tile, size),
        count=count,
        grid=bins.grid,
    )


def _any_positive(values: list[Any]) -> Any:
    return _largest(values) > 0


def _largest(values: list[Any]) -> Any:
    largest = values[0]
    for v in values[1:]:
        largest = dr.select(v > largest, v, largest)
    return largest


# ----------------------------------------------------------------------------------------------
# Adjoint
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SplatGradients:
    """Derivatives of the loss with respect to the 2D splats, in the order of the Gaussians."""

    means2d: Any  # Array2f, loss per px
    whitening: Any  # Array3f
    opacities: Any  # Float
    features: list[Any]  # C of Float


@dataclass(frozen=True)
class _Slots:
    """Where each composited (entry, micro-tile) pair stores its partial derivatives.

    First come the pairs of all tiles' first micro-tiles, in the order of the sorted entries, then
    those of the second ones, and so on: what a lane writes is contiguous. (In the order in which
    the slots are added up, each write would wait for memory of its own.) Pairs behind a
    micro-tile's stop have no slot, so that every slot is written exactly once.
    """

    pairs: Any  # UInt32 (M padded / 32 * 16 * 2,): (group of 32, micro-tile) -> first slot, bits
    composited: Any  # UInt32 (M padded,): sorted -> bit per micro-tile
    count: int

    def at(self, group: Any, micro: Any, active: Any = True) -> tuple[Any, Any]:
        """First slot of a group of entries in a micro-tile, and the word of its composited bits."""
        return dr.gather(types_of(type(group)).Array2u, self.pairs, group * MICROS + micro, active)

    def end(self, entries: _Entries) -> Any:
        """Where each lane's slots end."""
        first, word = self.at(entries.last, entries.micro)
        return first + dr.popcnt(word & entries.tail)

    def number(self, entries: _Entries) -> Any:
        """How many slots each lane has."""
        first, word = self.at(entries.first, entries.micro)
        begin = first + dr.popcnt(word & ~entries.head)
        return dr.select(entries.head == 0, 0, self.end(entries) - begin)


def _assign_slots(bins: TileBins, layers: Layers) -> _Slots:
    """Number the slots. The host reads one value, how many there are."""
    t = types_of(type(bins.rows))
    entry = dr.arange(t.UInt32, dr.width(bins.masks))
    composited = t.UInt32(0)
    for k in range(MICROS // 4):
        stops = dr.gather(t.Array4u, layers.stop, bins.tiles * (MICROS // 4) + k)
        for m, stop in enumerate(stops):
            composited |= dr.select(entry < stop, t.UInt32(1 << (4 * k + m)), 0)
    composited &= bins.masks
    dr.eval(composited)
    words = transpose_masks(composited)

    num_words = dr.width(words)
    groups = dr.opaque(t.UInt32, num_words // MICROS)
    index = dr.arange(t.UInt32, num_words + 1)
    micro = index // groups
    transposed = (index - micro * groups) * MICROS + micro
    exists = index < dr.opaque(t.UInt32, num_words)
    first = dr.prefix_sum(dr.popcnt(dr.gather(t.UInt32, words, transposed, exists)))
    count = int(first[num_words])

    index = dr.arange(t.UInt32, num_words)
    group, micro = index // MICROS, index % MICROS
    pairs = interleave([dr.gather(t.UInt32, first, micro * groups + group), words])
    dr.eval(pairs)
    return _Slots(pairs=pairs, composited=composited, count=count)


MOMENTS = 6
"""Sums over pixels that give the derivatives of a splat's geometry; see :func:`_sum_slots`."""


def composite_adjoint(
    bins: TileBins,
    records: Records,
    layers: Layers,
    d_features: list[Any],
    d_transmittance: Any,
) -> SplatGradients:
    """Derivatives with respect to the splats, given those with respect to the planes.

    layers: what :func:`composite` returned for the same bins and records; d_features: C planes
    (H * W,); d_transmittance: plane (H * W,). Not differentiated: the order, the decisions
    (cut, clamp, stop).
    """
    t = types_of(type(bins.rows))
    count = layers.count
    slots = _assign_slots(bins, layers)
    lanes = _make_lanes(t.Float, bins.grid)
    stop = dr.gather(t.UInt32, layers.stop, lanes.micro_tile)
    lanes = _similar_together(lanes, slots.number(_Entries(bins, lanes, stop)))
    stop = dr.gather(t.UInt32, layers.stop, lanes.micro_tile)
    entries = _EntriesBackToFront(bins, lanes, stop)
    exp2 = _exp2_function(t.Float)

    g = [_load_pixels(plane, lanes, bins.grid) for plane in d_features]
    ends = _load_row(layers.ends, lanes.micro_tile, 1)
    transmittance = _load_row(layers.values, lanes.micro_tile, 1 + count)
    partials = empty_rows(t.Float, MOMENTS + count, max(slots.count, 1))

    def body(cursor: _Cursor, slot: Any, T: list, R: list) -> tuple:
        entry, active = entries.current(cursor)
        slot = dr.select(active, slot - 1, slot)
        geometry, color = records.load(entry, active)
        footprint = _Footprint.of(geometry, lanes, active)
        reached = [entry < end for end in ends]
        T, R, d_log_alpha, d_color = _adjoint_step(footprint, reached, color, T, R, g, exp2)
        moments = _moments(footprint, d_log_alpha)
        values = moments + d_color
        store_row(partials, values, slot, active)
        return entries.advance(cursor), slot, T, R

    loop = dr.while_loop(
        state=(
            entries.begin(),
            slots.end(entries),
            transmittance,
            _load_pixels(d_transmittance, lanes, bins.grid),
        ),
        cond=lambda cursor, slot, T, R: entries.pending(cursor),
        body=body,
    )
    dr.eval(loop, partials)
    return _sum_slots(bins, slots, partials, count)


def _adjoint_step(
    footprint: _Footprint,
    reached: list[Any],
    color: list[Any],
    T: list[Any],
    R: list[Any],
    g: list[list[Any]],
    exp2: Any,
) -> tuple[list, list, list, list]:
    """One splat at 16 pixels: T and R before it, d loss / d ln(alpha), d loss / d color (summed).

    reached: whether each pixel was still unfinished; color: C features of the splat; T, R: past
    the splat; g: [feature][pixel] derivative of the loss with respect to C.
    """
    T, R = list(T), list(R)
    log2_alphas = [value for row in footprint.log2_alpha for value in row]
    zero = type(T[0])(0)
    d_color = [zero for _ in color]
    d_log_alpha = []
    for pixel, log2_alpha in enumerate(log2_alphas):
        alpha = _Alpha.at(log2_alpha, exp2)
        value = dr.select(reached[pixel], alpha.value, 0)
        T[pixel] = T[pixel] / (1 - value)
        weight = value * T[pixel]
        seen = zero
        for k, c in enumerate(color):
            seen = dr.fma(c, g[k][pixel], seen)
            d_color[k] = dr.fma(weight, g[k][pixel], d_color[k])
        gain = seen - R[pixel]
        R[pixel] = dr.fma(value, gain, R[pixel])
        # d loss / d ln(alpha) = a T (c.g - R), zero where alpha is clamped.
        d_log_alpha.append(dr.select(alpha.smooth, weight * gain, 0))
    return T, R, d_log_alpha, d_color


def _load_row(values: Any, micro_tile: Any, planes: int) -> list[Any]:
    """The first 16 values of each micro-tile's row of ``planes`` x 16."""
    first = micro_tile * (planes * PIXELS)
    return [dr.gather(type(values), values, first + k) for k in range(PIXELS)]


def _moments(footprint: _Footprint, v: list[Any]) -> list[Any]:
    """Sums over the 16 pixels of v = d loss / d ln(alpha), times 1, u, u dx, u dy, dy, dy^2.

    dx is shared by a column and dy by a row, so rows and columns are summed first.
    """
    rows = [v[MICRO * j : MICRO * j + MICRO] for j in range(MICRO)]
    z = [
        [a * b for a, b in zip(*pair, strict=True)] for pair in zip(rows, footprint.u, strict=True)
    ]
    v_rows, z_rows = [_sum(row) for row in rows], [_sum(row) for row in z]
    z_columns = [_sum(list(column)) for column in zip(*z, strict=True)]
    v_dy = [a * b for a, b in zip(v_rows, footprint.dy, strict=True)]
    return [
        _sum(v_rows),
        _sum(z_rows),
        _dot(z_columns, footprint.dx),
        _dot(z_rows, footprint.dy),
        _sum(v_dy),
        _dot(v_dy, footprint.dy),
    ]


def _sum(values: list[Any]) -> Any:
    """Pairwise: the shortest chain of dependent additions."""
    while len(values) > 1:
        values = [a + b for a, b in zip(values[::2], values[1::2], strict=True)]
    return values[0]


def _dot(a: list[Any], b: list[Any]) -> Any:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = dr.fma(x, y, total)
    return total


def _sum_slots(bins: TileBins, slots: _Slots, partials: Any, count: int) -> SplatGradients:
    """Add up the slots of each entry, the entries of each splat, and turn sums into derivatives."""
    t = types_of(type(bins.rows))
    width = MOMENTS + count
    by_entry = _sum_entries(bins, slots, partials, width)
    rank = dr.arange(t.UInt32, dr.width(bins.order))
    begin, end = (dr.gather(t.UInt32, bins.first_entry, rank + k) for k in (0, 1))

    def body(entry: Any, totals: list) -> tuple:
        numbers = load_row(by_entry, width, entry)
        return entry + 1, [a + b for a, b in zip(totals, numbers, strict=True)]

    zero = dr.zeros(t.Float, dr.width(rank))
    _, totals = dr.while_loop(
        state=(begin, [t.Float(zero) for _ in range(width)]),
        cond=lambda entry, totals: entry < end,
        body=body,
    )
    _, _, p, r, s, log2_opacity = bins.splats(rank)[:GEOMETRY]
    v, v_u, v_u_dx, v_u_dy, v_dy, v_dy_dy = totals[:MOMENTS]
    # log2_alpha = log2_opacity - u^2 - (s dy)^2, u = p dx + r dy, dx = x - mean: hence
    # d ln(alpha) / d(anything) = ln(2) * d log2_alpha / d(anything).
    scale = 2 * math.log(2)
    columns = [
        scale * p * v_u,
        scale * dr.fma(r, v_u, s * s * v_dy),
        -scale * WHITENING_SCALE * v_u_dx,
        -scale * WHITENING_SCALE * v_u_dy,
        -scale * WHITENING_SCALE * s * v_dy_dy,
        # An opacity that underflows to 0 is invisible: 0 and not 0 * inf.
        dr.select(v == 0, 0, v * dr.exp2(-log2_opacity)),
        *totals[MOMENTS:],
    ]
    dr.eval(columns)
    size = dr.width(rank)
    flat = scatter_rows(columns, bins.order, size)
    row = [dr.gather(t.Float, flat, rank * len(columns) + k) for k in range(len(columns))]
    return SplatGradients(
        means2d=t.Array2f(row[0:2]),
        whitening=t.Array3f(row[2:5]),
        opacities=row[5],
        features=row[6:],
    )


def _sum_entries(bins: TileBins, slots: _Slots, partials: Any, width: int) -> Any:
    """Sums over the micro-tiles of each entry: rows of ``width`` numbers by unsorted entry."""
    t = types_of(type(bins.rows))
    entry = dr.arange(t.UInt32, max(bins.num_entries, 1))
    group, below = entry // WORD, (t.UInt32(1) << (entry % WORD)) - 1

    def body(micros: Any, totals: list) -> tuple:
        for _ in range(2):  # two at a time wait for memory together
            active = micros != 0
            first, word = slots.at(group, dr.tzcnt(micros), active)
            numbers = load_row(partials, width, first + dr.popcnt(word & below), active)
            totals = [a + b for a, b in zip(totals, numbers, strict=True)]
            micros = micros & (micros - 1)
        return micros, totals

    zero = dr.zeros(t.Float, dr.width(entry))
    _, totals = dr.while_loop(
        state=(
            dr.gather(t.UInt32, slots.composited, entry),
            [t.Float(zero) for _ in range(width)],
        ),
        cond=lambda micros, totals: micros != 0,
        body=body,
    )
    dr.eval(totals)
    rows = empty_rows(t.Float, width, dr.width(entry))
    store_row(rows, totals, dr.gather(t.UInt32, bins.source, entry))
    return rows


# ----------------------------------------------------------------------------------------------
# Tangent (forward mode)
# ----------------------------------------------------------------------------------------------


def composite_tangent(
    bins: TileBins, records: Records, layers: Layers, tangents: SplatGradients
) -> Layers:
    """Directional derivatives of the planes along ``tangents`` of the 2D splats.

    tangents: the same fields as the gradients, holding the direction. Returns the tangents of
    the planes that :func:`composite` made. Not differentiated: the order, the decisions.
    """
    t = types_of(type(bins.rows))
    count = layers.count
    lanes = _make_lanes(t.Float, bins.grid)
    entries = _Entries(bins, lanes, dr.gather(t.UInt32, layers.stop, lanes.micro_tile))
    exp2 = _exp2_function(t.Float)
    d_records = _pack_tangents(bins, tangents)

    def body(cursor: _Cursor, T: list, dT: list, dC: list) -> tuple:
        entry, active = entries.current(cursor)
        geometry, color = records.load(entry, active)
        footprint = _Footprint.of(geometry, lanes, active)
        d_geometry, d_color = d_records.load(entry, active)
        d_log_alpha = _footprint_tangent(geometry, footprint, d_geometry)
        T, dT, dC = list(T), list(dT), [list(c) for c in dC]
        for pixel in range(PIXELS):
            row, column = divmod(pixel, MICRO)
            alpha = _Alpha.at(footprint.log2_alpha[row][column], exp2)
            before, d_before = dr.abs(T[pixel]), dT[pixel]
            weight, T[pixel], goes_on = _step(T[pixel], alpha.value)
            d_alpha = dr.select(alpha.smooth, alpha.value * d_log_alpha[row][column], 0)
            d_weight = dr.select(goes_on, dr.fma(before, d_alpha, alpha.value * d_before), 0)
            dT[pixel] = d_before - d_weight
            for k in range(count):
                change = dr.fma(d_weight, color[k], weight * d_color[k])
                dC[k][pixel] = dC[k][pixel] + change
        return entries.advance(cursor), T, dT, dC

    size = dr.width(lanes.tile)
    one, zero = dr.ones(t.Float, size), dr.zeros(t.Float, size)
    _, _, dT, dC = dr.while_loop(
        state=(
            entries.begin(),
            [t.Float(one) for _ in range(PIXELS)],
            [t.Float(zero) for _ in range(PIXELS)],
            [[t.Float(zero) for _ in range(PIXELS)] for _ in range(count)],
        ),
        cond=lambda cursor, T, dT, dC: entries.pending(cursor),
        body=body,
    )
    columns = dT + [v for plane in dC for v in plane]
    dr.eval(columns)
    return Layers(
        values=scatter_rows(columns, lanes.micro_tile, size),
        ends=layers.ends,
        stop=layers.stop,
        count=count,
        grid=bins.grid,
    )


def _pack_tangents(bins: TileBins, tangents: SplatGradients) -> Records:
    """The records' tangents: of mean, p, r, s (unscaled), ln(opacity), and of the features."""
    t = types_of(type(bins.rows))
    rank = dr.arange(t.UInt32, dr.width(bins.order))
    log2_opacity = bins.splats(rank)[GEOMETRY - 1]
    numbers = [
        dr.gather(t.Float, column, bins.order)
        for column in (
            *tangents.means2d, *tangents.whitening, tangents.opacities, *tangents.features
        )
    ]  # fmt: skip
    numbers[GEOMETRY - 1] *= dr.exp2(-log2_opacity)
    rows = pack_rows(numbers)
    dr.eval(rows)
    return Records.of(bins, partial(load_row, rows, len(numbers)))


def _footprint_tangent(
    geometry: list[Any], footprint: _Footprint, d_geometry: list[Any]
) -> list[list[Any]]:
    """Tangent of ln(alpha) at the 16 pixels, [row][column]."""
    _, _, p, r, s, _ = geometry
    d_x, d_y, d_p, d_r, d_s, d_log_opacity = d_geometry
    d_p, d_r, d_s = d_p * WHITENING_SCALE, d_r * WHITENING_SCALE, d_s * WHITENING_SCALE
    scale = 2 * math.log(2)
    result = []
    for j, dy in enumerate(footprint.dy):
        dv = dr.fma(d_s, dy, -s * d_y)
        d_row = dr.fma(-scale * s * dy, dv, d_log_opacity)
        du_row = dr.fma(d_r, dy, -dr.fma(p, d_x, r * d_y))
        result.append(
            [
                dr.fma(-scale * footprint.u[j][i], dr.fma(d_p, dx, du_row), d_row)
                for i, dx in enumerate(footprint.dx)
            ]
        )
    return result
