"""The footprint of a splat at the 16 pixels of a micro-tile: the image model of the kernels.

A :class:`ImageModel` holds four choices that tiles and compositing share, each an object that
the kernels call while Dr.Jit traces them. The classes here are the base classes and the defaults of
the 3DGS paper; others are in separate modules, imported when they are chosen:

- *falloff*: alpha around a splat (:class:`GaussianFalloff`)
- *positions*: sample positions in a pixel (:class:`SamplePositions`: :class:`PixelCenters`)
- *features*: composited values of a splat (:class:`SplatFeatures`)
- *cutoffs*: extent of splats and end of pixels (:class:`Cutoffs`)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import drjit as dr
from typing_extensions import override

from drgs.cameras.camera import Camera
from drgs.cameras.lens import shortest
from drgs.config.approximations import FALLOFFS
from drgs.core.arrays import is_float64, reinterpret, types_of
from drgs.core.constants import (
    ALPHA_CUT,
    ALPHA_MAX,
    NEGLIGIBLE_ALPHA,
    TRANSMITTANCE_STOP,
    WHITENING_SCALE,
)
from drgs.core.types import Array2f, Bool, Float
from drgs.splatting.grid import MICRO, Lanes, TileGrid
from drgs.splatting.projection import Splats2D, dot


@dataclass(frozen=True)
class Cutoffs:
    """Limits at which splats and pixels end. Host numbers: each value compiles its own kernels.

    None of these decisions is differentiated; ``drgs.core.constants`` has the sources of defaults.
    """

    alpha_max: float = ALPHA_MAX  # largest alpha, below 1
    alpha_cut: float = ALPHA_CUT  # smallest alpha that is composited; 0: none
    transmittance_stop: float = TRANSMITTANCE_STOP  # a pixel's last transmittance; 0: none
    extent: float = math.inf  # standard deviations from the mean beyond which a splat ends

    @property
    def least_alpha(self) -> float:
        """``alpha_cut``; where that is 0, an alpha too small to change any sum."""
        return max(self.alpha_cut, NEGLIGIBLE_ALPHA)

    def log2_floor(self, log2_opacity: Float) -> Float | float:
        """The base-2 logarithm of the smallest alpha of a splat."""
        least = math.log2(self.least_alpha)
        if math.isinf(self.extent):
            return least
        at_extent = log2_opacity - 0.5 * math.log2(math.e) * self.extent**2
        return dr.select(at_extent > least, at_extent, least)


def exp2_short(x: Float) -> Float:
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
    exponent = reinterpret(t.Int32, shifted) << 23
    return reinterpret(t.Float, reinterpret(t.Int32, p) + exponent)


@dataclass(frozen=True)
class Alpha:
    """Alpha at one pixel, with the decisions taken on the way."""

    value: Float  # 0 where the splat is skipped
    smooth: Bool  # not clamped, so that the derivative flows

    @staticmethod
    def from_log2(log2_alpha: Float, floor: Float | float, alpha_max: float) -> Alpha:
        """alpha = min(alpha_max, 2^log2_alpha), or 0 where log2_alpha is below ``floor``."""
        # Far below the floor the short exp2 returns garbage; the selection discards it.
        exp2 = dr.exp2 if is_float64(type(log2_alpha)) else exp2_short
        unclamped = exp2(log2_alpha)
        smooth = unclamped < alpha_max
        value = dr.select(smooth, unclamped, alpha_max)
        return Alpha(value=dr.select(log2_alpha >= floor, value, 0), smooth=smooth)


class SamplePositions:
    """Points of the pixels at which splats are evaluated. Sums are of points anywhere in them."""

    margin: ClassVar[float] = 0.0  # px: distance from a pixel's centre to its point, at most
    samples: int = 1  # times that each pixel is evaluated

    def bind(self, lanes: Lanes, grid: TileGrid) -> SamplePositions:
        """Load the inputs of one kernel's lanes; the other methods are called on the result."""
        del lanes, grid
        return self

    def points(self, lanes: Lanes, Float: type) -> list[tuple[Float, Float]]:
        """Return x and y (px) of the 16 pixels."""
        raise NotImplementedError

    def offsets(self, lanes: Lanes, x: Float, y: Float) -> tuple[list[Float], list[Float]]:
        """Return x and y from a point of the film to the 16 pixels, px."""
        raise NotImplementedError

    def sum(self, values: list[Float]) -> Float:
        """Sum 16 values."""
        return total(values)

    def sum_dx(self, values: list[Float], dx: list[Float]) -> Float:
        """Sum values times dx of :meth:`offsets`."""
        return total(products(values, dx))

    def sum_dy(self, values: list[Float], dy: list[Float]) -> Float:
        """Sum values times dy."""
        return total(products(values, dy))

    def sum_dy_dy(self, values: list[Float], dy: list[Float]) -> Float:
        """Sum values times dy^2."""
        return total(products(products(values, dy), dy))


