r"""Compositing splats front to back, its adjoint and its tangent.

The last stage: ``TileBins`` + features -> planes of pixels. The image model is equation 3 of the
3DGS paper: with splats i = 1, 2, ... in front-to-back order,

    a_i = min(0.99, o_i exp(-|U_i d_i|^2 / 2)),  d_i = pixel centre - mean_i
    T_1 = 1,  T_{i+1} = T_i (1 - a_i),  w_i = T_i a_i
    C = sum_i w_i c_i,  T = T_last

where splats with a_i < 1/255 are skipped and a pixel stops before the splat that would take T
below 1e-4. c_i is a vector of any length, the splat's *features*, such as colour and depth. The
caller adds the background with the weight T.

**Adjoint.** Let g = dL/dC and G = dL/dT. Everything behind splat i affects the loss only through
the factor T_{i+1} = T_i (1 - a_i). Let b_i ("behind") be the derivative of the loss with respect to
that factor: b_last = G, since the background is behind the last splat, and

    b_{i-1} = a_i (c_i . g) + (1 - a_i) b_i.

    dL/dc_i = w_i g,   dL/da_i = T_i (c_i . g - b_i).

The adjoint iterates back to front, from the last splat that the pixel composited, and recovers
T_i = T_{i+1} / (1 - a_i) (3DGS, section 6), which is accurate because alpha <= 0.99. b is a convex
combination of the values behind it, so its rounding errors do not grow: the gradient of a splat
behind many others has the same relative accuracy as that of the first. (The equivalent sums from
front to back, S_i = S_{i-1} - w_i (c_i . g) and dL/da_i = T_i (c_i . g) - S_i / (1 - a_i), suffer
from cancellation: the last splat gets the rounding error of the whole sum.) Nothing is stored per
pixel and splat, and the tests of the forward pass are repeated exactly.

**Mapping to the machine.** One SIMD lane is one micro-tile of 4x4 pixels, unrolled: a splat's
record is loaded once for 16 pixels. The lanes of a vector wait for the slowest, so lanes with
similar numbers of splats are grouped.

What changes in a pixel is kept in variables in memory that all lanes read and write. Dr.Jit would
select the old or the new value of each number in a loop's state, as a lane may have left the loop;
a lane without a splat computes alpha = 0 instead, which changes nothing.

**Memory.** A cache miss takes as long as a lane's arithmetic. Lanes therefore access memory in
order: splats are copied into the order of the entries, and a lane of the adjoint writes contiguous
memory.

**No atomics.** In the adjoint, a lane sums each splat's partial derivatives over its 16 pixels
and writes them into the slot of this (splat, micro-tile) pair: see
:mod:`drgs.splatting.reduction`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import and_, or_
from typing import Any, cast

import drjit as dr

from drgs.core.arrays import (
    Rows,
    divide,
    existing_lanes,
    quotient,
    reinterpret,
    scatter_rows,
    types_of,
)
from drgs.core.private import access_all_lanes
from drgs.core.types import Array2f, Bool, Float, Int32, UInt32
from drgs.splatting.footprint import Alpha, SplatFeatures
from drgs.splatting.grid import (
    GRID,
    MICRO,
    MICROS,
    PIXELS,
    TILE,
    group_by_work,
    load_lane_row,
    load_pixels,
    make_lanes,
    pixels_of,
)
from drgs.splatting.reduction import (
    CompositedPairs,
    Slots,
    assign_slots,
    split_bands,
    sum_entries,
    sum_runs,
)
from drgs.splatting.tiles import Cursor, Entries, EntriesBackToFront, TileBins, count_entries


@dataclass(frozen=True)
class CompositedTiles:
    """The composited image, stored one row per micro-tile of each sample, and its inputs."""

    bins: TileBins
    records: Any  # of their order: Records, or those of each group
    values: Float  # (tiles * 16 * (1 + C) * 16,): row: transmittance, then each plane
    ends: UInt32  # (tiles * 16 * 16,): sorted entry from which on a pixel composited nothing
    stop: UInt32  # (tiles * 16,): the largest of them in each micro-tile
    count: int  # C, planes

    def planes(self) -> list[Float]:
        """Return T, then sum_i w_i c_i: Float (samples * H * W,) each, row-major, not evaluated."""
        return self.unpack(self.values)

    def unpack(self, values: Float) -> list[Float]:
        """Return planes, from numbers that are stored as ``values`` are."""
        t = types_of(type(values))
        grid = self.bins.grid
        pixel = existing_lanes(t.UInt32, grid.num_pixels)
        y = quotient(pixel, grid.width)
        x = pixel - y * dr.opaque(t.UInt32, grid.width)
        sample, y = divide(y, grid.height, grid.samples)
        tile = (y // TILE) * dr.opaque(t.UInt32, grid.columns) + x // TILE
        tile += sample * dr.opaque(t.UInt32, grid.num_tiles)
        micro = ((y % TILE) // MICRO) * GRID + (x % TILE) // MICRO
        base = (tile * MICROS + micro) * (PIXELS * (1 + self.count))
        index = base + (y % MICRO) * MICRO + x % MICRO
        with access_all_lanes(t.Float):
            return [dr.gather(t.Float, values, index + PIXELS * k) for k in range(1 + self.count)]


def composite_step(transmittance: Float, alpha: Float, stop: float) -> tuple[Float, Float, Bool]:
    """Composite one alpha; return its weight, the next transmittance, and unfinished pixels.

    stop: the last transmittance that a pixel may have.

    A finished pixel keeps its transmittance with a negative sign, which fails the comparison
    ever after.
    """
    after = dr.fma(-alpha, transmittance, transmittance)
    goes_on = after >= stop
    weight = dr.select(goes_on, alpha * transmittance, 0)
    return weight, dr.select(goes_on, after, -dr.abs(transmittance)), goes_on


@dataclass(frozen=True)
class Records:
    """The rows that compositing loads, one per sorted entry: its splat's geometry and features.

    A splat that touches several tiles is stored several times, so that the lanes of a tile read
    memory in order instead of jumping from splat to splat.
    """

    rows: Rows  # by sorted entry: geometry, features, keys
    num_geometry: int
    num_features: int

    @staticmethod
    def from_splats(bins: TileBins, numbers: Callable[[UInt32, Bool], list[Float]]) -> Records:
        """Copy each splat's ``numbers``, such as ``bins.rows.load``, and evaluate them.

        numbers: a function of splats and active lanes. Entries that touch nothing have zeros.
        """
        rows = Rows.from_columns(numbers(bins.splats, bins.masks != 0))
        dr.eval(rows)
        return Records(rows, bins.model.falloff.num_geometry, bins.num_features)

    def load(self, entry: UInt32, active: Bool | bool) -> tuple[list[Float], list[Float]]:
        """Return geometry and features of a sorted entry."""
        numbers = self.rows.load(entry, active)
        return numbers[: self.num_geometry], numbers[self.num_geometry :][: self.num_features]

    def load_anywhere(self, entry: UInt32, active: Bool) -> tuple[list[Float], list[Float]]:
        """Return the same; on lanes that are not active, any splat's geometry, and features 0."""
        geometry, features = self.load(entry, True)
        return geometry, [dr.select(active, number, 0) for number in features]

    def load_keys(self, entry: UInt32, active: Bool | bool) -> list[Float]:
        """Return keys of a sorted entry."""
        return self.rows.load(entry, active)[self.num_geometry + self.num_features :]


