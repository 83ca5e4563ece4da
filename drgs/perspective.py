r"""Splats evaluated along each pixel's ray: the projection ``exact``, and depths at a pixel.

Layer 2, imported when it is chosen. The affine approximation (EWA) replaces a Gaussian by one on
the film. What a ray really meets is the Gaussian's peak along it, and that is hardly more work.

In camera axes let d be a pixel's offset from the mean on the film, in the coordinates e = U d in
which the affine approximation at the mean is the unit Gaussian. Write k for the covariance of the
position on the film with z / z_mean, w for the variance of z / z_mean, kappa = U k, and h = w -
|kappa|^2: the variance of z / z_mean where the position on the film is known. Along the ray through
the pixel, the smallest Mahalanobis distance from the mean, rho^2, and where it lies, z, are

    rho^2 = |e|^2 / D,  z = z_mean a / D,  a = 1 - kappa . e,  D = a^2 + h |e|^2

*Proof.* The distance of a point from a line is that of their projections along the line.
Projecting along the pixel's ray instead of the mean's changes the 2x3 projection A to
A - d e_z^T / z_mean, and so the projected covariance from C to C - d k^T - k d^T + w d d^T, whose
inverse (Sherman-Morrison, twice) gives d^T (...)^-1 d = |e|^2 / D. (The affine approximation is the
first order in the size of the splat; D = 1 there.) The peak is behind the camera where a <= 0: no
response.

The low-pass widens the Gaussian parallel to the film, which changes C and neither k nor w.

**Extent.** With t = |U d|^2 the smallest exponent that shows, |e|^2 <= t D is |e| <= sqrt(q) a with
q = t / (1 - t h): a conic section with a focus in the mean and the eccentricity sqrt(q) |kappa|. If
that is below 1 it is an ellipse, which :meth:`RayResponse.outline` finds; otherwise the splat
reaches around the camera and is taken to be everywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr

from drgs.arrays import types_of
from drgs.camera import Camera
from drgs.constants import WHITENING_SCALE
from drgs.image_model import AffineResponse, Footprint
from drgs.projection import (
    FilmShape,
    GaussianRows,
    clamped_slopes,
    film_axes,
    film_point,
    true_slopes,
    whiten,
)

MOST_ECCENTRIC = 0.99
"""Outlines whose squared eccentricity is larger are taken to be everywhere: an ellipse ten times as
long as wide, whose size is known to 1e-5 in single precision. The same for t h, the share of the
way to the camera."""

_EVERYWHERE = 1e-12
"""1 / px: U of an outline that holds every film."""

LARGEST_EXPONENT = 1e4
"""2^-1e4 is 0 in either precision."""


def exact(rows: GaussianRows, camera: Camera, position: Any, low_pass: float) -> FilmShape:
    """The shape that :class:`RayResponse` evaluates; the slopes of its Jacobian are not clamped."""
    return _with_perspective(rows, camera, position, true_slopes(position), low_pass)


def ewa_with_depth(rows: GaussianRows, camera: Camera, position: Any, low_pass: float) -> FilmShape:
    """As ``projection.ewa``, and what is needed for the depth at a pixel."""
    return _with_perspective(rows, camera, position, clamped_slopes(camera, position), low_pass)


def _with_perspective(
    rows: GaussianRows, camera: Camera, position: Any, slopes: list[Any], low_pass: float
) -> FilmShape:
    m0, m1, n = film_axes(rows, camera, position, slopes)
    film = whiten(film_point(camera, position), [*m0], [*m1], low_pass)
    p, r, s = film.whitening
    kx, ky = dr.dot(m0, n), dr.dot(m1, n)
    # h = det(cov of film and depth) / det(cov of film), a sum of squares (Cauchy-Binet): free of
    # the cancellation of w - |kappa|^2. The rows are scaled first, or giants overflow.
    m0, m1 = p * m0, s * m1
    h = dr.square(dr.dot(dr.cross(m0, m1), n)) + low_pass * (
        dr.square(s) * dr.squared_norm(dr.cross(m0, n))
        + dr.square(p) * dr.squared_norm(dr.cross(m1, n))
        + low_pass * dr.square(p * s) * dr.squared_norm(n)
    )
    perspective = type(m0)(dr.fma(p, kx, r * ky), s * ky, h)
    return replace(film, perspective=perspective)


def scaled_perspective(splats: Any) -> list[Any]:
    """kappa and h for coordinates e that are scaled to base 2."""
    kx, ky, h = splats.perspective
    return [kx / WHITENING_SCALE, ky / WHITENING_SCALE, h / WHITENING_SCALE**2]


def ray_denominator(perspective: list[Any], u: Any, v: Any) -> tuple[Any, Any, Any]:
    """|e|^2, a and D at a pixel with e = (u, v)."""
    kx, ky, h = perspective
    squared = dr.fma(u, u, v * v)
    a = dr.fma(-kx, u, dr.fma(-ky, v, 1))
    return squared, a, dr.fma(a, a, h * squared)


@dataclass(frozen=True)
class RayFootprint(Footprint):
    """The same, with what the derivatives of |e|^2 / D need; 16 values each, or a splat's."""

    along: list[Any]  # A = a / D: depth of the peak, divided by the mean's
    exponent: list[Any]  # B = |e|^2 / D, base 2
    kappa: tuple[Any, Any]  # of the splat

    @property
    def coordinates(self) -> list[tuple[Any, Any]]:
        """e = (u, v) at the 16 pixels."""
        return list(zip(_flat(self.u), _flat(self.v), strict=True))

    @property
    def slopes(self) -> list[tuple[Any, Any]]:
        """b = A (A e + B kappa), half the derivative of |e|^2 / D with respect to e."""
        kx, ky = self.kappa
        return [
            (a * dr.fma(a, u, b * kx), a * dr.fma(a, v, b * ky))
            for a, b, (u, v) in zip(self.along, self.exponent, self.coordinates, strict=True)
        ]


