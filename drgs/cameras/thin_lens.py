"""The aperture of a thin lens (Mitsuba's ``thinlens``); ``drgs.effects.defocus`` blurs splats."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from drgs.cameras.camera import Camera
from drgs.core.arrays import types_of
from drgs.core.types import Array3f, Bool, Float


@dataclass(frozen=True)
class RoundAperture:
    """A disc; points at ``focus_distance`` are sharp."""

    radius: Float  # scene units
    focus_distance: Float  # scene units, along the axis

    def variance(self, camera: Camera, depth: Float) -> Float:
        """Return the variance along either axis, px^2, of the blur of a point at ``depth``.

        Its radius is focal radius |1 / focus_distance - 1 / depth| (similar triangles), and a
        uniform disc of radius r has the variance r^2 / 4. Pixels are square.
        """
        radius = camera.focal.x * self.radius * (1 / self.focus_distance - 1 / depth)
        return dr.square(radius) / 4

    def rays(self, camera: Camera, x: Float, y: Float, count: int) -> tuple[Array3f, Bool | bool]:
        """Return directions (world) of ``count`` rays of each place (px), and validity.

        They begin all over the disc and meet at the focus distance.
        """
        t = types_of(type(x))
        on_disc = dr.tile(t.Array2f(_disc(count)), dr.width(x))
        x, y = dr.repeat(x, count), dr.repeat(y, count)
        camera = camera.at_row(y)
        _, ray, seen = camera.look_through(x, y)
        begin = t.Array3f(on_disc.x, on_disc.y, 0)
        ray = ray * self.focus_distance - begin * self.radius
        return camera.rotation.T @ ray, seen

    def in_focus(self, origin: Array3f, direction: Array3f) -> Array3f:
        """Return the point of a ray (camera axes) where all rays of its place meet."""
        t = (self.focus_distance - origin.z) / direction.z
        return origin + t * direction


def _disc(count: int) -> np.ndarray:
    """Return points (2, count) with equal shares of the unit disc: a sunflower's seeds."""
    k = np.arange(count)
    radii, angles = np.sqrt((k + 0.5) / count), np.pi * (3 - np.sqrt(5)) * k
    return np.array([radii * np.cos(angles), radii * np.sin(angles)])