def composite(bins: TileBins, records: Records) -> CompositedTiles:
    """Composite the features of all splats; records: of ``bins.rows.load``."""
    t = types_of(bins.rows.Float)
    lanes = make_lanes(t.Float, bins.grid)
    end = dr.gather(t.UInt32, bins.tile_start, lanes.tile + 1)
    lanes = group_by_work(t.Float, bins.grid, count_entries(Entries(bins, lanes, end)))
    entries = Entries(bins, lanes, dr.gather(t.UInt32, bins.tile_start, lanes.tile + 1))
    model = bins.model.bind(lanes, bins.grid)
    count = model.features.num_planes(bins.num_features)

    size, planes = dr.width(lanes.tile), 1 + count
    zero, stop = dr.zeros(t.Float, size), model.cutoffs.transmittance_stop
    start = dr.alloc_local(t.Float, planes * PIXELS, zero)
    for pixel, (_, inside) in enumerate(pixels_of(lanes, bins.grid)):
        # Pixels off the film are finished before they begin.
        start[planes * pixel] = dr.select(inside, t.Float(1), -1)

    def body(
        cursor: Cursor, values: dr.Local[Float], ends: dr.Local[UInt32], unfinished: Bool
    ) -> tuple:
        entry, active = entries.current(cursor)
        active &= unfinished
        cursor = entries.advance(cursor)
        signs: Int32 | int = -1
        following = dr.select(active, entry + 1, 0)
        # On a lane that is not active, alpha is zero and nothing changes.
        with access_all_lanes(t.Float):
            geometry, features = records.load_anywhere(entry, active)
            footprint = model.footprint(geometry, lanes, active)
            for pixel, alpha in enumerate(model.alphas(geometry, footprint)):
                T, *C = (values[planes * pixel + k] for k in range(planes))
                weight, T, goes_on = composite_step(T, alpha.value, stop)
                signs &= sign_bits(T)
                C = model.features.add(C, features, pixel, weight)
                for k, value in enumerate([T, *C]):
                    values[planes * pixel + k] = value
                ends[pixel] = dr.maximum(ends[pixel], dr.select(goes_on, following, 0))
        return cursor, values, ends, signs >= 0

    cursor = entries.begin()
    ends = dr.alloc_local(t.UInt32, PIXELS, dr.zeros(t.UInt32, size))
    _, values, ends, _ = dr.while_loop(
        (cursor, start, ends, dr.full(t.Bool, True, size)),
        lambda cursor, values, ends, unfinished: entries.pending(cursor) & unfinished,
        body,
    )
    columns = [values[planes * pixel + k] for k in range(planes) for pixel in range(PIXELS)]
    columns[:PIXELS] = [dr.abs(T) for T in columns[:PIXELS]]
    ends = [ends[pixel] for pixel in range(PIXELS)]
    rows = scatter_rows(columns, lanes.micro_tile, size)
    end_rows = scatter_rows(ends, lanes.micro_tile, size)
    last = reduce(lambda a, b: dr.select(b > a, b, a), ends)
    stops = scatter_rows([last], lanes.micro_tile, size)
    dr.eval(rows, end_rows, stops)
    return CompositedTiles(bins, records, rows, end_rows, stops, count)


