"""The aperture of a thin lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from drgs.cameras.camera import Camera


@dataclass(frozen=True)
class Aperture:
    """Of a thin lens: what is at ``focus_distance`` is sharp."""

    radius: Any  # Float, scene units
    focus_distance: Any  # Float, scene units, along the axis

    def variance(self, camera: Camera, depth: Any) -> Any:
        """Along either axis, px^2, of the disc over which a point at ``depth`` is spread.

        Its radius is focal radius |1 / focus_distance - 1 / depth| (similar triangles), and a
        uniform disc of radius R has the variance R^2 / 4. Pixels are square.
        """
        radius = camera.focal.x * self.radius * (1 / self.focus_distance - 1 / depth)
        return dr.square(radius) / 4
