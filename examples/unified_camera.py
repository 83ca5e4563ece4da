"""A lens from outside of drgs: the unified camera model of catadioptric and fisheye cameras.

A point is projected to the unit sphere, and from there to the film by a pinhole that lies ``xi``
behind the sphere's centre (Geyer and Daniilidis 2000; Mei and Rives 2007; Kalibr's "omni"):

    film = focal (x, y) / (z + xi |position|) + principal

With xi = 0 it is a pinhole, with xi = 1 a stereographic fisheye.
"""

from dataclasses import dataclass

import drjit as dr

from drgs.cameras.lens import LENSES, Lens
from drgs.core.arrays import types_of


@LENSES.register("unified")
@dataclass(frozen=True)
class UnifiedCamera(Lens):
    """A sphere in front of a pinhole; ``lens = unified``, with the coefficient ``xi``."""

    xi: float = 1.0

    def shows(self, position):
        """Return whether a point is on the part of the sphere that faces the pinhole."""
        z = position.z / dr.norm(position)
        return (z > -0.99 * self.xi) & (self.xi * z > -0.99)

    def project_point(self, camera, position):
        """Return the place of a point on the film, Array2f, px."""
        x, y, z = position
        depth = z + self.xi * dr.norm(position)
        return camera.focal * types_of(type(x)).Array2f(x, y) / depth + camera.principal

    def projection_jacobian(self, camera, position, slopes=None):
        """Return the derivatives of x and y on the film, two Array3f, world: px per scene unit."""
        right, down, forward = camera.rotation  # the camera's axes
        x, y, z = position
        distance = dr.norm(position)
        depth = z + self.xi * distance
        growth = forward + self.xi / distance * (x * right + y * down + z * forward)
        return [
            focal / depth * (axis - c / depth * growth)
            for focal, axis, c in zip(camera.focal, (right, down), (x, y), strict=True)
        ]

    def ray(self, camera, x, y):
        """Return the direction of the ray through a place of the film, Array3f, camera axes."""
        t = types_of(type(x))
        m = (t.Array2f(x, y) - camera.principal) / camera.focal
        squared = dr.squared_norm(m)
        root = dr.sqrt(1 + (1 - self.xi * self.xi) * squared)
        scale = (self.xi + root) / (1 + squared)
        return t.Array3f(scale * m.x, scale * m.y, scale - self.xi)