def sign_bits(value: Float) -> Int32:
    """Return an integer, of the number's size, that is negative where the number is."""
    return reinterpret(cast("type[Int32]", dr.int_array_t(type(value))), value)


def any_unfinished(transmittances: list[Float]) -> Bool:
    """Return lanes with a transmittance that is not negative."""
    return reduce(and_, map(sign_bits, transmittances)) >= 0


SPARE_ROWS = 64  # behind the slots, for sums of lanes without a splat

ONE_SAMPLE = range(1)  # samples of an image that has one


@dataclass(frozen=True)
class SplatGradients:
    """Derivatives of the loss with respect to the 2D splats, in the order of the Gaussians."""

    geometry: list[Float]  # mean x, y (per px), p, r, s, opacity, more of the falloff's
    features: list[Float]

    def plus(self, other: SplatGradients) -> SplatGradients:
        """Add other derivatives of the same splats."""
        return SplatGradients(
            geometry=[a + b for a, b in zip(self.geometry, other.geometry, strict=True)],
            features=[a + b for a, b in zip(self.features, other.features, strict=True)],
        )

    def are_nonzero(self) -> Bool:
        """Return the splats that a pixel's derivative depends on, those of NaN included."""
        return reduce(or_, (~(column == 0) for column in self.geometry + self.features))

    @property
    def means2d(self) -> Array2f:
        """Derivatives of the means on the film, loss per px."""
        return types_of(type(self.geometry[0])).Array2f(self.geometry[:2])


def composite_adjoint(
    tiles: CompositedTiles,
    d_planes: Sequence[Float],
    samples: range = ONE_SAMPLE,
    before: SplatGradients | None = None,
) -> SplatGradients:
    """Return derivatives with respect to the splats, given those with respect to the planes.

    tiles: the result of :func:`composite`; d_planes: 1 + C planes (samples * H * W,), as of
    :meth:`CompositedTiles.planes`; samples: which of the image's, added one after the other to the
    derivatives ``before``. Not differentiated: the order, the decisions (cut, clamp, stop).
    """
    bins = tiles.bins
    pairs = CompositedPairs.find(bins, tiles.stop, samples)
    bands = split_bands(bins, pairs)
    num_rows = bins.num_entries * len(samples)
    if len(bands) > 1:  # the host has waited
        num_rows = int(pairs.row[dr.width(pairs.row) - 1])
    sums = Rows.empty(bins.rows.Float, bins.num_sums, max(num_rows, 1))
    for band in bands:
        slots = assign_slots(pairs, band)
        partials = _partials(tiles, slots, d_planes)
        sum_entries(bins, pairs, slots, partials, sums)

    def totals(splat: UInt32, sample: UInt32) -> list[Float]:
        return sum_runs(sums.Float, *pairs.run(splat, sample), sums.load)

    return splat_gradients(bins, totals, len(samples), before)


