"""A lens of drgs in a package of its own: the equisolid, or equal-area, fisheye.

A point at the angle theta from the axis is at the radius 2 sin(theta / 2) on the film, for a focal
length of 1, so that equal solid angles have equal areas. With the distance d of a point,

    film = focal (x, y) s + principal,    s = sqrt(2 / (d (d + z)))
"""

from dataclasses import dataclass

import drjit as dr

from drgs.cameras.lens import LENSES, Lens
from drgs.core.arrays import types_of

MIN_COSINE = -0.99  # of the angle from the axis: directions behind the camera have no place


@LENSES.register("equisolid")
@dataclass(frozen=True)
class Equisolid(Lens):
    """The equal-area fisheye: ``lens = equisolid``, without coefficients."""

    def shows(self, position):
        """Return whether a point has a place on the film; position: Array3f, camera axes."""
        return position.z > MIN_COSINE * dr.norm(position)

    def project_point(self, camera, position):
        """Return the place of a point on the film, Array2f, px."""
        x, y, z = position
        distance = dr.norm(position)
        scale = dr.sqrt(2 / (distance * (distance + z)))
        return camera.focal * types_of(type(x)).Array2f(x, y) * scale + camera.principal

    def projection_jacobian(self, camera, position, slopes=None):
        """Return the derivatives of x and y on the film, two Array3f, world: px per scene unit."""
        right, down, forward = camera.rotation  # the camera's axes
        x, y, z = position
        distance = dr.norm(position)
        area = distance * (distance + z)
        scale = dr.sqrt(2 / area)
        growth = (2 + z / distance) * (x * right + y * down + z * forward) + distance * forward
        fall = -scale / (2 * area) * growth  # the derivative of scale
        return [
            focal * (scale * axis + place * fall)
            for focal, axis, place in zip(camera.focal, (right, down), (x, y), strict=True)
        ]