@dataclass(frozen=True)
class PixelCenters(SamplePositions):
    """The pixels' centres: rows and columns share their offsets."""

    @override
    def points(self, lanes: Lanes, Float: type) -> list[tuple[Float, Float]]:
        x, y = Float(lanes.x) + 0.5, Float(lanes.y) + 0.5
        return [(x + i, y + j) for j in range(MICRO) for i in range(MICRO)]

    @override
    def offsets(self, lanes: Lanes, x: Float, y: Float) -> tuple[list[Float], list[Float]]:
        t = types_of(type(x))
        first_x, first_y = t.Float(lanes.x) + 0.5 - x, t.Float(lanes.y) + 0.5 - y
        columns, rows = ([first + k for k in range(MICRO)] for first in (first_x, first_y))
        return columns * MICRO, [dy for dy in rows for _ in range(MICRO)]

    @override
    def sum(self, values: list[Float]) -> Float:
        return total(self._rows(values))

    @override
    def sum_dx(self, values: list[Float], dx: list[Float]) -> Float:
        """Sum values times dx: a column shares dx, so columns are summed first."""
        columns = [total(values[i::MICRO]) for i in range(MICRO)]
        return dot(columns, dx[:MICRO])

    @override
    def sum_dy(self, values: list[Float], dy: list[Float]) -> Float:
        return dot(self._rows(values), dy[::MICRO])

    @override
    def sum_dy_dy(self, values: list[Float], dy: list[Float]) -> Float:
        return dot(products(self._rows(values), dy[::MICRO]), dy[::MICRO])

    @staticmethod
    def _rows(values: list[Float]) -> list[Float]:
        return [total(values[MICRO * j : MICRO * j + MICRO]) for j in range(MICRO)]


def total(values: list[Float]) -> Float:
    """Sum pairwise: the shortest chain of dependent additions."""
    while len(values) > 1:
        values = [a + b for a, b in zip(values[::2], values[1::2], strict=True)]
    return values[0]


def products(values: list[Float], others: list[Float]) -> list[Float]:
    """Multiply two lists number by number."""
    return [a * b for a, b in zip(values, others, strict=True)]


@dataclass(frozen=True)
class MicroTileFootprint:
    """A splat at the 16 pixels of a micro-tile, row by row."""

    dx: list[Float]  # pixel - mean, px
    dy: list[Float]
    u: list[Float]  # first component of U d, scaled to base 2
    v: list[Float]  # second component
    log2_alpha: list[Float]  # unclamped


Offsets = Callable[[Float, Float], tuple[list[Float], list[Float]]]
"""From a point of the film, x and y (px), to the offsets from it to the 16 pixels."""


