"""Depths of splats' peaks along the ray of each pixel, and lists that are sorted by them.

The sort keys of ``drgs.accuracy.pixel_order`` are :class:`RayDepths` if the falloff computes the
peak (``drgs.accuracy.exact``, which has the formulas), :class:`AffineDepths` otherwise, and
:class:`ParallelDepths` for parallel rays. :class:`PixelLists` has the entries of each micro-tile,
sorted by the depths of the peaks at its centre.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import cast

import drjit as dr
from typing_extensions import override

from drgs.accuracy.exact import RayFootprint, closest_on_film, ray_denominator
from drgs.cameras.camera import Camera
from drgs.core.arrays import reinterpret, types_of
from drgs.core.constants import WHITENING_SCALE
from drgs.core.types import Array3f, Float, UInt32
from drgs.splatting.footprint import GaussianFalloff, MicroTileFootprint
from drgs.splatting.grid import GRID, MICRO, MICROS, TILE, Lanes, TileGrid, load_pixels
from drgs.splatting.projection import (
    FilmProjection,
    FilmShape,
    GaussianRows,
    RayTerms,
    Splats2D,
    film_axes,
)
from drgs.splatting.rasterize import Records
from drgs.splatting.tiles import TileBins, lower_bounds, stable_order


@dataclass(frozen=True)
class AffineDepths:
    """Depths at a pixel from kappa and h, for falloffs that compute none; the base class."""

    bounds: tuple[Float, Float] | None = None  # nearest and farthest, (H * W,), scene units
    bound: list[tuple[Float, Float]] = field(default_factory=list)  # the same, at the 16 of a lane

    def for_camera(self, camera: Camera) -> AffineDepths:
        """Return the depths for one camera, which may have parallel rays."""
        return ParallelDepths(self.bounds) if camera.lens.parallel else self

    def keys(self, splats: Splats2D) -> list[Float]:
        """Return columns from which depths are computed: kappa, h (to base 2); last, their unit."""
        ray, scale = splats.ray, WHITENING_SCALE
        assert ray is not None, "as the projection makes them"
        return [ray.tilt_x / scale, ray.tilt_y / scale, ray.spread / scale**2, splats.depths]

    def depth_ratio(
        self, falloff: GaussianFalloff, geometry: list[Float], keys: list[Float], x: Float, y: Float
    ) -> tuple[Float, Float]:
        """Return a and D at a point of the film, px: the depth is a / D in the unit, if a > 0."""
        return self._depth_ratio(keys, *falloff.coordinates(geometry, x, y))

    def bind(self, lanes: Lanes, grid: TileGrid) -> AffineDepths:
        """Load the bounds, if there are any, for the lanes of one kernel."""
        if self.bounds is None:
            return self
        near, far = (load_pixels(bound, lanes, grid) for bound in self.bounds)
        return replace(self, bound=list(zip(near, far, strict=True)))

    def pixel_depths(self, footprint: MicroTileFootprint, keys: list[Float]) -> list[Float]:
        """Return depths in the unit at the 16 pixels; not positive where there is none."""
        found, unit = self._pixel_depths(footprint, keys), keys[-1]
        if not self.bound:
            return found
        return [
            dr.select((unit * along > near) & (unit * along < far), along, -1)
            for along, (near, far) in zip(found, self.bound, strict=True)
        ]

    def _pixel_depths(self, footprint: MicroTileFootprint, keys: list[Float]) -> list[Float]:
        coordinates = zip(footprint.u, footprint.v, strict=True)
        return [
            a / denominator for a, denominator in (self._depth_ratio(keys, *e) for e in coordinates)
        ]

    @staticmethod
    def _depth_ratio(keys: list[Float], u: Float, v: Float) -> tuple[Float, Float]:
        kx, ky, h = keys[:3]
        a = dr.fma(-kx, u, dr.fma(-ky, v, 1))
        return a, dr.fma(a, a, h * dr.fma(u, u, v * v))


@dataclass(frozen=True)
class WithAffineDepth:
    """A projection with the input of :class:`AffineDepths`: the affine covariance with depth."""

    shape: FilmProjection

    def __call__(
        self, rows: GaussianRows, camera: Camera, position: Array3f, low_pass: Float | float
    ) -> FilmShape:
        """Project; h is not negative. Where slopes are clamped, the splat is the affine one."""
        film = self.shape(rows, camera, position, low_pass)
        slopes = camera.lens.clamped_slopes(camera, position)
        m0, m1, n = film_axes(rows, camera, position, slopes)
        p, r, s = film.conic_factor
        kx, ky = dr.dot(m0, n), dr.dot(m1, n)
        kx, ky = dr.fma(p, kx, r * ky), s * ky
        h = dr.squared_norm(n) - dr.fma(kx, kx, ky * ky)
        return replace(film, ray=RayTerms(kx, ky, dr.select(h > 0, h, 0)))


@dataclass(frozen=True)
class ParallelDepths(AffineDepths):
    """Depths at a pixel for parallel rays."""

    @staticmethod
    @override
    def _depth_ratio(keys: list[Float], u: Float, v: Float) -> tuple[Float, Float]:
        kx, ky = keys[:2]
        return dr.fma(kx, u, dr.fma(ky, v, 1)), type(u)(1)


@dataclass(frozen=True)
class RayDepths(AffineDepths):
    """Depths at a pixel by ``RayFalloff``."""

    camera: Camera | None = None

    @override
    def for_camera(self, camera: Camera) -> RayDepths:
        return replace(self, camera=camera)

    @override
    def keys(self, splats: Splats2D) -> list[Float]:
        ray = splats.ray
        assert ray is not None and ray.scale is not None, "as exact_shape makes them"
        return [splats.depths * ray.scale]

    @override
    def depth_ratio(
        self, falloff: GaussianFalloff, geometry: list[Float], keys: list[Float], x: Float, y: Float
    ) -> tuple[Float, Float]:
        del keys
        u, v = falloff.coordinates(geometry, x, y)
        assert self.camera is not None, "bound by for_camera"
        anchor = closest_on_film(self.camera, *geometry[:2])
        _, a, denominator = ray_denominator(geometry, u, v, x - anchor.x, y - anchor.y)
        return a, denominator

    @override
    def _pixel_depths(self, footprint: MicroTileFootprint, keys: list[Float]) -> list[Float]:
        del keys
        assert isinstance(footprint, RayFootprint), "made by RayFalloff"
        return footprint.along


MAX_DEPTH_RATIO = 4.0
"""Sort keys of lists, relative to the mean's depth, are clamped to this and its inverse."""


