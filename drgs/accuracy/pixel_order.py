"""An order of compositing for each pixel: ``order: pixel``, imported when it is selected.

By default, all pixels composite in the order of the depths of the means; interpenetrating splats
then swap as a whole when the camera moves (*popping*). Here each pixel sorts splats by the depth of
their peak along its own ray.

A pixel keeps a *window* of the K nearest pending splats (Radl et al. 2024, "StopThePop", section 4,
with a window of one level). The next splat is inserted, and the nearest of the K + 1 is composited.
Each micro-tile has its own list, sorted by the depths of the peaks along the ray through its
centre. The order is exact where the rank of a splat at a pixel differs by at most K from its rank
in the list; the error vanishes as K grows, except for alphas below :data:`UNORDERED_ALPHA`.

Insertion into a sorted window takes K comparisons with selections at every pixel, without branches.

**Adjoint.** The pixels of a micro-tile composite different splats at the same time, while a splat's
partial derivatives are sums over pixels. Two passes therefore store w = T alpha and d loss / d
ln(alpha) by splat and pixel; a third pass sums over the pixels. b, the derivative behind a splat
(see ``drgs.splatting.rasterize``), is the sum over all splats minus that over the splats in front.
To avoid cancellation, each sum is stored as two numbers, which are exact to twice the precision.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import drjit as dr
from typing_extensions import override

from drgs.accuracy.exact import RayDepths, RayFalloff
from drgs.accuracy.peaks import AffineDepths, WithAffineDepth, ewa_with_depth
from drgs.cameras.camera import Camera
from drgs.config.approximations import ORDERS, Approximations
from drgs.core.arrays import Rows, reinterpret, scatter_rows, types_of
from drgs.core.types import Bool, Float, UInt32
from drgs.splatting.footprint import Alpha, ImageModel, MicroTileFootprint
from drgs.splatting.grid import (
    GRID,
    MICRO,
    MICROS,
    PIXELS,
    TILE,
    Lanes,
    group_by_work,
    load_lane_row,
    load_pixels,
    make_lanes,
    pixels_of,
)
from drgs.splatting.order import CenterOrder
from drgs.splatting.projection import FilmProjection, ProjectionModel, Splats2D, ewa
from drgs.splatting.rasterize import (
    ONE_SAMPLE,
    CompositedTiles,
    Records,
    SplatGradients,
    any_unfinished,
    composite_step,
    pack_tangents,
    splat_gradients,
)
from drgs.splatting.reduction import sum_runs
from drgs.splatting.tiles import TileBins, lower_bounds, stable_order

S = TypeVar("S")

UNORDERED_ALPHA = 1e-4
"""Smaller alphas, which occur with a smaller alpha cut, are composited at once, before the window.
Two splats in the wrong order change a pixel by the product of their alphas, so a splat loses at
most the sum of the faint alphas behind it. In order, the faint rims of large splats, whose peaks
are far away, would fill the windows: uncut, a fitted scene is 52.4 dB from the true order with 16
places, and 51.3 dB with 1e-6 here."""


@ORDERS.register("pixel")
@dataclass(frozen=True)
class PixelOrder(CenterOrder):
    """Compositing by the depth of the peak along each pixel's ray."""

    window: int
    depths: AffineDepths

    @classmethod
    @override
    def create(
        cls, projection: type[ProjectionModel], approximations: Approximations
    ) -> tuple[FilmProjection, PixelOrder]:
        shape, depths = projection.shape_with_depth, AffineDepths()
        if projection.falloff is RayFalloff:
            depths = RayDepths()
        elif projection.shape is ewa:
            shape = ewa_with_depth
        return shape or WithAffineDepth(projection.shape), cls(approximations.order_window, depths)

    @override
    def for_camera(self, camera: Camera) -> PixelOrder:
        return replace(self, depths=self.depths.for_camera(camera))

    @override
    def keys(self, splats: Splats2D) -> list[Float]:
        return self.depths.keys(splats)

    @override
    def composite(self, bins: TileBins, records: Records) -> _OrderedTiles:
        t = types_of(bins.rows.Float)
        lists = PixelLists.build(bins, records, self.depths)
        inputs = _WalkInputs.from_lists(bins, records, lists, self)
        lanes, model, size = inputs.lanes, inputs.model, inputs.size
        count = model.features.num_planes(bins.num_features)

        def visit(state: tuple, visited: list[list[Float]]) -> tuple:
            T, C = list(state[0]), [list(plane) for plane in state[1]]
            for pixel, (alpha, *features) in enumerate(visited):
                weight, T[pixel], _ = composite_step(T[pixel], alpha, inputs.stop)
                for k, c in enumerate(features):
                    C[k][pixel] = dr.fma(weight, c, C[k][pixel])
            return (T, C), any_unfinished(T)

        T, C = _walk(
            inputs,
            carry=lambda met, k: model.features.pixel_values(met.features_at(k, model), k),
            visit=visit,
            state=(inputs.transmittance(), inputs.zeros(count)),
            nothing=[dr.zeros(t.Float, size)] * count,
        )
        dr.eval(T, C)
        columns = [dr.abs(v) for v in T] + [v for plane in C for v in plane]
        last = dr.gather(t.UInt32, bins.tile_start, lanes.tile + 1)
        values = scatter_rows(columns, lanes.micro_tile, size)
        ends = scatter_rows([last] * PIXELS, lanes.micro_tile, size)
        stop = scatter_rows([last], lanes.micro_tile, size)
        return _OrderedTiles(bins, records, values, ends, stop, count, lists)

    @override
    def adjoint(
        self,
        tiles: CompositedTiles,
        d_planes: Sequence[Float],
        samples: range = ONE_SAMPLE,
        before: SplatGradients | None = None,
    ) -> SplatGradients:
        inputs = _WalkInputs.from_tiles(tiles, self, samples)
        d_transmittance, *d_features = d_planes
        g = [load_pixels(plane, inputs.lanes, inputs.bins.grid) for plane in d_features]
        pairs = _pairs(inputs, _totals(inputs, tiles, g, d_transmittance), g)
        return _sum_items(inputs, _sum_pixels(inputs, pairs, g), before)

    @override
    def tangent(self, tiles: CompositedTiles, tangents: SplatGradients) -> list[Float]:
        inputs = _WalkInputs.from_tiles(tiles, self)
        bins, model, size = inputs.bins, inputs.model, inputs.size
        d_records, count = pack_tangents(bins, tangents), tiles.count

        def carry(met: _Crossing, pixel: int) -> list[Float]:
            d_geometry, d_features = d_records.load(met.entry, met.active)
            d_log_alpha = model.falloff.tangent(met.geometry, met.footprint, d_geometry)[pixel]
            alpha = met.alphas[pixel]
            return [
                dr.select(alpha.smooth, alpha.value * d_log_alpha, 0),
                *model.features.pixel_values(met.features_at(pixel, model), pixel),
                *model.features.tangents(met.features_at(pixel, model), d_features, pixel),
            ]

        def visit(state: tuple, visited: list[list[Float]]) -> tuple:
            T, dT = list(state[0]), list(state[1])
            dC = [list(plane) for plane in state[2]]
            for pixel, (alpha, d_alpha, *features) in enumerate(visited):
                # Behind the camera, there is a footprint.
                d_alpha = dr.select(alpha > 0, d_alpha, 0)
                before, d_before = dr.abs(T[pixel]), dT[pixel]
                weight, T[pixel], goes_on = composite_step(T[pixel], alpha, inputs.stop)
                d_weight = dr.select(goes_on, dr.fma(before, d_alpha, alpha * d_before), 0)
                dT[pixel] = d_before - d_weight
                for k in range(count):
                    change = dr.fma(d_weight, features[k], weight * features[count + k])
                    dC[k][pixel] = dC[k][pixel] + change
            return (T, dT, dC), any_unfinished(T)

        _, dT, dC = _walk(
            inputs,
            carry=carry,
            visit=visit,
            state=(inputs.transmittance(), inputs.zeros(1)[0], inputs.zeros(count)),
            nothing=[dr.zeros(bins.rows.Float, size)] * (1 + 2 * count),
        )
        columns = dT + [v for plane in dC for v in plane]
        dr.eval(columns)
        return tiles.unpack(scatter_rows(columns, inputs.lanes.micro_tile, size))