def _flat(rows: list) -> list[Any]:
    return [value for row in rows for value in row]


@dataclass(frozen=True)
class RayResponse(AffineResponse):
    """alpha = o exp(-rho^2 / 2), with rho^2 the smallest along the pixel's ray.

    Geometry: that of :class:`AffineResponse`, then kappa (2) and h, scaled to base 2.
    """

    num_geometry: ClassVar[int] = 9
    num_moments: ClassVar[int] = 9

    def geometry(self, splats: Any) -> list[Any]:
        """Columns, one value per Gaussian."""
        return super().geometry(splats) + scaled_perspective(splats)

    def differentiable(self, splats: Any) -> list[Any]:
        """What :meth:`derivatives` are with respect to."""
        return [*super().differentiable(splats), *splats.perspective]

    def bounds(self, splats: Any, geometry: list[Any], reach: Any) -> tuple[Any, Any]:
        """Centre and half sizes (Array2f, px) of the box around the outline."""
        x, y, p, r, s = self.outline(geometry, reach)
        Array2f = types_of(type(p)).Array2f
        half_sizes = Array2f(dr.sqrt(1 + dr.square(r / s)) / p, 1 / s)
        return Array2f(x, y), dr.sqrt(reach) * half_sizes

    def outline(self, geometry: list[Any], reach: Any) -> list[Any]:
        """Centre x, y, p, r, s of an ellipse |U d|^2 <= ``reach`` that holds the splat.

        |e| <= sqrt(q) (1 - kappa . e) is (e - c)^T (I - q kappa kappa^T) (e - c) <= q / g^2 with
        g^2 = 1 - q |kappa|^2 and c = -q kappa / g^2. I - q kappa kappa^T = V^T V with V upper
        triangular turns it into |V U (d - U^-1 c)|^2 <= q / g^2.
        """
        x, y, p, r, s, _, kx, ky, h = geometry
        depth = 1 - reach * h
        bounded = depth > 1 - MOST_ECCENTRIC
        q = reach / dr.select(bounded, depth, 1)
        squared = 1 - q * dr.fma(kx, kx, ky * ky)
        # Written such that NaN is unbounded.
        bounded = bounded & (squared > 1 - MOST_ECCENTRIC)
        squared = dr.select(bounded, squared, 1)
        v00 = dr.sqrt(dr.select(bounded, 1 - q * kx * kx, 1))
        v01, v11 = -q * kx * ky / v00, dr.sqrt(squared) / v00
        scale = dr.sqrt(depth * squared)
        shift = -q / squared
        shift_y = ky / s
        shift_x = (kx - r * shift_y) / p
        everywhere = [x, y, _EVERYWHERE, 0, _EVERYWHERE]
        ellipse = [
            x + shift * shift_x,
            y + shift * shift_y,
            scale * v00 * p,
            scale * dr.fma(v00, r, v01 * s),
            scale * v11 * s,
        ]
        return [dr.select(bounded, a, b) for a, b in zip(ellipse, everywhere, strict=True)]

    def footprint(self, geometry: list[Any], offsets: tuple, active: Any) -> RayFootprint:
        """Evaluate the exponent; on a lane that is not active every alpha is below any floor."""
        affine = super().footprint(geometry[:6], offsets, active)
        log2_opacity = dr.select(active, geometry[5], -dr.inf)
        along, exponent, log2_alpha = [], [], []
        for u, v in zip(_flat(affine.u), _flat(affine.v), strict=True):
            squared, a, denominator = ray_denominator(geometry[6:], u, v)
            # Elsewhere alpha is 0, and its derivatives' factors have to be finite.
            shows = (a > 0) & (squared < LARGEST_EXPONENT * denominator)
            inverse = dr.select(shows, 1 / denominator, 0)
            along.append(a * inverse)
            exponent.append(squared * inverse)
            log2_alpha.append(dr.select(shows, log2_opacity - exponent[-1], -dr.inf))
        return RayFootprint(
            dx=affine.dx,
            dy=affine.dy,
            u=affine.u,
            v=affine.v,
            log2_alpha=log2_alpha,
            along=along,
            exponent=exponent,
            kappa=(geometry[6], geometry[7]),
        )

    def moments(self, footprint: RayFootprint, weights: list[Any], positions: Any) -> list[Any]:
        """Sums over the 16 pixels of w = d loss / d ln(alpha) times each of these.

        1; b_x, b_x dx, b_x dy; b_y, b_y dy; A B u, A B v; B^2. With f = |e|^2 / D,

            df = 2 b . de + 2 A B e . dkappa - B^2 dh
        """
        dx, dy = footprint.dx, footprint.dy
        x, y, ku, kv, bb = [], [], [], [], []
        for w, (bx, by), a, b, (u, v) in zip(
            weights,
            footprint.slopes,
            footprint.along,
            footprint.exponent,
            footprint.coordinates,
            strict=True,
        ):
            x.append(w * bx)
            y.append(w * by)
            w_b = w * b
            ku.append(w_b * a * u)
            kv.append(w_b * a * v)
            bb.append(w_b * b)
        return [
            positions.sum(weights),
            positions.sum(x),
            positions.sum_dx(x, dx),
            positions.sum_dy(x, dy),
            positions.sum(y),
            positions.sum_dy(y, dy),
            positions.sum(ku),
            positions.sum(kv),
            positions.sum(bb),
        ]

    def derivatives(self, geometry: list[Any], totals: list[Any]) -> list[Any]:
        """From moments to the derivatives of what :meth:`differentiable` lists.

        log2_alpha = log2_opacity - f, e = (p dx + r dy, s dy), dx = x - mean.
        """
        _, _, p, r, s, log2_opacity = geometry[:6]
        w, x, x_dx, x_dy, y, y_dy, ku, kv, bb = totals
        scale = 2 * math.log(2)
        return [
            scale * p * x,
            scale * dr.fma(r, x, s * y),
            -scale * WHITENING_SCALE * x_dx,
            -scale * WHITENING_SCALE * x_dy,
            -scale * WHITENING_SCALE * y_dy,
            dr.select(w == 0, 0, w * dr.exp2(-log2_opacity)),
            -scale / WHITENING_SCALE * ku,
            -scale / WHITENING_SCALE * kv,
            math.log(2) / WHITENING_SCALE**2 * bb,
        ]

    def pack_tangents(self, geometry: list[Any], tangents: list[Any]) -> list[Any]:
        """Tangents of the geometry, that of the opacity as d ln(opacity)."""
        return super().pack_tangents(geometry, tangents[:6]) + list(tangents[6:])

    def tangent(
        self, geometry: list[Any], footprint: RayFootprint, d_geometry: list[Any]
    ) -> list[Any]:
        """Tangent of ln(alpha) at the 16 pixels; see :meth:`moments`."""
        _, _, p, r, s = geometry[:5]
        d_x, d_y, d_p, d_r, d_s, d_log_opacity, d_kx, d_ky, d_h = d_geometry
        d_p, d_r, d_s = d_p * WHITENING_SCALE, d_r * WHITENING_SCALE, d_s * WHITENING_SCALE
        d_kx, d_ky = d_kx / WHITENING_SCALE, d_ky / WHITENING_SCALE
        d_h = d_h / WHITENING_SCALE**2
        result = []
        for dx, dy, (bx, by), a, b, (u, v) in zip(
            _flat(footprint.dx),
            _flat(footprint.dy),
            footprint.slopes,
            footprint.along,
            footprint.exponent,
            footprint.coordinates,
            strict=True,
        ):
            d_u = dr.fma(d_p, dx, dr.fma(d_r, dy, -dr.fma(p, d_x, r * d_y)))
            d_v = dr.fma(d_s, dy, -s * d_y)
            along = dr.fma(bx, d_u, by * d_v) + a * b * dr.fma(u, d_kx, v * d_ky)
            d_f = dr.fma(-b * b, d_h, 2 * along)
            result.append(dr.fma(-math.log(2), d_f, d_log_opacity))
        return result