@dataclass(frozen=True)
class PixelLists:
    """Sorted entries of each micro-tile, front to back. An *item* is a pair of the two."""

    entries: UInt32  # (items,): place in the lists -> sorted entry
    order: UInt32  # (items,): place in the lists -> item as made
    first_item: UInt32  # (N + 1,): rank -> first of its items as made
    start: UInt32  # (tiles * 16 + 1,): micro-tile -> first place
    count: int  # items

    def range(self, lanes: Lanes) -> tuple[UInt32, UInt32]:
        """Return the first place, and one behind the last, of each lane."""
        UInt32, number = type(self.start), lanes.tile * MICROS + lanes.micro
        first = dr.gather(UInt32, self.start, number)
        return first, dr.gather(UInt32, self.start, number + 1)

    def places(self) -> UInt32:
        """Return the map from an item as made to its place in the lists, (items,)."""
        UInt32, size = type(self.order), dr.width(self.order)
        places = dr.empty(UInt32, size)
        dr.scatter(places, dr.arange(UInt32, size), self.order)
        return places

    @staticmethod
    def build(bins: TileBins, records: Records, depths: AffineDepths) -> PixelLists:
        """Make the lists. The host reads one value, the number of items."""
        t = types_of(bins.rows.Float)
        # Unsorted entries, and one behind the last.
        position = dr.arange(t.UInt32, bins.num_entries)
        entry = dr.zeros(t.UInt32, bins.num_entries + 1)
        dr.scatter(entry, position, dr.gather(t.UInt32, bins.source, position))
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
        return PixelLists(
            entries=entries,
            order=order,
            first_item=dr.gather(t.UInt32, first, bins.first_entry),
            start=lower_bounds(lists, count, num_lists),
            count=count,
        )


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
