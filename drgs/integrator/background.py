"""What is seen past the splats that is no constant: an environment, a texture.

Imported when a scene has an environment emitter or the background is a texture. Both are linear
radiance, evaluated where the pixels are, and differentiated by Dr.Jit. Derivatives of an image's
texels are added atomically: they, and no others, are the same in every run only up to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.cameras.camera import Camera
from drgs.integrator.film import pixel_corners

LENS_POINTS = 16
"""At which an aperture is sampled, for each place on the film: always the same, so that nothing is
random. What is much brighter than its surroundings and smaller than the gaps between them is seen
as so many pictures of itself."""


class Background(Protocol):
    """What is seen past the splats."""

    opaque: bool  # whether it covers the film: alpha is then 1

    def radiance(self, film: mi.Film, camera: Camera, place: mi.Point2f) -> mi.Color3f:
        """At places in the crop window, px."""


@dataclass(frozen=True)
class Environment:
    """An emitter that surrounds the scene, in the directions of the camera's rays."""

    emitter: mi.Emitter
    opaque = True  # as in Mitsuba's other integrators, an environment that is seen is covered film

    def radiance(self, film: mi.Film, camera: Camera, place: mi.Point2f) -> mi.Color3f:
        """At places in the crop window, px; black where the lens model ends."""
        del film
        if camera.aperture is None:
            return self._along_rays(camera, place)
        x, y = dr.tile(_disc(LENS_POINTS), dr.width(place))
        radiance = self._along_rays(camera, dr.repeat(place, LENS_POINTS), mi.Vector3f(x, y, 0))
        if dr.width(radiance) == 1:  # the same from everywhere
            return radiance
        return mi.Color3f([dr.block_sum(color, LENS_POINTS) for color in radiance]) / LENS_POINTS

    def _along_rays(
        self, camera: Camera, place: mi.Point2f, lens_point: mi.Vector3f | None = None
    ) -> mi.Color3f:
        """Radiance at places; lens_point: of the unit disc, where the aperture's rays begin.

        They meet at the focus distance. As the environment is infinitely far, only their direction
        counts.
        """
        camera = camera.at_row(place.y)
        _, ray, seen = camera.look_through(place.x, place.y)
        if lens_point is not None:
            ray = ray * camera.aperture.focus_distance - lens_point * camera.aperture.radius
        interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(place))
        interaction.wi = -mi.Vector3f(dr.normalize(camera.rotation.T @ ray))
        radiance = mi.Color3f(self.emitter.eval(interaction))
        return radiance if seen is True else dr.select(seen, radiance, 0)


def _disc(count: int) -> mi.Point2f:
    """Points of the unit disc, each with an equal share of its area: the seeds of a sunflower."""
    k = np.arange(count)
    radii, angles = np.sqrt((k + 0.5) / count), np.pi * (3 - np.sqrt(5)) * k
    return mi.Point2f(np.array([radii * np.cos(angles), radii * np.sin(angles)]))


@dataclass(frozen=True)
class StretchedTexture:
    """A texture that is stretched over the whole film."""

    texture: mi.Texture
    opaque = False

    def radiance(self, film: mi.Film, camera: Camera, place: mi.Point2f) -> mi.Color3f:
        """At places in the crop window, px."""
        del camera
        interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(place))
        whole = (place + mi.Vector2f(film.crop_offset())) / mi.Vector2f(film.size())
        interaction.uv = whole
        return mi.Color3f(self.texture.eval(interaction))


def seen_by(
    film: mi.Film,
    background: Background,
    cameras: Sequence[Camera],
    within: Sequence[tuple[mi.Float | float, mi.Float | float]],
) -> list[list[mi.Color3f]]:
    """Radiance of all pixels, by time and by sample.

    cameras: of each time; within: of each sample, x and y from the pixel's upper left corner, px.
    """
    corner = pixel_corners(film)
    places = [corner + mi.Vector2f(x, y) for x, y in within]
    return [[background.radiance(film, camera, place) for place in places] for camera in cameras]
