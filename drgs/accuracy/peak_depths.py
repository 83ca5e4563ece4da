"""Depths of splats' peaks along the ray of each pixel: what the order of each pixel compares.

:class:`RayDepths` where the falloff finds the peak anyway (``drgs.accuracy.exact``, whose formulas
these are), :class:`AffineDepths` where it does not, :class:`ParallelDepths` where rays do not meet.
:class:`BoundedDepths` are those of one of them where each pixel sees a part of its ray.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr

from drgs.accuracy.exact import RayFootprint, closest_on_film, ray_denominator
from drgs.cameras.camera import Camera
from drgs.core.constants import WHITENING_SCALE
from drgs.splatting.footprint import Footprint, GaussianFalloff, flat_columns
from drgs.splatting.grid import Lanes, TileGrid
from drgs.splatting.lanes import load_pixels
from drgs.splatting.projection import (
    FilmShape,
    GaussianRows,
    Projection,
    RayTerms,
    Splats2D,
    film_axes,
)


@dataclass(frozen=True)
class AffineDepths:
    """Depths at a pixel for a falloff that does not know them: stores what they depend on.

    The base of all classes of depths.
    """

    def for_camera(self, camera: Camera) -> AffineDepths:
        """For one camera, whose rays may be parallel."""
        return ParallelDepths() if camera.lens.parallel else self

    def keys(self, splats: Splats2D) -> list[Any]:
        """Return columns from which depths are computed; last, their unit.

        Here kappa, h (scaled to base 2), and the depth of the mean.
        """
        ray, scale = splats.ray, WHITENING_SCALE
        return [ray.tilt_x / scale, ray.tilt_y / scale, ray.spread / scale**2, splats.depths]

    def at(
        self, falloff: GaussianFalloff, geometry: list[Any], keys: list[Any], x: Any, y: Any
    ) -> tuple[Any, Any]:
        """Return a and D at a point of the film, px: the depth is a / D in the unit, if a > 0."""
        return self._at(keys, *falloff.coordinates(geometry, x, y))

    def bind(self, lanes: Lanes, grid: TileGrid) -> AffineDepths:
        """For the lanes of one kernel: nothing has to be loaded."""
        del lanes, grid
        return self

    def along(self, footprint: Footprint, keys: list[Any]) -> list[Any]:
        """Return depths in the unit at the 16 pixels; not positive where there is none."""
        coordinates = zip(flat_columns(footprint.u), flat_columns(footprint.v), strict=True)
        return [a / denominator for a, denominator in (self._at(keys, *e) for e in coordinates)]

    @staticmethod
    def _at(keys: list[Any], u: Any, v: Any) -> tuple[Any, Any]:
        kx, ky, h = keys[:3]
        a = dr.fma(-kx, u, dr.fma(-ky, v, 1))
        return a, dr.fma(a, a, h * dr.fma(u, u, v * v))


@dataclass(frozen=True)
class WithAffineDepth:
    """A projection, and what :class:`AffineDepths` need: the affine covariance with the depth."""

    shape: Projection

    def __call__(
        self, rows: GaussianRows, camera: Camera, position: Any, low_pass: float
    ) -> FilmShape:
        """Project; h is not negative. Where slopes are clamped, the splat is the affine one."""
        film = self.shape(rows, camera, position, low_pass)
        slopes = camera.lens.clamped_slopes(camera, position)
        m0, m1, n = film_axes(rows, camera, position, slopes)
        p, r, s = film.whitening
        kx, ky = dr.dot(m0, n), dr.dot(m1, n)
        kx, ky = dr.fma(p, kx, r * ky), s * ky
        h = dr.squared_norm(n) - dr.fma(kx, kx, ky * ky)
        return replace(film, ray=RayTerms(kx, ky, dr.select(h > 0, h, 0)))


@dataclass(frozen=True)
class ParallelDepths(AffineDepths):
    """The same for rays that are parallel."""

    @staticmethod
    def _at(keys: list[Any], u: Any, v: Any) -> tuple[Any, Any]:
        kx, ky = keys[:2]
        return dr.fma(kx, u, dr.fma(ky, v, 1)), type(u)(1)


@dataclass(frozen=True)
class RayDepths(AffineDepths):
    """Depths at a pixel for ``RayFalloff``, which computes them."""

    camera: Camera | None = None  # whose film has the anchors

    def for_camera(self, camera: Camera) -> RayDepths:
        return replace(self, camera=camera)

    def keys(self, splats: Splats2D) -> list[Any]:
        return [splats.depths * splats.ray.scale]

    def at(
        self, falloff: GaussianFalloff, geometry: list[Any], keys: list[Any], x: Any, y: Any
    ) -> tuple[Any, Any]:
        del keys
        u, v = falloff.coordinates(geometry, x, y)
        anchor = closest_on_film(self.camera, *geometry[:2])
        _, a, denominator = ray_denominator(geometry, u, v, x - anchor.x, y - anchor.y)
        return a, denominator

    def along(self, footprint: RayFootprint, keys: list[Any]) -> list[Any]:
        del keys
        return footprint.along


@dataclass(frozen=True)
class BoundedDepths(AffineDepths):
    """Depths of peaks between two bounds of each pixel: there are no others."""

    depths: AffineDepths
    nearest: Any  # Float (H * W,), scene units
    farthest: Any  # the same
    bounds: list[tuple[Any, Any]] = field(default_factory=list)  # the 16 of each lane

    def for_camera(self, camera: Camera) -> BoundedDepths:
        return replace(self, depths=self.depths.for_camera(camera))

    def keys(self, splats: Splats2D) -> list[Any]:
        return self.depths.keys(splats)

    def at(
        self, falloff: GaussianFalloff, geometry: list[Any], keys: list[Any], x: Any, y: Any
    ) -> tuple[Any, Any]:
        return self.depths.at(falloff, geometry, keys, x, y)

    def bind(self, lanes: Lanes, grid: TileGrid) -> BoundedDepths:
        near, far = (load_pixels(bound, lanes, grid) for bound in (self.nearest, self.farthest))
        return replace(
            self,
            depths=self.depths.bind(lanes, grid),
            bounds=list(zip(near, far, strict=True)),
        )

    def along(self, footprint: Footprint, keys: list[Any]) -> list[Any]:
        unit = keys[-1]
        return [
            dr.select((unit * along > near) & (unit * along < far), along, -1)
            for along, (near, far) in zip(
                self.depths.along(footprint, keys), self.bounds, strict=True
            )
        ]