@FALLOFFS.register("gaussian")
@dataclass(frozen=True)
class GaussianFalloff:
    """The projected Gaussian is a Gaussian in the image: ``alpha = o exp(-|U d|^2 / 2)``.

    The base of all falloffs. The *geometry* of a splat are the numbers that alpha depends on: mean
    x, y (px); then p, r, s of U and log2_opacity, scaled such that
    ``log2_alpha = log2_opacity - |U d|^2``; subclasses may add more. *Moments* are sums over
    pixels, weighted by d loss / d ln(alpha), from which :meth:`derivatives` follow.
    """

    @property
    def follows_rays(self) -> bool:
        """Whether alpha is that of each pixel's ray, also while the camera moves."""
        return False

    @property
    def num_geometry(self) -> int:
        """Numbers of a splat."""
        return 6

    @property
    def num_moments(self) -> int:
        """Sums over pixels, by splat."""
        return self.num_geometry

    def for_camera(self, camera: Camera) -> GaussianFalloff:
        """Return this falloff for one camera; here, it is independent of the camera."""
        del camera
        return self

    def bind(self, lanes: Lanes, positions: SamplePositions) -> GaussianFalloff:
        """Return the falloff for one kernel's lanes; here, it does not depend on the pixel."""
        del lanes, positions
        return self

    def with_camera_tangents(self, camera_tangents: Sequence[Float]) -> GaussianFalloff:
        """Return the falloff whose :meth:`tangent` includes that of the camera's rays.

        camera_tangents: of ``camera.numbers()``. Here, alpha depends on splats alone.
        """
        del camera_tangents
        return self

    def geometry(self, splats: Splats2D) -> list[Float]:
        """Return the geometry, Float (N,) each."""
        p, r, s = splats.conic_factor * WHITENING_SCALE
        return [*splats.means2d, p, r, s, dr.log2(splats.opacities)]

    def differentiable(self, splats: Splats2D) -> list[Float]:
        """Return the variables of :meth:`derivatives`, as many as the geometry has."""
        return [*splats.means2d, *splats.conic_factor, splats.opacities]

    def bounds(
        self, splats: Splats2D, geometry: list[Float], reach: Float
    ) -> tuple[Array2f, Array2f]:
        """Return centre and half sizes (Array2f, px) of the visible part's bounding box.

        reach: the largest log2_opacity - log2_alpha; here, the largest ``|U d|^2``.
        """
        del geometry
        return splats.means2d, dr.sqrt(2 * math.log(2) * reach * splats.variances)

    def outline(self, geometry: list[Float], reach: Float) -> list[Float]:
        """Return mean x, y, p, r, s of an ellipse ``|U d|^2 <= reach`` that contains the splat."""
        del reach
        return geometry[:5]

    def log2_opacity(self, geometry: list[Float]) -> Float:
        """Return the base-2 logarithm of the opacity."""
        return geometry[5]

    def log2_floor(self, geometry: list[Float], cutoffs: Cutoffs) -> Float | float:
        """Return the base-2 logarithm of the smallest alpha of a splat."""
        return cutoffs.log2_floor(self.log2_opacity(geometry))

    def coordinates(self, geometry: list[Float], x: Float, y: Float) -> tuple[Float, Float]:
        """Return U d at a point of the film, px."""
        mean_x, mean_y, p, r, s = geometry[:5]
        dx, dy = x - mean_x, y - mean_y
        return dr.fma(p, dx, r * dy), s * dy

    def footprint(
        self, geometry: list[Float], offsets_from: Offsets, active: Bool | bool
    ) -> MicroTileFootprint:
        """Evaluate the exponent; on a lane that is not active every alpha is below any floor."""
        x, y, p, r, s, log2_opacity = geometry
        log2_opacity = dr.select(active, log2_opacity, -dr.inf)
        dx, dy = offsets_from(x, y)
        u = [p * x + r * y for x, y in zip(dx, dy, strict=True)]
        v = [s * y for y in dy]
        log2_alpha = [dr.fma(-a, a, dr.fma(-b, b, log2_opacity)) for a, b in zip(u, v, strict=True)]
        return MicroTileFootprint(dx, dy, u, v, log2_alpha)

    def moments(
        self, footprint: MicroTileFootprint, weights: list[Float], positions: SamplePositions
    ) -> list[Float]:
        """Sums over the 16 pixels of w = d loss / d ln(alpha) times 1, u, u dx, u dy, dy, dy^2."""
        dx, dy = footprint.dx, footprint.dy
        z = products(weights, footprint.u)
        return [
            positions.sum(weights),
            positions.sum(z),
            positions.sum_dx(z, dx),
            positions.sum_dy(z, dy),
            positions.sum_dy(weights, dy),
            positions.sum_dy_dy(weights, dy),
        ]

    def derivatives(self, geometry: list[Float], totals: list[Float]) -> list[Float]:
        """Return the derivatives of mean x, y, p, r, s (unscaled), and opacity, from moments.

        log2_alpha = log2_opacity - u^2 - (s dy)^2, u = p dx + r dy, dx = x - mean: hence
        d ln(alpha) / d(anything) = ln(2) * d log2_alpha / d(anything).
        """
        _, _, p, r, s, log2_opacity = geometry
        w, w_u, w_u_dx, w_u_dy, w_dy, w_dy_dy = totals
        scale = 2 * math.log(2)
        return [
            scale * p * w_u,
            scale * dr.fma(r, w_u, s * s * w_dy),
            -scale * WHITENING_SCALE * w_u_dx,
            -scale * WHITENING_SCALE * w_u_dy,
            -scale * WHITENING_SCALE * s * w_dy_dy,
            # An opacity that underflows to 0 is invisible: 0 and not 0 * inf.
            dr.select(w == 0, 0, w * dr.exp2(-log2_opacity)),
        ]

    def pack_tangents(self, geometry: list[Float], tangents: list[Float]) -> list[Float]:
        """Return tangents of the geometry, with d ln(opacity) for the opacity."""
        *others, d_opacity = tangents
        return [*others, d_opacity * dr.exp2(-self.log2_opacity(geometry))]

    def tangent(
        self, geometry: list[Float], footprint: MicroTileFootprint, d_geometry: list[Float]
    ) -> list[Float]:
        """Return the tangent of ln(alpha) at the 16 pixels."""
        _, _, p, r, s, _ = geometry
        d_x, d_y, d_p, d_r, d_s, d_log_opacity = d_geometry
        d_p, d_r, d_s = d_p * WHITENING_SCALE, d_r * WHITENING_SCALE, d_s * WHITENING_SCALE
        scale = 2 * math.log(2)
        result = []
        pixels = zip(footprint.dx, footprint.dy, footprint.u, footprint.v, strict=True)
        for dx, dy, u, v in pixels:
            dv = dr.fma(d_s, dy, -s * d_y)
            d_row = dr.fma(-scale * v, dv, d_log_opacity)
            du_row = dr.fma(d_r, dy, -dr.fma(p, d_x, r * d_y))
            result.append(dr.fma(-scale * u, dr.fma(d_p, dx, du_row), d_row))
        return result