MAX_DEPTH_RATIO = 4.0
"""Sort keys of lists, relative to the mean's depth, are clamped to this and its inverse."""


@dataclass(frozen=True)
class PixelLists:
    """Sorted entries of each micro-tile, front to back. An *item* is a pair of the two."""

    entries: UInt32  # (items,): place in the lists -> sorted entry
    order: UInt32  # (items,): place in the lists -> item as made
    items: tuple[UInt32, UInt32]  # (N,): splat -> first of its items as made, and their end
    start: UInt32  # (tiles * 16 + 1,): micro-tile -> first place
    count: int  # items

    def range(self, lanes: Lanes) -> tuple[UInt32, UInt32]:
        """Return the first place, and one behind the last, of each lane."""
        UInt32, number = type(self.start), lanes.tile * MICROS + lanes.micro
        first = dr.gather(UInt32, self.start, number)
        return first, dr.gather(UInt32, self.start, number + 1)

    @staticmethod
    def build(bins: TileBins, records: Records, depths: AffineDepths) -> PixelLists:
        """Make the lists. The host reads one value, the number of items."""
        t = types_of(bins.rows.Float)
        # Entries sorted by depth, and one behind the last.
        splat = dr.arange(t.UInt32, bins.num_splats)
        counts = dr.gather(t.UInt32, bins.first_entry, splat + 1)
        counts -= dr.gather(t.UInt32, bins.first_entry, splat)
        begin = dr.empty(t.UInt32, bins.num_splats)  # of each splat
        dr.scatter(begin, dr.prefix_sum(dr.gather(t.UInt32, counts, bins.order)), bins.order)
        dr.eval(begin)
        position = dr.arange(t.UInt32, bins.num_entries)
        of_entry = dr.gather(t.UInt32, bins.splats, position)
        place = dr.gather(t.UInt32, begin, of_entry) + dr.gather(t.UInt32, bins.source, position)
        place -= dr.gather(t.UInt32, bins.first_entry, of_entry)
        entry = dr.zeros(t.UInt32, bins.num_entries + 1)
        dr.scatter(entry, position, place)
        dr.eval(entry)
        exists = dr.arange(t.UInt32, bins.num_entries + 1) < dr.opaque(t.UInt32, bins.num_entries)
        masks = dr.gather(t.UInt32, bins.masks, entry, exists)
        first = dr.prefix_sum(dr.popcnt(masks))
        count = int(first[bins.num_entries])

        at, micro_tiles, entries = _items(bins, records, depths, entry, masks, first, max(count, 1))
        by_depth = stable_order(_levels(at), _LEVELS)
        lists = dr.gather(t.UInt32, micro_tiles, by_depth)
        num_lists = bins.grid.num_tiles * MICROS
        order = dr.gather(t.UInt32, by_depth, stable_order(lists, num_lists))
        entries, lists = (dr.gather(t.UInt32, c, order) for c in (entries, micro_tiles))
        dr.eval(entries, lists, order)
        items = dr.gather(t.UInt32, first, begin), dr.gather(t.UInt32, first, begin + counts)
        starts = lower_bounds(lists, count, num_lists)
        return PixelLists(entries, order, items, starts, count)


