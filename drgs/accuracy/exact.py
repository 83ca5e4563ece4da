r"""Splats evaluated along each pixel's ray: the projection ``exact``, and depths at a pixel.

Imported when one is selected. The affine approximation (EWA) replaces a Gaussian by one in image
space. The exact maximum along a ray is the Gaussian's peak, at little more cost.

In camera axes let d be a pixel's offset from the mean on the film, in the coordinates e = U d in
which the affine approximation at the mean is the unit Gaussian. Write k for the covariance of the
position on the film with z / z_mean, w for the variance of z / z_mean, kappa = U k, and h = w -
|kappa|^2: the variance of z / z_mean given the position on the film. Along the ray through the
pixel, the smallest squared Mahalanobis distance from the mean, rho^2, and its depth z are

    rho^2 = |e|^2 / D,  z = z_mean a / D,  a = 1 - kappa . e,  D = a^2 + h |e|^2

*Proof.* A point's distance from a line is that of their projections along it. Projecting along the
pixel's ray instead of the mean's changes the 2x3 projection A to A - d e_z^T / z_mean, and so the
projected covariance from C to C - d k^T - k d^T + w d d^T, whose inverse (Sherman-Morrison, twice)
gives d^T (...)^-1 d = |e|^2 / D. (The affine approximation is the first order in the size of the
splat; D = 1 there.) The peak is behind the camera where a <= 0: no falloff.

The low-pass widens the Gaussian parallel to the film, which changes C and neither k nor w.

**Anchor.** Where a mean is far outside the film, but its splat reaches it, a is a small difference
of large numbers. It is linear in the pixel, so it follows from its value at the point c of the film
that is closest to the mean: a = a_c + g . (x - c). The same formulas for the ray through c, with
primes (m = U' (c - mean), a' = 1 + kappa' . m, D' = a'^2 + h' |m|^2), give sums of small terms:

    a_c = a' / D',  g = -U'^T (a' kappa' + h' m) / D',  h = h' / D'

*Proof.* By the same two inversions, from C' = C - d k^T - k d^T + w d d^T back to C. Where the mean
is on the film, c is the mean, a_c = 1, g = -U^T kappa.

As rho^2 is a ratio, U, g and z_mean are divided by |a_c| once: then a = +-1 + g . (x - c). The sign
of a_c is stored as the sign of U, which is arbitrary otherwise.

**Parallel rays** have no perspective. Given the position on the film, the expected depth, which is
the peak's, is z = z_mean (1 + kappa . e) (linear regression).

**Extent.** With t = |U d|^2 the largest visible exponent, |e|^2 <= t D is |e| <= sqrt(q) a with
q = t / (1 - t h): a conic section with a focus in the mean and the eccentricity sqrt(q) |kappa|. If
that is below 1 it is an ellipse, which :meth:`RayFalloff.outline` computes; otherwise the splat
extends around the camera, and its outline is unbounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
from typing_extensions import override

from drgs.accuracy.peaks import MAX_EXPONENT, OPEN_OUTLINE, AffineDepths, bounding_cone, seen_along
from drgs.cameras.camera import Camera
from drgs.cameras.lens import Pinhole
from drgs.config.approximations import PROJECTIONS
from drgs.core.arrays import types_of
from drgs.core.constants import WHITENING_SCALE
from drgs.core.types import Array2f, Array3f, Bool, Float
from drgs.splatting.footprint import GaussianFalloff, MicroTileFootprint, Offsets, SamplePositions
from drgs.splatting.projection import (
    FilmShape,
    GaussianRows,
    ProjectionModel,
    RayTerms,
    Splats2D,
    factor_conic,
    film_axes,
)


def is_still_pinhole(camera: Camera) -> bool:
    """Return whether the splats of this module are those of the camera, or of ``lens_rays``."""
    return camera.shutter is None and camera.reading is None and isinstance(camera.lens, Pinhole)


def exact_shape(
    rows: GaussianRows, camera: Camera, position: Array3f, low_pass: Float | float
) -> FilmShape:
    """Project to the shape that :class:`RayFalloff` evaluates; its slopes are not clamped.

    Its conic factor is U / a_c, and ``ray`` holds g / |a_c|, h, and 1 / |a_c|. Not differentiated:
    the position of the anchor, which does not change the result.
    """
    if not is_still_pinhole(camera):
        from drgs.accuracy.lens_rays import lens_shape

        return lens_shape(rows, camera, position, low_pass)
    m0, m1, _ = film_axes(rows, camera, position, camera.lens.true_slopes(camera, position))
    film = factor_conic(camera.lens.project_point(camera, position), [*m0], [*m1], low_pass)
    mean = dr.detach(film.means2d)
    anchor = closest_on_film(camera, *mean)
    slopes = list((anchor - camera.principal) / camera.focal)
    # Differentiated as the mean's distance from a point that stays.
    offset = (anchor - mean) - (film.means2d - mean)
    along, (kx, ky), h = seen_along(rows, camera, position, slopes, low_pass)
    p, r, s = along.conic_factor
    u, v = dr.fma(p, offset.x, r * offset.y), s * offset.y
    a = dr.fma(kx, u, dr.fma(ky, v, 1))
    denominator = dr.fma(a, a, h * dr.fma(u, u, v * v))
    size = dr.abs(a)
    gx, gy = dr.fma(kx, a, h * u) / size, dr.fma(ky, a, h * v) / size
    ray = RayTerms(-p * gx, -dr.fma(r, gx, s * gy), h / denominator, denominator / size)
    return replace(film, conic_factor=film.conic_factor * (denominator / a), ray=ray)


def closest_on_film(camera: Camera, x: Float, y: Float) -> Array2f:
    """Return the point of the film that is closest to a point of its plane, px."""
    return dr.clip(types_of(type(x)).Array2f(x, y), camera.film_start, camera.film_end)


@dataclass(frozen=True)
class RayFootprint(MicroTileFootprint):
    """The same, with the inputs of the derivatives of |e|^2 / D, at the 16 pixels."""

    along: list[Float]  # A = a / D: depth of the peak, divided by z_mean / |a_c|
    exponent: list[Float]  # B = |e|^2 / D, base 2
    from_anchor: tuple[list[Float], list[Float]]  # x - c, px


@dataclass(frozen=True)
class RayFalloff(GaussianFalloff):
    """alpha = o exp(-rho^2 / 2), with rho^2 the smallest along the pixel's ray.

    Geometry: that of :class:`GaussianFalloff`, then g (2), h; all as :func:`exact_shape` gives
    them, U and h scaled to base 2.
    """

    camera: Camera | None = None

    @property
    @override
    def num_geometry(self) -> int:
        return 9

    @override
    def for_camera(self, camera: Camera) -> GaussianFalloff:
        """Bind to a camera, whose film has the anchors, or whose lens has the rays."""
        if is_still_pinhole(camera):
            return RayFalloff(camera)
        from drgs.accuracy.lens_rays import LensRayFalloff

        return LensRayFalloff(camera)

    @override
    def geometry(self, splats: Splats2D) -> list[Float]:
        ray = splats.ray
        assert ray is not None, "as exact_shape makes them"
        own = [ray.tilt_x, ray.tilt_y, ray.spread / WHITENING_SCALE**2]
        return [*super().geometry(splats), *own]

    @override
    def differentiable(self, splats: Splats2D) -> list[Float]:
        ray = splats.ray
        assert ray is not None, "as exact_shape makes them"
        return [*super().differentiable(splats), ray.tilt_x, ray.tilt_y, ray.spread]

    @override
    def outline(self, geometry: list[Float], reach: Float) -> list[Float]:
        """Return centre x, y, p, r, s of an ellipse |U d|^2 <= ``reach`` that holds the splat.

        |e| <= sqrt(q) (1 - kappa . e) is (e - c)^T (I - q kappa kappa^T) (e - c) <= q / g^2 with
        g^2 = 1 - q |kappa|^2 and c = -q kappa / g^2. I - q kappa kappa^T = V^T V with V upper
        triangular turns it into |V U (d - U^-1 c)|^2 <= q / g^2.
        """
        x, y, p, r, s, _, gx, gy, h = geometry
        # At the mean a is 1, and g = -U^T kappa, before they are divided.
        assert self.camera is not None, "bound by for_camera"
        anchor, sign = closest_on_film(self.camera, x, y), _sign(p)
        at_mean = sign * dr.fma(gx, x - anchor.x, dr.fma(gy, y - anchor.y, sign))
        kx = -sign * gx / p
        ky = -dr.fma(r, kx, sign * gy) / s
        p, r, s = p / at_mean, r / at_mean, s / at_mean
        cone = bounding_cone(kx, ky, h, reach)
        scale = dr.sqrt(cone.depth * cone.squared)
        shift = -cone.q / cone.squared
        shift_y = ky / s
        shift_x = (kx - r * shift_y) / p
        everywhere = [x, y, OPEN_OUTLINE, 0, OPEN_OUTLINE]
        ellipse = [
            x + shift * shift_x,
            y + shift * shift_y,
            scale * cone.v00 * p,
            scale * dr.fma(cone.v00, r, cone.v01 * s),
            scale * cone.v11 * s,
        ]
        return [dr.select(cone.bounded, a, b) for a, b in zip(ellipse, everywhere, strict=True)]

    @override
    def footprint(
        self, geometry: list[Float], offsets_from: Offsets, active: Bool | bool
    ) -> RayFootprint:
        affine = super().footprint(geometry[: super().num_geometry], offsets_from, active)
        log2_opacity = dr.select(active, self.log2_opacity(geometry), -dr.inf)
        assert self.camera is not None, "bound by for_camera"
        from_anchor = offsets_from(*closest_on_film(self.camera, *geometry[:2]))
        along, exponent, log2_alpha = [], [], []
        for u, v, x, y in zip(affine.u, affine.v, *from_anchor, strict=True):
            squared, a, denominator = ray_denominator(geometry, u, v, x, y)
            # Elsewhere alpha is 0, and its derivatives' factors have to be finite.
            shows = (a > 0) & (squared < MAX_EXPONENT * denominator)
            inverse = dr.select(shows, 1 / denominator, 0)
            along.append(a * inverse)
            exponent.append(squared * inverse)
            log2_alpha.append(dr.select(shows, log2_opacity - exponent[-1], -dr.inf))
        grids = affine.dx, affine.dy, affine.u, affine.v
        return RayFootprint(*grids, log2_alpha, along, exponent, from_anchor)

    @override
    def moments(
        self, footprint: MicroTileFootprint, weights: list[Float], positions: SamplePositions
    ) -> list[Float]:
        """Sum over the 16 pixels w = d loss / d ln(alpha) times each of these.

        1; A^2 u, A^2 u dx, A^2 u dy; A^2 v, A^2 v dy; A B (x - c); B^2. With f = |e|^2 / D,

            df = 2 A^2 e . de - 2 A B da - B^2 dh
        """
        assert isinstance(footprint, RayFootprint), "made by self.footprint"
        dx, dy = footprint.dx, footprint.dy
        anchor_x, anchor_y = footprint.from_anchor
        x, y, z, bb = [], [], [], []
        pixels = weights, footprint.along, footprint.exponent, footprint.u, footprint.v
        for w, a, b, u, v in zip(*pixels, strict=True):
            w_a, w_b = w * a, w * b
            x.append(w_a * a * u)
            y.append(w_a * a * v)
            z.append(w_b * a)
            bb.append(w_b * b)
        return [
            positions.sum(weights),
            positions.sum(x),
            positions.sum_dx(x, dx),
            positions.sum_dy(x, dy),
            positions.sum(y),
            positions.sum_dy(y, dy),
            positions.sum_dx(z, anchor_x),
            positions.sum_dy(z, anchor_y),
            positions.sum(bb),
        ]

    @override
    def derivatives(self, geometry: list[Float], totals: list[Float]) -> list[Float]:
        """Turn moments into derivatives with respect to :meth:`differentiable`.

        log2_alpha = log2_opacity - f, e = (p dx + r dy, s dy), dx = x - mean, a = +-1 + g (x - c).
        """
        _, _, p, r, s, log2_opacity = geometry[:6]
        w, x, x_dx, x_dy, y, y_dy, z_x, z_y, bb = totals
        scale = 2 * math.log(2)
        return [
            scale * p * x,
            scale * dr.fma(r, x, s * y),
            -scale * WHITENING_SCALE * x_dx,
            -scale * WHITENING_SCALE * x_dy,
            -scale * WHITENING_SCALE * y_dy,
            dr.select(w == 0, 0, w * dr.exp2(-log2_opacity)),
            scale * z_x,
            scale * z_y,
            math.log(2) / WHITENING_SCALE**2 * bb,
        ]

    @override
    def bounds(
        self, splats: Splats2D, geometry: list[Float], reach: Float
    ) -> tuple[Array2f, Array2f]:
        x, y, p, r, s = self.outline(geometry, reach)
        Array2f = types_of(type(p)).Array2f
        half_sizes = Array2f(dr.sqrt(1 + dr.square(r / s)) / p, 1 / s)
        return Array2f(x, y), dr.sqrt(reach) * half_sizes

    @override
    def pack_tangents(self, geometry: list[Float], tangents: list[Float]) -> list[Float]:
        return super().pack_tangents(geometry, tangents[:6]) + list(tangents[6:])

    @override
    def tangent(
        self, geometry: list[Float], footprint: MicroTileFootprint, d_geometry: list[Float]
    ) -> list[Float]:
        assert isinstance(footprint, RayFootprint), "made by self.footprint"
        _, _, p, r, s = geometry[:5]
        d_x, d_y, d_p, d_r, d_s, d_log_opacity, d_gx, d_gy, d_h = d_geometry
        d_p, d_r, d_s = d_p * WHITENING_SCALE, d_r * WHITENING_SCALE, d_s * WHITENING_SCALE
        d_h = d_h / WHITENING_SCALE**2
        pixels = footprint.dx, footprint.dy, footprint.u, footprint.v, *footprint.from_anchor
        result = []
        for dx, dy, u, v, x, y, a, b in zip(
            *pixels, footprint.along, footprint.exponent, strict=True
        ):
            d_u = dr.fma(d_p, dx, dr.fma(d_r, dy, -dr.fma(p, d_x, r * d_y)))
            d_v = dr.fma(d_s, dy, -s * d_y)
            d_a = dr.fma(d_gx, x, d_gy * y)
            change = a * dr.fma(a, dr.fma(u, d_u, v * d_v), -b * d_a)
            d_f = dr.fma(-b * b, d_h, 2 * change)
            result.append(dr.fma(-math.log(2), d_f, d_log_opacity))
        return result


@PROJECTIONS.register("exact")
class Exact(ProjectionModel):
    """The peak along each pixel's ray."""

    falloff = RayFalloff
    shape = shape_with_depth = staticmethod(exact_shape)


def ray_denominator(
    geometry: list[Float], u: Float, v: Float, x: Float, y: Float
) -> tuple[Float, Float, Float]:
    """Return |e|^2, a and D at a pixel with e = (u, v), at (x, y) from the anchor."""
    _, _, p, _, _, _, gx, gy, h, *_ = geometry
    squared = dr.fma(u, u, v * v)
    a = dr.fma(gx, x, dr.fma(gy, y, _sign(p)))
    return squared, a, dr.fma(a, a, h * squared)


def _sign(p: Float) -> Float:
    """Return the sign of a_c, which is that of U."""
    return type(p)(dr.copysign(type(p)(1), p))


@dataclass(frozen=True)
class RayDepths(AffineDepths):
    """Depths at a pixel by ``RayFalloff``."""

    camera: Camera | None = None

    @override
    def for_camera(self, camera: Camera) -> AffineDepths:
        if is_still_pinhole(camera):
            return replace(self, camera=camera)
        from drgs.accuracy.lens_rays import LensRayDepths

        return LensRayDepths(self.bounds, camera=camera)

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