@dataclass(frozen=True)
class FeatureGroup:
    """A subset of the features, composited by one kernel."""

    stored: list[int]  # indices of the stored numbers that they need
    planes: list[int]  # indices of their planes; a plane may belong to several groups
    features: SplatFeatures

    @property
    def places(self) -> list[int]:
        """Indices of all planes of the group, among those of the image: transmittance first."""
        return [0, *(1 + plane for plane in self.planes)]


@dataclass(frozen=True)
class SplatFeatures:
    """The composited features of a splat, computed from its stored numbers.

    Here they are the stored numbers, the same at every pixel.
    """

    def groups(self, num_stored: int, size: int) -> list[FeatureGroup]:
        """Divide the features into groups of at most ``size`` planes.

        Numbers that several planes need are in the first group, with these planes. All others are
        composited unchanged.
        """
        more, plain = num_stored - self.num_planes(num_stored), SplatFeatures()
        numbers, starts = range(num_stored - more), range(0, max(num_stored - more, 1), size)
        parts = [list(numbers[first : first + size]) for first in starts]
        groups = [FeatureGroup([more + plane for plane in part], part, plain) for part in parts]
        groups[0] = FeatureGroup([*range(more), *groups[0].stored], groups[0].planes, self)
        return groups

    def num_planes(self, num_stored: int) -> int:
        """Return the number of planes for ``num_stored`` numbers per splat."""
        return num_stored

    def for_camera(self, camera: Camera) -> SplatFeatures:
        """Return the features for one camera; here, they are independent of the camera."""
        del camera
        return self

    def check_differentiable_in_camera(self) -> None:
        """Raise UnsupportedError if they depend on the camera other than through stored numbers."""

    def with_weight_derivatives(self) -> SplatFeatures:
        """Return features whose derivative with respect to the first number is the weight."""
        return self

    def bind(self, lanes: Lanes, positions: SamplePositions) -> SplatFeatures:
        """Return the features for one kernel's lanes; here, they do not depend on the pixel."""
        del lanes, positions
        return self

    def at_depth(self, stored: list[Float], depth: Float) -> list[Float]:
        """Return the stored numbers of a splat that a pixel sees at a depth of its own."""
        del depth
        return stored

    def pixel_values(self, stored: list[Float], pixel: int) -> list[Float]:
        """Return the splat's features at a pixel."""
        del pixel
        return stored

    def add(
        self, planes: list[Float], stored: list[Float], pixel: int, weight: Float
    ) -> list[Float]:
        """Return a pixel's ``planes`` plus this splat's contribution; weight: T alpha."""
        features = self.pixel_values(stored, pixel)
        return [dr.fma(weight, c, plane) for c, plane in zip(features, planes, strict=True)]

    def feature_gradient(self, stored: list[Float], pixel: int, g: list[Float]) -> Float | int:
        """Return c . g, with the features c and the derivatives g of the loss at a pixel."""
        result: Float | int = 0  # there may be no features, but alpha alone
        for c, derivative in zip(self.pixel_values(stored, pixel), g, strict=True):
            result = dr.fma(c, derivative, result)
        return result

    def add_derivatives(
        self, totals: list[Float], stored: list[Float], pixel: int, weight: Float, g: list[Float]
    ) -> list[Float]:
        """Return ``totals`` plus one pixel's derivatives with respect to ``stored``.

        weight: T alpha; g: derivatives of the loss with respect to the pixel's planes.
        """
        del stored, pixel
        return [dr.fma(weight, d, total) for d, total in zip(g, totals, strict=True)]

    def tangents(self, stored: list[Float], d_stored: list[Float], pixel: int) -> list[Float]:
        """Return tangents of the features at a pixel."""
        del stored, pixel
        return d_stored