_LEVELS = 1 << 14
"""Number of distinct depths in lists, limited by one pass of a sort. Splats of equal level are in
the order of their means, and the window sorts them."""


def _levels(depths: Float) -> UInt32:
    """Quantize positive depths to ``_LEVELS`` parts of their range; nearly logarithmic."""
    # Bits of positive single-precision numbers have the order of the numbers.
    Single = cast(type[Float], dr.float32_array_t(type(depths)))
    bits = reinterpret(types_of(Single).UInt32, Single(depths))
    first = dr.min(bits)
    scale = (_LEVELS - 1) / Single(dr.max(bits) - first + 1)
    level = type(bits)(Single(bits - first) * scale)
    return dr.select(level < _LEVELS, level, _LEVELS - 1)


def _items(
    bins: TileBins,
    records: Records,
    depths: AffineDepths,
    entry: UInt32,
    masks: UInt32,
    item: UInt32,
    count: int,
) -> tuple[Float, UInt32, UInt32]:
    """Return items: the depths of peaks at the centre of micro-tiles, micro-tiles, and entries.

    entry: sorted entries; masks: their micro-tiles; item: the first of each one's items.
    """
    t = types_of(bins.rows.Float)
    # A single item that is not made, if there are none.
    items = dr.ones(t.Float, count), dr.zeros(t.UInt32, count), dr.zeros(t.UInt32, count)
    dr.eval(items)
    exists = masks != 0
    geometry, _ = records.load(entry, exists)
    keys = records.load_keys(entry, exists)
    tile = dr.gather(t.UInt32, bins.tiles, entry, exists)
    columns = dr.opaque(t.UInt32, bins.grid.columns)
    row = tile // columns
    # Middle of the first micro-tile.
    x = t.Float((tile - row * columns) * TILE) + MICRO / 2
    y = t.Float(row * TILE) + MICRO / 2

    def body(masks: UInt32, item: UInt32) -> tuple:
        micro = dr.tzcnt(masks)
        middle = x + t.Float(micro % GRID) * MICRO, y + t.Float(micro // GRID) * MICRO
        middle = bins.model.nearest(middle[0], geometry[0]), middle[1]
        a, denominator = depths.depth_ratio(bins.model.falloff, geometry, keys, *middle)
        # Without a peak here, a neighbouring pixel may have one.
        along = dr.select(a > 0, a / denominator, 1)
        along = dr.select(along < 1 / MAX_DEPTH_RATIO, 1 / MAX_DEPTH_RATIO, along)
        along = dr.select(along > MAX_DEPTH_RATIO, MAX_DEPTH_RATIO, along)
        values = keys[-1] * along, tile * MICROS + micro, entry
        for column, value in zip(items, values, strict=True):
            dr.scatter(column, value, item)
        return masks & (masks - 1), item + 1

    loop = dr.while_loop(
        state=(t.UInt32(masks), t.UInt32(item)), cond=lambda masks, item: masks != 0, body=body
    )
    dr.eval(loop, items)
    return items


@dataclass(frozen=True)
class _Crossing:
    place: UInt32  # in the lists
    entry: UInt32  # sorted
    active: Bool  # there is one
    geometry: list[Float]
    features: list[Float]
    footprint: MicroTileFootprint
    alphas: list[Alpha]
    depths: list[Float]  # of the peaks at the 16 pixels

    def features_at(self, pixel: int, model: ImageModel) -> list[Float]:
        """Return the stored features at a pixel."""
        return model.features.at_depth(self.features, self.depths[pixel])


@dataclass(frozen=True)
class _WalkInputs:
    """Inputs of a walk: the lanes, the list of each, and its splats."""

    bins: TileBins
    records: Records
    lists: PixelLists
    order: PixelOrder
    lanes: Lanes
    model: ImageModel  # bound to the lanes
    samples: range  # of the lanes

    @staticmethod
    def from_lists(
        bins: TileBins,
        records: Records,
        lists: PixelLists,
        order: PixelOrder,
        samples: range | None = None,
    ) -> _WalkInputs:
        """Group lanes with lists of similar length; samples: None for all."""
        samples = range(bins.grid.samples) if samples is None else samples
        tiles = bins.grid.tiles_of(samples)
        begin, end = lists.range(make_lanes(bins.rows.Float, bins.grid, tiles=tiles))
        lanes = group_by_work(bins.rows.Float, bins.grid, end - begin, tiles)
        order = replace(order, depths=order.depths.bind(lanes, bins.grid))
        model = bins.model.bind(lanes, bins.grid)
        return _WalkInputs(bins, records, lists, order, lanes, model, samples)

    @staticmethod
    def from_tiles(
        tiles: CompositedTiles, order: PixelOrder, samples: range | None = None
    ) -> _WalkInputs:
        """Return the inputs of another walk over composited tiles."""
        assert isinstance(tiles, _OrderedTiles), "made by PixelOrder.composite"
        return _WalkInputs.from_lists(tiles.bins, tiles.records, tiles.lists, order, samples)

    @property
    def num_places(self) -> int:
        """Places in the lists of all samples, one at least."""
        return max(len(self.samples) * self.lists.count, 1)

    def first_place(self) -> UInt32:
        """Return the first place of each lane's sample."""
        UInt32 = type(self.lanes.sample)
        start = dr.opaque(UInt32, self.samples.start)
        count = dr.opaque(UInt32, self.lists.count)
        return (self.lanes.sample - start) * count

    @property
    def size(self) -> int:
        """Number of lanes."""
        return dr.width(self.lanes.tile)

    @property
    def stop(self) -> float:
        """The last transmittance that a pixel may have."""
        return self.model.cutoffs.transmittance_stop

    def transmittance(self) -> list[Float]:
        """Return the initial transmittance of the 16 pixels; pixels off the film are finished."""
        Float = self.bins.rows.Float
        inside = [inside for _, inside in pixels_of(self.lanes, self.bins.grid)]
        return [dr.select(of_pixel, Float(1), -1) for of_pixel in inside]

    def zeros(self, planes: int) -> list[list[Float]]:
        """Return zeros by plane, for the 16 pixels."""
        Float = self.bins.rows.Float
        zero = dr.zeros(Float, self.size)
        return [[Float(zero) for _ in range(PIXELS)] for _ in range(planes)]


def _walk(
    inputs: _WalkInputs,
    carry: Callable[[_Crossing, int], list],
    visit: Callable[[S, list[list]], tuple[S, Bool]],
    state: S,
    nothing: list,
) -> S:
    """Visit each pixel's splats in their order; returns the last state.

    carry: returns the numbers of a splat at a pixel; visit: maps a state and, for each pixel, alpha
    and these numbers to the next state and whether any pixel is unfinished; nothing: the numbers
    where there is no splat, with an alpha of 0.
    """
    lists, records, lanes = inputs.lists, inputs.records, inputs.lanes
    model, order = inputs.model, inputs.order
    t = types_of(records.rows.Float)
    begin, end = lists.range(lanes)

    def body(place: UInt32, queue: list, state: S, go_on: Bool) -> tuple:
        active = place < end
        entry = dr.gather(t.UInt32, lists.entries, place, active)
        geometry, features = records.load(entry, active)
        keys = records.load_keys(entry, active)
        footprint = model.footprint(geometry, lanes, active)
        alphas = list(model.alphas(geometry, footprint))
        alongs = order.depths.pixel_depths(footprint, keys)
        depths = [keys[-1] * along for along in alongs]
        met = _Crossing(place, entry, active, geometry, features, footprint, alphas, depths)
        # Depth of a missing splat: before all others, so that it is visited at once and changes
        # nothing; after the last splat, behind them, so that it replaces them in the window.
        absent = dr.select(active, t.Float(-dr.inf), dr.inf)
        next_queue, visited = [], []
        for pixel, (along, depth) in enumerate(zip(alongs, depths, strict=True)):
            alpha = dr.select(along > 0, alphas[pixel].value, 0)
            depth = dr.select(alpha >= UNORDERED_ALPHA, depth, absent)
            places, nearest = _insert(queue[pixel], [depth, alpha, *carry(met, pixel)])
            next_queue.append(places)
            visited.append(nearest[1:])
        state, go_on = visit(state, visited)
        return place + 1, next_queue, state, go_on

    size = inputs.size
    empty = [dr.full(t.Float, -dr.inf, size), dr.zeros(t.Float, size), *nothing]
    queue = [[[type(x)(x) for x in empty] for _ in range(order.window)] for _ in range(PIXELS)]
    # After the last splat, the window still has to be emptied.
    return dr.while_loop(
        (begin, queue, state, dr.full(t.Bool, True, size)),
        lambda place, queue, state, go_on: (place < end + order.window) & go_on,
        body,
    )[2]


def _insert(places: list[list[Float]], item: list[Float]) -> tuple[list[list[Float]], list[Float]]:
    """Insert into places sorted by their first number, stably; also return the first of all."""
    places = list(places)
    for k in reversed(range(len(places))):
        before = item[0] < places[k][0]
        pairs = list(zip(places[k], item, strict=True))
        places[k] = [dr.select(before, old, new) for old, new in pairs]
        item = [dr.select(before, new, old) for old, new in pairs]
    return places, item


@dataclass(frozen=True)
class _OrderedTiles(CompositedTiles):
    """Composited tiles with the lists, which the adjoint and the tangent use again."""

    lists: PixelLists


def _feature_gradient(
    inputs: _WalkInputs, met: _Crossing, pixel: int, g: list[list[Float]]
) -> Float | int:
    """Return c . g of a splat at a pixel; g: [plane][pixel] derivative of the loss."""
    stored = met.features_at(pixel, inputs.model)
    return inputs.model.features.feature_gradient(stored, pixel, [plane[pixel] for plane in g])


def _totals(
    inputs: _WalkInputs, tiles: CompositedTiles, g: list[list[Float]], d_transmittance: Float
) -> list[tuple[Float, Float]]:
    """Walk first to find b in front of all splats of each pixel, in two numbers."""
    t = types_of(inputs.bins.rows.Float)

    def add_up(state: tuple, visited: list[list[Float]]) -> tuple:
        T, high, low = (list(column) for column in state)
        for pixel, (alpha, seen) in enumerate(visited):
            weight, T[pixel], _ = composite_step(T[pixel], alpha, inputs.stop)
            high[pixel], low[pixel] = _add_product(high[pixel], low[pixel], weight, seen)
        return (T, high, low), any_unfinished(T)

    _, *totals = _walk(
        inputs,
        carry=lambda met, pixel: [_feature_gradient(inputs, met, pixel, g)],
        visit=add_up,
        state=(inputs.transmittance(), *inputs.zeros(2)),
        nothing=[dr.zeros(t.Float, inputs.size)],
    )
    background = zip(
        *totals,
        load_lane_row(tiles.values, inputs.lanes.micro_tile, 1 + tiles.count),
        load_pixels(d_transmittance, inputs.lanes, inputs.bins.grid),
        strict=True,
    )
    totals = [_add_product(*numbers) for numbers in background]
    dr.eval(totals)
    return totals


def _pairs(
    inputs: _WalkInputs, totals: list[tuple[Float, Float]], g: list[list[Float]]
) -> list[Float]:
    """Walk again for each pair's weight and d loss / d ln(alpha), at the place of its splat."""
    t = types_of(inputs.bins.rows.Float)
    pairs = [dr.zeros(t.Float, inputs.num_places * PIXELS) for _ in range(2)]
    dr.eval(pairs)
    first_place = inputs.first_place()
    alpha_max = inputs.model.cutoffs.alpha_max

    def store(state: tuple, visited: list[list[Float]]) -> tuple:
        T, high, low = (list(column) for column in state)
        for pixel, (alpha, seen, place) in enumerate(visited):
            weight, T[pixel], goes_on = composite_step(T[pixel], alpha, inputs.stop)
            high[pixel], low[pixel] = _add_product(high[pixel], low[pixel], weight, seen)
            behind = (totals[pixel][0] - high[pixel]) + (totals[pixel][1] - low[pixel])
            # Of what is behind, alpha / (1 - alpha) is lost: no division by T, which may underflow.
            change = dr.fma(weight, seen, -behind * (alpha / (1 - alpha)))
            d_log_alpha = dr.select(alpha < alpha_max, change, 0)
            for plane, value in zip(pairs, (weight, d_log_alpha), strict=True):
                dr.scatter(plane, value, place * PIXELS + pixel, goes_on & (alpha > 0))
        return (T, high, low), any_unfinished(T)

    result = _walk(
        inputs,
        carry=lambda met, k: [_feature_gradient(inputs, met, k, g), first_place + met.place],
        visit=store,
        state=(inputs.transmittance(), *inputs.zeros(2)),
        nothing=[dr.zeros(t.Float, inputs.size), dr.zeros(t.UInt32, inputs.size)],
    )
    dr.eval(result, pairs)
    return pairs


def _sum_pixels(inputs: _WalkInputs, pairs: list[Float], g: list[list[Float]]) -> Rows:
    """Walk again for the sums of ``pairs`` over the 16 pixels of each item, rows by place."""
    bins, records, lists = inputs.bins, inputs.records, inputs.lists
    lanes, model = inputs.lanes, inputs.model
    t = types_of(bins.rows.Float)
    partials = Rows.empty(t.Float, bins.num_sums, inputs.num_places)
    begin, end = lists.range(lanes)
    first_place = inputs.first_place()

    def body(place: UInt32) -> tuple:
        entry = dr.gather(t.UInt32, lists.entries, place)
        geometry, features = records.load(entry, True)
        footprint = model.footprint(geometry, lanes, True)
        own = first_place + place
        weights, d_log_alpha = (Rows((plane,), PIXELS).load(own) for plane in pairs)
        keys = records.load_keys(entry, True)
        alongs = inputs.order.depths.pixel_depths(footprint, keys)
        d_stored = [t.Float(0) for _ in features]
        for pixel, (weight, along) in enumerate(zip(weights, alongs, strict=True)):
            g_pixel = [plane[pixel] for plane in g]
            stored = model.features.at_depth(features, keys[-1] * along)
            d_stored = model.features.add_derivatives(d_stored, stored, pixel, weight, g_pixel)
        moments = model.falloff.moments(footprint, d_log_alpha, model.positions)
        partials.store(moments + d_stored, own)
        return (place + 1,)

    loop = dr.while_loop(state=(begin,), cond=lambda place: place < end, body=body)
    dr.eval(loop, partials)
    return partials


def _sum_items(inputs: _WalkInputs, rows: Rows, before: SplatGradients | None) -> SplatGradients:
    lists = inputs.lists
    UInt32, size = type(lists.order), dr.width(lists.order)
    places = dr.empty(UInt32, size)  # (items,): item as made -> place in the lists
    dr.scatter(places, dr.arange(UInt32, size), lists.order)

    def totals(splat: UInt32, sample: UInt32) -> list[Float]:
        first_place = sample * dr.opaque(UInt32, lists.count)

        def load(item: UInt32) -> list[Float]:
            return rows.load(first_place + dr.gather(UInt32, places, item))

        return sum_runs(rows.Float, *lists.items, load)

    return splat_gradients(inputs.bins, totals, len(inputs.samples), before)


def _add_product(high: Float, low: Float, a: Float, b: Float) -> tuple[Float, Float]:
    """Return high + low + a b to twice the precision (Dekker 1971; Knuth, TAOCP 2, 4.2.2)."""
    product = a * b
    rest = dr.fma(a, b, -product)
    total = high + product
    part = total - high
    lost = (high - (total - part)) + (product - part)
    return total, low + (lost + rest)
