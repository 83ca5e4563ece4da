"""Peaks of splats along rays: what projections and orders of several modules share.

``drgs.accuracy.exact`` derives the formulas and has the symbols.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
from typing_extensions import override

from drgs.cameras.camera import Camera
from drgs.core.constants import WHITENING_SCALE
from drgs.core.types import Array3f, Bool, Float
from drgs.splatting.footprint import GaussianFalloff, MicroTileFootprint
from drgs.splatting.grid import Lanes, TileGrid, load_pixels
from drgs.splatting.projection import (
    FilmProjection,
    FilmShape,
    GaussianRows,
    RayTerms,
    Splats2D,
    ewa,
    factor_conic,
    film_axes,
)

MAX_ECCENTRICITY = 0.99
"""Outlines of a larger squared eccentricity are treated as unbounded. At the limit, an ellipse is
ten times as long as wide, and its size accurate to 1e-5 in single precision. It also limits t h."""

OPEN_OUTLINE = 1e-12  # 1 / px: U of an outline that holds every film

MAX_EXPONENT = 1e4  # 2^-1e4 is 0 in either precision


def ewa_with_depth(
    rows: GaussianRows, camera: Camera, position: Array3f, low_pass: Float | float
) -> FilmShape:
    """Project as ``projection.ewa``, with the terms of the depth at a pixel: kappa (2) and h."""
    slopes = camera.lens.clamped_slopes(camera, position)
    film = ewa(rows, camera, position, low_pass)
    _, kappa, h = seen_along(rows, camera, position, slopes, low_pass)
    return replace(film, ray=RayTerms(*kappa, h))


def seen_along(
    rows: GaussianRows,
    camera: Camera,
    position: Array3f,
    slopes: list[Float] | None,
    low_pass: Float | float,
) -> tuple[FilmShape, tuple[Float, Float], Float]:
    """Return shape, kappa and h of a Gaussian that is projected along a ray; slopes: the ray's."""
    m0, m1, n = film_axes(rows, camera, position, slopes)
    film = factor_conic(camera.lens.project_point(camera, position), [*m0], [*m1], low_pass)
    p, _, s = film.conic_factor
    # kappa and h by minors (Binet-Cauchy), free of the cancellation in p k_x + r k_y and in
    # w - |kappa|^2. The rows are scaled first, or giants overflow.
    low_pass_s = low_pass * dr.square(s)
    m1 = s * m1
    minors, minors_n, ky = dr.cross(m0, m1), dr.cross(n, m1), dr.dot(m1, n)
    kx = p * dr.fma(low_pass_s, dr.dot(m0, n), dr.dot(minors, minors_n))
    m0 = p * m0
    h = dr.square(dr.dot(p * minors, n)) + low_pass_s * dr.squared_norm(dr.cross(m0, n))
    h += low_pass * dr.square(p) * (dr.squared_norm(minors_n) + low_pass_s * dr.squared_norm(n))
    return film, (kx, ky), h


@dataclass(frozen=True)
class BoundingCone:
    """The rays of a splat, as an ellipse of e: see the module's *Extent*."""

    bounded: Bool  # the other numbers are finite, but mean something only there
    depth: Float  # 1 - t h
    q: Float
    squared: Float  # g^2
    v00: Float
    v01: Float
    v11: Float
    center: tuple[Float, Float]

    def edge(self, x: float, y: float) -> tuple[Float, Float]:
        """Return e on the edge of the ellipse; x, y: a point of the unit circle."""
        size = dr.sqrt(self.q / self.squared)
        v = size * y / self.v11
        return self.center[0] + (size * x - self.v01 * v) / self.v00, self.center[1] + v


def bounding_cone(kx: Float, ky: Float, h: Float, reach: Float) -> BoundingCone:
    """Return the rays along which rho^2 is at most ``reach``; kx, ky: kappa."""
    depth = 1 - reach * h
    bounded = depth > 1 - MAX_ECCENTRICITY
    q = reach / dr.select(bounded, depth, 1)
    squared = 1 - q * dr.fma(kx, kx, ky * ky)
    # Written such that NaN is unbounded.
    bounded = bounded & (squared > 1 - MAX_ECCENTRICITY)
    squared = dr.select(bounded, squared, 1)
    v00 = dr.sqrt(dr.select(bounded, 1 - q * kx * kx, 1))
    v01, v11 = -q * kx * ky / v00, dr.sqrt(squared) / v00
    shift = -q / squared
    return BoundingCone(bounded, depth, q, squared, v00, v01, v11, (shift * kx, shift * ky))


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
        ratios = (self._depth_ratio(keys, *e) for e in coordinates)
        return [a / denominator for a, denominator in ratios]

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
        m0, m1, n = film_axes(rows, camera, position, camera.lens.clamped_slopes(camera, position))
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