@dataclass(frozen=True)
class ImageModel:
    """The image model of splats; see the module's description."""

    falloff: GaussianFalloff = field(default_factory=GaussianFalloff)
    positions: SamplePositions = field(default_factory=PixelCenters)
    features: SplatFeatures = field(default_factory=SplatFeatures)
    cutoffs: Cutoffs = field(default_factory=Cutoffs)
    period: Float | None = None  # px: after it, along x, a splat is seen again; None: never

    def for_camera(self, camera: Camera) -> ImageModel:
        """Return this model for one camera."""
        falloff, features = self.falloff.for_camera(camera), self.features.for_camera(camera)
        return replace(self, falloff=falloff, features=features, period=camera.lens.period(camera))

    def bind(self, lanes: Lanes, grid: TileGrid) -> ImageModel:
        """Return this model for the lanes of one kernel, with inputs loaded before the loop."""
        positions = self.positions.bind(lanes, grid)
        falloff = self.falloff.bind(lanes, positions)
        features = self.features.bind(lanes, positions)
        return replace(self, falloff=falloff, positions=positions, features=features)

    def footprint(
        self, geometry: list[Float], lanes: Lanes, active: Bool | bool
    ) -> MicroTileFootprint:
        """Evaluate a splat at the pixels of each lane; with a period, where it is nearest."""

        def offsets_from(x: Float, y: Float) -> tuple[list[Float], list[Float]]:
            dx, dy = self.positions.offsets(lanes, x, y)
            return [shortest(each, self.period) for each in dx], dy

        return self.falloff.footprint(geometry, offsets_from, active)

    def nearest(self, x: Float, mean_x: Float) -> Float:
        """Return where a point at x, px, is seen next to a mean at ``mean_x``."""
        return x if self.period is None else mean_x + shortest(x - mean_x, self.period)

    def alphas(self, geometry: list[Float], footprint: MicroTileFootprint) -> Iterator[Alpha]:
        """Yield alpha at the 16 pixels.

        One by one, because Dr.Jit computes in the order of tracing: the values of a pixel that is
        composited at once stay in registers.
        """
        floor = self.falloff.log2_floor(geometry, self.cutoffs)
        for log2_alpha in footprint.log2_alpha:
            yield Alpha.from_log2(log2_alpha, floor, self.cutoffs.alpha_max)


DEFAULT = ImageModel()
