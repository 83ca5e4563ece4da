r"""Splats evaluated along each pixel's ray, behind any lens: ``exact`` where there is no pinhole.

Imported when ``drgs.accuracy.exact`` is used with another lens, or with a rolling shutter. It is to
be read after that module, whose symbols it uses.

Let p be the mean and S the covariance, in camera axes; J = (J_x, J_y) the derivatives of the place
on the film at the mean, and n those of the depth divided by the mean's depth. Rays meet in the
origin, so that J p = 0, and n . p = 1. A ray of direction r meets the plane n . x = 1, which holds
the mean, at r / (n . r), whose place on the film is, in the coordinates of ``exact``, e = U J r /
(n . r). Whether a ray is short or long does not matter to rho, and with

    e = E r,  E = U J,  a = A . r,  A = n - kappa_1 E_1 - kappa_2 E_2

its squared distance from the mean is rho^2 = |e|^2 / D, D = a^2 + h |e|^2, with its peak at
(a / D) r. These are the formulas of ``exact``, but linear in r and not in the pixel.

**Moving origins.** The rows E_1, E_2 and A / sqrt(h) whiten: E_i p = 0 and A . p = 1. With parallel
rays, or a camera that moves while its rows are read, a ray starts at o, and with o' = E o and
b = 1 - A . o the squared distance is that of the whitened mean from the whitened ray,

    rho^2 = (|b e + a o'|^2 + h (o' x e)^2) / D,  and the peak at t = (a b - h o' . e) / D

Everything is in the axes of the camera when it opens its shutter; a splat's own origin, for which
J p = 0, is that of the camera when its row is read, or the point of the film before the mean.

**Derivatives.** A shift of the splat by x px changes E by -U x n^T, and so does the derivative of
J: both are those of the mean. The mean's place is therefore taken as constant in J, and the sums of
the moments are also the derivatives with respect to the mean's place, which densification uses.
Rays depend on the lens, and on the motion: see :meth:`LensRayFalloff.along`.

**Extent.** The rays at which alpha is the smallest are an elliptic cone. Some are seen on the
film; an ellipse through these, enlarged by their deviations from it, is the outline.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import drjit as dr
from typing_extensions import override

from drgs.accuracy.peaks import MAX_EXPONENT, OPEN_OUTLINE, AffineDepths, bounding_cone, seen_along
from drgs.cameras.camera import Camera
from drgs.cameras.lens import Perspective
from drgs.core.arrays import types_of
from drgs.core.constants import WHITENING_SCALE
from drgs.core.types import Array2f, Array3f, Bool, Float
from drgs.splatting.footprint import (
    GaussianFalloff,
    MicroTileFootprint,
    Offsets,
    SamplePositions,
    products,
)
from drgs.splatting.grid import Lanes
from drgs.splatting.projection import FilmShape, GaussianRows, RayTerms, Splats2D, factor_conic

NUM_OUTLINE_POINTS, NUM_WIDE_POINTS = 8, 16  # the latter for lenses that show more than a half
MAX_OUTLINE_DEVIATION = 1.5  # farthest point over nearest; up to it, outlines hold 30,000 cones
OUTLINE_MARGIN = 0.01  # of rounding
MIN_OUTLINE_VARIANCE = 1e-4  # px^2


@dataclass(frozen=True, kw_only=True)
class LensRayTerms(RayTerms):
    """The same, kappa and h, with J, n and the splat's origin."""

    jacobian: Sequence[Array3f]  # px per scene unit
    depth: Array3f  # n, 1 / scene unit
    origin: Array3f | None  # None: that of the camera

    @override
    def numbers(self) -> list[Float]:
        numbers = [*super().numbers(), *self.jacobian[0], *self.jacobian[1], *self.depth]
        return numbers if self.origin is None else [*numbers, *self.origin]


def lens_shape(
    rows: GaussianRows, camera: Camera, position: Array3f, low_pass: Float | float
) -> FilmShape:
    """Project to the shape that :class:`LensRayFalloff` evaluates."""
    lens, own = camera.lens, camera.in_own_axes()
    slopes = lens.true_slopes(camera, position)
    film, kappa, h = seen_along(rows, camera, position, slopes, low_pass)
    depth, place = lens.depth_direction(own, position), film.means2d
    jacobian = lens.projection_jacobian(own, position, slopes)
    moves = place - dr.detach(place)
    jacobian = [row + move * depth for row, move in zip(jacobian, moves, strict=True)]
    origin = lens.origin(camera, *place) if lens.parallel else None
    if (reading := camera.reading) is not None:
        jacobian = [reading.turn.T @ row for row in jacobian]
        depth = reading.turn.T @ depth
        origin = reading.travel + (0 if origin is None else reading.turn.T @ origin)
    return replace(film, ray=LensRayTerms(*kappa, h, jacobian=jacobian, depth=depth, origin=origin))