def _partials(tiles: CompositedTiles, slots: Slots, d_planes: Sequence[Float]) -> Rows:
    """Return, by slot, moments and features' derivatives summed over 16 pixels; evaluated."""
    bins, (d_transmittance, *d_features) = tiles.bins, d_planes
    t, in_band = types_of(bins.rows.Float), slots.band.tiles
    lanes = make_lanes(t.Float, bins.grid, tiles=in_band)
    stop = dr.gather(t.UInt32, tiles.stop, lanes.micro_tile)
    work = slots.number(Entries(bins, lanes, stop))
    lanes = group_by_work(t.Float, bins.grid, work, in_band)
    stop = dr.gather(t.UInt32, tiles.stop, lanes.micro_tile)
    entries = EntriesBackToFront(bins, lanes, stop)
    model = bins.model.bind(lanes, bins.grid)

    g = [load_pixels(plane, lanes, bins.grid) for plane in d_features]
    ends = [reinterpret(t.Int32, x) for x in load_lane_row(tiles.ends, lanes.micro_tile, 1)]
    transmittance = load_lane_row(tiles.values, lanes.micro_tile, 1 + tiles.count)
    partials = Rows.empty(t.Float, bins.num_sums, slots.band.num_slots + SPARE_ROWS)
    behind = load_pixels(d_transmittance, lanes, bins.grid)
    last = dr.alloc_local(t.Float, 2 * PIXELS)
    for pixel in range(PIXELS):
        last[2 * pixel], last[2 * pixel + 1] = transmittance[pixel], behind[pixel]
    # Of their own for each part of a launch: threads would wait for each other's writes.
    part = dr.arange(t.UInt32, dr.width(lanes.tile)) // MICROS % SPARE_ROWS
    spare = dr.opaque(t.UInt32, slots.band.num_slots) + part

    def body(cursor: Cursor, slot: UInt32, pixels: dr.Local[Float]) -> tuple:
        entry, active = entries.current(cursor)
        slot = dr.select(active, slot - 1, slot)
        cursor = entries.advance(cursor)
        # On a lane that is not active, alpha is zero and no pixel changes.
        with access_all_lanes(t.Float):
            geometry, features = tiles.records.load_anywhere(entry, active)
            footprint = model.footprint(geometry, lanes, active)
            # Comparing unsigned numbers takes more instructions.
            composited = [reinterpret(t.Int32, entry) < end for end in ends]
            alphas = zip(model.alphas(geometry, footprint), composited, strict=True)
            d_log_alpha, d_features = _adjoint_step(alphas, features, model.features, pixels, g)
            moments = model.falloff.moments(footprint, d_log_alpha, model.positions)
            # All lanes store: with a mask, each has a branch.
            partials.store(moments + d_features, dr.select(active, slot, spare))
        return cursor, slot, pixels

    loop = dr.while_loop(
        state=(entries.begin(), slots.end(entries), last),
        cond=lambda cursor, slot, pixels: entries.pending(cursor),
        body=body,
    )
    dr.eval(loop[:2], partials)
    return partials


def _adjoint_step(
    alphas: Iterable[tuple[Alpha, Bool]],
    stored: list[Float],
    features: SplatFeatures,
    pixels: dr.Local[Float],
    g: list[list[Float]],
) -> tuple[list[Float], list[Float]]:
    """Return d loss / d ln(alpha) of a splat at 16 pixels, and d loss / d stored.

    alphas: with whether each pixel was unfinished; stored: the splat's stored numbers; features:
    their values at a pixel; pixels: T and b of each, behind the splat, replaced by those before it;
    g: [plane][pixel] derivative of the loss with respect to C.
    """
    d_log_alpha, d_stored = [], [type(number)(0) for number in stored]
    for pixel, (alpha, composited) in enumerate(alphas):
        T, behind = pixels[2 * pixel], pixels[2 * pixel + 1]
        value = dr.select(composited, alpha.value, 0)
        T = T / (1 - value)
        weight = value * T
        g_pixel = [plane[pixel] for plane in g]
        d_stored = features.add_derivatives(d_stored, stored, pixel, weight, g_pixel)
        gain = features.feature_gradient(stored, pixel, g_pixel) - behind
        pixels[2 * pixel] = T
        pixels[2 * pixel + 1] = dr.fma(value, gain, behind)
        # d loss / d ln(alpha) = a T (c.g - b), zero where alpha is clamped.
        d_log_alpha.append(dr.select(alpha.smooth, weight * gain, 0))
    return d_log_alpha, d_stored


