"""Depths of splats' peaks along the ray of each pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from drgs.accuracy.exact import RayFootprint, closest_on_film, ray_denominator
from drgs.core.constants import WHITENING_SCALE
from drgs.splatting.image_model import Footprint
from drgs.splatting.tiles import TileBins


@dataclass(frozen=True)
class AffineDepths:
    """Depths at a pixel for a response that does not know them: stores what they depend on."""

    def keys(self, splats: Any) -> list[Any]:
        """kappa, h (scaled to base 2), and the depth of the mean."""
        kx, ky, h = splats.perspective
        scale = WHITENING_SCALE
        return [kx / scale, ky / scale, h / scale**2, splats.depths]

    def at(self, bins: TileBins, numbers: tuple, x: Any, y: Any) -> tuple[Any, Any]:
        """a and D at a point of the film; numbers: geometry and keys of the splat."""
        del bins
        geometry, keys = numbers
        return self._at(keys, *_coordinates(geometry, x, y))

    def along(self, footprint: Footprint, keys: list[Any]) -> list[Any]:
        """Depths at the 16 pixels, divided by the mean's; not positive where there is none."""
        coordinates = zip(flat_columns(footprint.u), flat_columns(footprint.v), strict=True)
        return [a / denominator for a, denominator in (self._at(keys, *e) for e in coordinates)]

    @staticmethod
    def _at(keys: list[Any], u: Any, v: Any) -> tuple[Any, Any]:
        kx, ky, h = keys[:3]
        a = dr.fma(-kx, u, dr.fma(-ky, v, 1))
        return a, dr.fma(a, a, h * dr.fma(u, u, v * v))


@dataclass(frozen=True)
class ParallelDepths(AffineDepths):
    """The same for rays that are parallel."""

    @staticmethod
    def _at(keys: list[Any], u: Any, v: Any) -> tuple[Any, Any]:
        kx, ky = keys[:2]
        return dr.fma(kx, u, dr.fma(ky, v, 1)), type(u)(1)


@dataclass(frozen=True)
class RayDepths:
    """Depths at a pixel for ``RayResponse``, which computes them."""

    def keys(self, splats: Any) -> list[Any]:
        """The depth of the mean, divided by |a_c|."""
        return [splats.depths * splats.perspective[3]]

    def at(self, bins: TileBins, numbers: tuple, x: Any, y: Any) -> tuple[Any, Any]:
        """a and D at a point of the film."""
        geometry, _ = numbers
        u, v = _coordinates(geometry, x, y)
        anchor = closest_on_film(bins.model.response.camera, *geometry[:2])
        _, a, denominator = ray_denominator(geometry, u, v, x - anchor.x, y - anchor.y)
        return a, denominator

    def along(self, footprint: RayFootprint, keys: list[Any]) -> list[Any]:
        """Depths at the 16 pixels, divided by the key; not positive where there is none."""
        del keys
        return footprint.along


def _coordinates(geometry: list[Any], x: Any, y: Any) -> tuple[Any, Any]:
    """e = U d at a point of the film."""
    mean_x, mean_y, p, r, s = geometry[:5]
    dx, dy = x - mean_x, y - mean_y
    return dr.fma(p, dx, r * dy), s * dy


def flat_columns(rows: list) -> list[Any]:
    """The 16 values of 4 rows of 4."""
    return [value for row in rows for value in row]