@dataclass(frozen=True)
class PixelRay:
    """The ray of a pixel, in the axes of the camera when it opens its shutter."""

    direction: Array3f  # depth grows by 1 along it; 0: the lens shows nothing there
    origin: Array3f | None  # None: that of the camera

    @staticmethod
    def from_place(camera: Camera, x: Float, y: Float) -> PixelRay:
        """Return the ray through a place of the film, px."""
        own = replace(camera.in_own_axes(), center=dr.zeros(type(camera.center)))
        if camera.shutter is not None:
            own = replace(own, shutter=camera.shutter.in_axes(camera.rotation))
        at = own.at_row(y)
        origin, direction, seen = at.look_through(x, y)
        unit = dr.normalize(direction)
        unit *= at.lens.ray_range(unit, type(x)(1), type(x)(1))[0]
        unit = at.rotation.T @ dr.select(seen, unit, 0)
        if not has_origins(camera):
            return PixelRay(unit, None)
        return PixelRay(unit, at.center + at.rotation.T @ origin)


def has_origins(camera: Camera) -> bool:
    """Return whether the camera's rays start in different points."""
    return camera.lens.parallel or camera.shutter is not None


@dataclass(frozen=True)
class LensRayFootprint(MicroTileFootprint):
    """The same, with inputs of the derivatives of f = rho^2, at the 16 pixels; u and v are e."""

    along: list[Float]  # t of the peak
    d_e: tuple[list[Float], list[Float]]  # derivatives of f with respect to e
    d_a: list[Float]
    d_h: list[Float]
    d_o: tuple[list[Float], list[Float]]  # with respect to o', if rays have origins
    d_b: list[Float]
    origins: list[Array3f]  # from the splat's