def splat_gradients(
    bins: TileBins,
    totals: Callable[[UInt32, UInt32], list[Float]],
    num_samples: int,
    before: SplatGradients | None,
) -> SplatGradients:
    """Return the derivatives of each splat from its sums.

    totals: maps splats and a sample to moments and derivatives of the features; before: derivatives
    to which the samples' are added, in their order.
    """
    t, falloff = types_of(bins.rows.Float), bins.model.falloff
    size, count = bins.num_splats, falloff.num_geometry
    splat = dr.arange(t.UInt32, size)
    geometry = bins.rows.load(splat)[:count]

    def terms(sample: UInt32) -> list[Float]:
        sums = totals(splat, sample)
        columns = falloff.derivatives(geometry, sums[: falloff.num_moments])
        return columns + sums[falloff.num_moments :]

    def add(sample: UInt32, columns: list[Float]) -> tuple[UInt32, list[Float]]:
        return sample + 1, [total + x for total, x in zip(columns, terms(sample), strict=True)]

    if before is None:
        first, columns = 1, terms(t.UInt32(0))
    else:
        first, columns = 0, before.geometry + before.features
    if first + 1 == num_samples:  # inside of a loop, the sums would take longer
        _, columns = add(t.UInt32(first), columns)
    elif first < num_samples:
        _, columns = dr.while_loop(
            state=(dr.full(t.UInt32, first, size), [t.Float(column) for column in columns]),
            cond=lambda sample, columns: sample < dr.opaque(t.UInt32, num_samples),
            body=add,
        )
    rows = Rows.from_columns(columns)
    dr.eval(rows)
    numbers = rows.load(splat)
    return SplatGradients(geometry=numbers[:count], features=numbers[count:])


def composite_tangent(tiles: CompositedTiles, tangents: SplatGradients) -> list[Float]:
    """Return directional derivatives of the planes along ``tangents`` of the 2D splats.

    tangents: the direction, in the fields of the gradients. Not differentiated: the order, the
    decisions.
    """
    bins, count = tiles.bins, tiles.count
    t = types_of(bins.rows.Float)
    lanes = make_lanes(t.Float, bins.grid)
    entries = Entries(bins, lanes, dr.gather(t.UInt32, tiles.stop, lanes.micro_tile))
    model = bins.model.bind(lanes, bins.grid)
    stop = model.cutoffs.transmittance_stop
    d_records = pack_tangents(bins, tangents)

    def body(cursor: Cursor, T: list, dT: list, dC: list) -> tuple:
        entry, active = entries.current(cursor)
        geometry, features = tiles.records.load(entry, active)
        footprint = model.footprint(geometry, lanes, active)
        d_geometry, d_features = d_records.load(entry, active)
        d_log_alpha = model.falloff.tangent(geometry, footprint, d_geometry)
        T, dT, dC = list(T), list(dT), [list(c) for c in dC]
        for pixel, alpha in enumerate(model.alphas(geometry, footprint)):
            before, d_before = dr.abs(T[pixel]), dT[pixel]
            weight, T[pixel], goes_on = composite_step(T[pixel], alpha.value, stop)
            d_alpha = dr.select(alpha.smooth, alpha.value * d_log_alpha[pixel], 0)
            d_weight = dr.select(goes_on, dr.fma(before, d_alpha, alpha.value * d_before), 0)
            dT[pixel] = d_before - d_weight
            c = model.features.pixel_values(features, pixel)
            d_c = model.features.tangents(features, d_features, pixel)
            for k in range(count):
                change = dr.fma(d_weight, c[k], weight * d_c[k])
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
    return tiles.unpack(scatter_rows(columns, lanes.micro_tile, size))


def pack_tangents(bins: TileBins, tangents: SplatGradients) -> Records:
    """Return the tangents of the records: geometry, in the falloff's form, and features."""
    t = types_of(bins.rows.Float)
    splat = dr.arange(t.UInt32, bins.num_splats)
    geometry = bins.rows.load(splat)[: bins.model.falloff.num_geometry]
    numbers = bins.model.falloff.pack_tangents(geometry, tangents.geometry) + tangents.features
    numbers += [dr.zeros(t.Float, bins.num_splats)] * bins.num_keys  # not differentiated
    rows = Rows.from_columns(numbers)
    dr.eval(rows)
    return Records.from_splats(bins, rows.load)