@dataclass(frozen=True)
class LensRayFalloff(GaussianFalloff):
    """alpha = o exp(-rho^2 / 2) along each pixel's ray, behind any lens.

    Geometry: that of :class:`GaussianFalloff`; then J (6), n (3), kappa (2) and h, to base 2, and
    the splat's origin (3), if rays have origins of their own.
    """

    camera: Camera
    rays: tuple[PixelRay, ...] = ()  # at the 16 pixels of the lanes of one kernel
    camera_tangents: tuple[Float, ...] | None = None  # of the camera's numbers
    ray_tangents: tuple[PixelRay, ...] = ()

    @property
    @override
    def follows_rays(self) -> bool:
        return True

    @property
    @override
    def num_geometry(self) -> int:
        return 21 if has_origins(self.camera) else 18

    @property
    @override
    def num_moments(self) -> int:
        return 14 if has_origins(self.camera) else 11

    @override
    def bind(self, lanes: Lanes, positions: SamplePositions) -> LensRayFalloff:
        points = positions.points(lanes, type(self.camera.near))
        rays = tuple(PixelRay.from_place(self.camera, x, y) for x, y in points)
        if self.camera_tangents is None:
            return replace(self, rays=rays)
        with dr.resume_grad():
            camera = self.camera.map_numbers(type(self.camera.near))
            numbers = camera.numbers()
            dr.enable_grad(numbers)
            dr.set_grad(numbers, list(self.camera_tangents))
            moved = tuple(PixelRay.from_place(camera, x, y) for x, y in points)
            dr.forward_to(moved, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            tangents = dr.grad(moved)
        return replace(self, rays=rays, ray_tangents=tangents)

    @override
    def with_camera_tangents(self, camera_tangents: Sequence[Float]) -> LensRayFalloff:
        return replace(self, camera_tangents=tuple(camera_tangents))

    @override
    def geometry(self, splats: Splats2D) -> list[Float]:
        return [*super().geometry(splats), *self._terms(splats, WHITENING_SCALE)]

    @override
    def differentiable(self, splats: Splats2D) -> list[Float]:
        return [*super().differentiable(splats), *self._terms(splats, 1)]

    @staticmethod
    def _terms(splats: Splats2D, scale: float) -> list[Float]:
        ray = splats.ray
        assert isinstance(ray, LensRayTerms), "as lens_shape makes them"
        kappa_h = [ray.tilt_x / scale, ray.tilt_y / scale, ray.spread / scale**2]
        origin = [] if ray.origin is None else [*ray.origin]
        return [*ray.jacobian[0], *ray.jacobian[1], *ray.depth, *kappa_h, *origin]

    @override
    def outline(self, geometry: list[Float], reach: Float) -> list[Float]:
        """Return centre x, y, p, r, s of an ellipse |U d|^2 <= ``reach`` that holds the splat."""
        x, y = geometry[:2]
        t, splat, lens = types_of(type(x)), _SplatRows.unpack(geometry), self.camera.lens
        contour = splat.cylinder if lens.parallel else splat.cone
        is_wide = not isinstance(lens, Perspective)
        points, bounded = contour(reach, NUM_WIDE_POINTS if is_wide else NUM_OUTLINE_POINTS)
        place, offsets = t.Array2f(x, y), []
        for point in points:
            at, position = self._where_read(point, splat.origin)
            seen, position, _ = lens.visibility(replace(at, near=type(x)(0)), position)
            offsets.append(lens.offset(at, place, lens.project_point(at, position)))
            bounded &= seen
        if (period := lens.period(self.camera)) is not None:
            for offset in offsets:
                bounded &= dr.abs(offset.x) < period / 4
        offsets = [dr.select(bounded, offset, 0) for offset in offsets]
        center, factor, is_ellipse = _ellipse_around(offsets)
        found = [*(place + center), *(dr.sqrt(reach) * factor)]
        everywhere = [x, y, OPEN_OUTLINE, 0, OPEN_OUTLINE]
        bounded &= is_ellipse
        return [dr.select(bounded, a, b) for a, b in zip(found, everywhere, strict=True)]

    def _where_read(self, peak: Array3f, origin: Array3f | None) -> tuple[Camera, Array3f]:
        """Return the camera that reads a point, from the splat's origin, and the point's place."""
        camera = self.camera
        if origin is None:
            return camera, peak
        point = origin + peak
        if camera.shutter is None:
            return camera, point
        own = replace(
            camera.in_own_axes(),
            center=dr.zeros(type(camera.center)),
            shutter=camera.shutter.in_axes(camera.rotation),
        )
        at = own.for_means(point)
        return at, at.rotation @ (point - at.center)

    @override
    def footprint(
        self, geometry: list[Float], offsets_from: Offsets, active: Bool | bool
    ) -> LensRayFootprint:
        del offsets_from
        splat = _SplatRows.unpack(geometry)
        log2_opacity = dr.select(active, self.log2_opacity(geometry), -dr.inf)
        columns = zip(*(splat.peak(ray, log2_opacity) for ray in self.rays), strict=True)
        u, v, log2_alpha, along, d_e1, d_e2, d_a, d_h, d_o1, d_o2, d_b, origins = map(list, columns)
        return LensRayFootprint(
            *([], [], u, v, log2_alpha, along, (d_e1, d_e2), d_a, d_h, (d_o1, d_o2), d_b, origins)
        )

    def peak(self, geometry: list[Float], x: Float, y: Float) -> tuple[Float, Float]:
        """Return the numerator and the denominator of a peak's depth at a place of the film, px."""
        splat = _SplatRows.unpack(geometry)
        return splat.crossing(PixelRay.from_place(self.camera, x, y))[:2]

    @override
    def moments(
        self, footprint: MicroTileFootprint, weights: list[Float], positions: SamplePositions
    ) -> list[Float]:
        """Sum over the 16 pixels w = d loss / d ln(alpha) times 1 and the derivatives of f.

        Those with respect to E_1, E_2, A (three each) and h; and, if rays have origins, with
        respect to the splat's o'_1, o'_2 and -b.
        """
        assert isinstance(footprint, LensRayFootprint), "made by self.footprint"
        (d_e1, d_e2), (d_o1, d_o2) = footprint.d_e, footprint.d_o
        to_axes = (d_e1, d_o1, 1), (d_e2, d_o2, 1), (footprint.d_a, footprint.d_b, -1)
        sums, of_origins = [positions.sum(weights)], []
        directions = [[ray.direction[k] for ray in self.rays] for k in range(3)]
        for d_ray, d_origin, sign in to_axes:
            terms = [products(products(weights, d_ray), along) for along in directions]
            if has_origins(self.camera):
                w = products(weights, d_origin)
                of_origins.append(positions.sum(w))
                for k, term in enumerate(terms):
                    triples = zip(term, w, footprint.origins, strict=True)
                    terms[k] = [x + sign * each * o[k] for x, each, o in triples]
            sums += [positions.sum(term) for term in terms]
        return [*sums, positions.sum(products(weights, footprint.d_h)), *of_origins]

    @override
    def derivatives(self, geometry: list[Float], totals: list[Float]) -> list[Float]:
        """Turn moments into derivatives with respect to :meth:`differentiable`."""
        t, splat = types_of(type(totals[0])), _SplatRows.unpack(geometry)
        w, *sums = totals
        e1, e2, a = (-math.log(2) * t.Array3f(sums[k : k + 3]) for k in (0, 3, 6))
        (p, r, s), (kx, ky), (jx, jy) = splat.factor, splat.kappa, splat.jacobian
        d_kx, d_ky = -dr.dot(splat.e1, a), -dr.dot(splat.e2, a)
        e1, e2 = e1 - kx * a, e2 - ky * a
        d_jx, d_jy = p * e1, r * e1 + s * e2
        derivatives = [
            -dr.dot(d_jx, splat.depth),
            -dr.dot(d_jy, splat.depth),
            WHITENING_SCALE * dr.dot(e1, jx),
            WHITENING_SCALE * dr.dot(e1, jy),
            WHITENING_SCALE * dr.dot(e2, jy),
            dr.select(w == 0, 0, w * dr.exp2(-self.log2_opacity(geometry))),
            *d_jx,
            *d_jy,
            *a,
            d_kx / WHITENING_SCALE,
            d_ky / WHITENING_SCALE,
            -math.log(2) / WHITENING_SCALE**2 * sums[9],
        ]
        if splat.origin is None:
            return derivatives
        o1, o2, b = sums[10:]
        return [*derivatives, *(math.log(2) * (o1 * splat.e1 + o2 * splat.e2 - b * splat.a))]

    @override
    def bounds(
        self, splats: Splats2D, geometry: list[Float], reach: Float
    ) -> tuple[Array2f, Array2f]:
        x, y, p, r, s = self.outline(geometry, reach)
        t = types_of(type(p))
        half_sizes = t.Array2f(dr.sqrt(1 + dr.square(r / s)) / p, 1 / s)
        return t.Array2f(x, y), dr.sqrt(reach) * half_sizes

    @override
    def pack_tangents(self, geometry: list[Float], tangents: list[Float]) -> list[Float]:
        return super().pack_tangents(geometry, tangents[:6]) + list(tangents[6:])

    @override
    def tangent(
        self, geometry: list[Float], footprint: MicroTileFootprint, d_geometry: list[Float]
    ) -> list[Float]:
        assert isinstance(footprint, LensRayFootprint), "made by self.footprint"
        t, splat = types_of(type(geometry[0])), _SplatRows.unpack(geometry)
        d_x, d_y, d_p, d_r, d_s, d_log_opacity = d_geometry[:6]
        d_p, d_r, d_s = d_p * WHITENING_SCALE, d_r * WHITENING_SCALE, d_s * WHITENING_SCALE
        d_jx, d_jy, d_n = (t.Array3f(d_geometry[k : k + 3]) for k in (6, 9, 12))
        d_kx, d_ky = d_geometry[15] / WHITENING_SCALE, d_geometry[16] / WHITENING_SCALE
        d_h = d_geometry[17] / WHITENING_SCALE**2
        (p, r, s), (kx, ky), (jx, jy) = splat.factor, splat.kappa, splat.jacobian
        d_jx, d_jy = d_jx - d_x * splat.depth, d_jy - d_y * splat.depth
        d_e1 = d_p * jx + p * d_jx + d_r * jy + r * d_jy
        d_e2 = d_s * jy + s * d_jy
        d_a = d_n - d_kx * splat.e1 - kx * d_e1 - d_ky * splat.e2 - ky * d_e2
        rows = ((splat.e1, d_e1), (splat.e2, d_e2), (splat.a, d_a))
        result = []
        for k, ray in enumerate(self.rays):
            moved = self.ray_tangents[k] if self.ray_tangents else None
            slopes = footprint.d_e[0][k], footprint.d_e[1][k], footprint.d_a[k]
            d_f = footprint.d_h[k] * d_h
            for (row, d_row), slope in zip(rows, slopes, strict=True):
                change = dr.dot(d_row, ray.direction)
                if moved is not None:
                    change += dr.dot(row, moved.direction)
                d_f = dr.fma(slope, change, d_f)
            if has_origins(self.camera):
                d_origin = -t.Array3f(d_geometry[18:21])
                if moved is not None and moved.origin is not None:
                    d_origin += moved.origin
                slopes = footprint.d_o[0][k], footprint.d_o[1][k], -footprint.d_b[k]
                for (row, d_row), slope in zip(rows, slopes, strict=True):
                    change = dr.dot(d_row, footprint.origins[k]) + dr.dot(row, d_origin)
                    d_f = dr.fma(slope, change, d_f)
            result.append(dr.fma(-math.log(2), d_f, d_log_opacity))
        return result


@dataclass(frozen=True)
class _SplatRows:
    """The geometry of a splat by name, with the rows E_1, E_2 and A."""

    factor: tuple[Float, Float, Float]  # p, r, s
    jacobian: tuple[Array3f, Array3f]
    depth: Array3f
    kappa: tuple[Float, Float]
    h: Float
    origin: Array3f | None
    e1: Array3f
    e2: Array3f
    a: Array3f

    @staticmethod
    def unpack(geometry: list[Float]) -> _SplatRows:
        """Compute the rows once for all pixels."""
        t = types_of(type(geometry[0]))
        p, r, s = geometry[2:5]
        jx, jy, n = (t.Array3f(geometry[k : k + 3]) for k in (6, 9, 12))
        kx, ky, h = geometry[15:18]
        origin = t.Array3f(geometry[18:21]) if len(geometry) >= 21 else None
        e1, e2 = p * jx + r * jy, s * jy
        a = n - kx * e1 - ky * e2
        return _SplatRows((p, r, s), (jx, jy), n, (kx, ky), h, origin, e1, e2, a)

    def cone(self, reach: Float, count: int) -> tuple[list[Array3f], Bool]:
        """Return peaks, from the splat's origin, on rays with |e|^2 = ``reach`` D, and if any."""
        (kx, ky), h = self.kappa, self.h
        cone, peaks = bounding_cone(kx, ky, h, reach), []
        for x, y in _circle(count):
            u, v = cone.edge(x, y)
            a = 1 - dr.fma(kx, u, ky * v)
            peaks.append(self._point(u, v) * (a / dr.fma(a, a, h * dr.fma(u, u, v * v))))
        return peaks, cone.bounded

    def cylinder(self, reach: Float, count: int) -> tuple[list[Array3f], Bool | bool]:
        """Return the same for parallel rays, whose peaks are at 1 + kappa . e times the depth."""
        (kx, ky), size = self.kappa, dr.sqrt(reach)
        mean = self._point(type(size)(0), type(size)(0))
        edge = ((size * x, size * y) for x, y in _circle(count))
        return [self._point(u, v) + dr.fma(kx, u, ky * v) * mean for u, v in edge], True

    def _point(self, u: Float, v: Float) -> Array3f:
        """Return the point of the plane n . x = 1 with the coordinates e = (u, v)."""
        (p, r, s), (jx, jy), n = self.factor, self.jacobian, self.depth
        across = dr.cross(jy, n)
        y = v / s
        x = (u - r * y) / p
        return (dr.cross(jx, jy) + x * across + y * dr.cross(n, jx)) / dr.dot(jx, across)

    def crossing(self, ray: PixelRay) -> tuple:
        """Return numerator and denominator of the peak's t, those of f, and e, a, o', b, o."""
        e1, e2 = dr.dot(self.e1, ray.direction), dr.dot(self.e2, ray.direction)
        a = dr.dot(self.a, ray.direction)
        squared = dr.fma(e1, e1, e2 * e2)
        denominator = dr.fma(a, a, self.h * squared)
        if ray.origin is None:
            return a, denominator, squared, e1, e2, a, None, None, None, None
        assert self.origin is not None, "as lens_shape makes it"
        origin = ray.origin - self.origin
        o1, o2 = dr.dot(self.e1, origin), dr.dot(self.e2, origin)
        b = 1 - dr.dot(self.a, origin)
        g1, g2, x = dr.fma(b, e1, a * o1), dr.fma(b, e2, a * o2), dr.fma(o1, e2, -o2 * e1)
        numerator = dr.fma(g1, g1, dr.fma(g2, g2, self.h * x * x))
        along = dr.fma(a, b, -self.h * dr.fma(o1, e1, o2 * e2))
        return along, denominator, numerator, e1, e2, a, (o1, o2), b, (g1, g2, x), origin

    def peak(self, ray: PixelRay, log2_opacity: Float) -> tuple:
        """Return the columns of :class:`LensRayFootprint` at one pixel."""
        along, denominator, numerator, e1, e2, a, o, b, g, origin = self.crossing(ray)
        # Elsewhere alpha is 0, and its derivatives' factors have to be finite.
        shows = (along > 0) & (numerator < MAX_EXPONENT * denominator)
        inverse = dr.select(shows, 1 / denominator, 0)
        f, along = numerator * inverse, along * inverse
        log2_alpha = dr.select(shows, log2_opacity - f, -dr.inf)
        if o is None:
            scale = 2 * along * along
            derivatives = scale * e1, scale * e2, -2 * along * f, -f * f, None, None, None, None
            return e1, e2, log2_alpha, along, *derivatives
        (o1, o2), (g1, g2, x), h = o, g, self.h
        twice, squared = 2 * inverse, dr.fma(e1, e1, e2 * e2)
        derivatives = (
            twice * (b * g1 - h * dr.fma(x, o2, f * e1)),
            twice * (b * g2 + h * dr.fma(x, o1, -f * e2)),
            twice * (g1 * o1 + g2 * o2 - f * a),
            inverse * (x * x - f * squared),
            twice * (a * g1 + h * x * e2),
            twice * (a * g2 - h * x * e1),
            twice * (g1 * e1 + g2 * e2),
            origin,
        )
        return e1, e2, log2_alpha, along, *derivatives


def _circle(count: int) -> list[tuple[float, float]]:
    angles = [2 * math.pi * k / count for k in range(count)]
    return [(math.cos(angle), math.sin(angle)) for angle in angles]


def _ellipse_around(points: Sequence[Array2f]) -> tuple[Array2f, Array3f, Bool]:
    """Return centre and conic factor (p, r, s) of an ellipse around a closed curve, and if it fits.

    points: of the curve. It is enlarged by half of what the points deviate from it.
    """
    t, count = types_of(type(points[0].x)), len(points)
    center = sum(points[1:], points[0]) / count
    # Of an ellipse's points, evenly distributed, |U d|^2 is 1.
    columns = [math.sqrt(2 / count) * (point - center) for point in points]
    across, down = [c.x for c in columns], [c.y for c in columns]
    p, r, s = factor_conic(center, across, down, MIN_OUTLINE_VARIANCE).conic_factor
    whitened = (t.Array2f(dr.fma(p, x, r * y), s * y) for x, y in zip(across, down, strict=True))
    radii = [math.sqrt(count / 2) * dr.norm(offset) for offset in whitened]
    least, largest = reduce(dr.minimum, radii), reduce(dr.maximum, radii)
    scale = 1 / (OUTLINE_MARGIN + largest + (largest - least) / 2)
    fits = largest < MAX_OUTLINE_DEVIATION * (least + OUTLINE_MARGIN)
    return center, t.Array3f(p, r, s) * scale, fits


@dataclass(frozen=True)
class LensRayDepths(AffineDepths):
    """Depths at a pixel by :class:`LensRayFalloff`, relative to the means'."""

    camera: Camera | None = None

    @override
    def for_camera(self, camera: Camera) -> LensRayDepths:
        return replace(self, camera=camera)

    @override
    def keys(self, splats: Splats2D) -> list[Float]:
        return [splats.depths]

    @override
    def depth_ratio(
        self, falloff: GaussianFalloff, geometry: list[Float], keys: list[Float], x: Float, y: Float
    ) -> tuple[Float, Float]:
        assert self.camera is not None, "bound by for_camera"
        along, denominator = LensRayFalloff(self.camera).peak(geometry, x, y)
        return along, denominator * keys[-1]

    @override
    def _pixel_depths(self, footprint: MicroTileFootprint, keys: list[Float]) -> list[Float]:
        assert isinstance(footprint, LensRayFootprint), "made by LensRayFalloff"
        per_depth = 1 / keys[-1]
        return [along * per_depth for along in footprint.along]
