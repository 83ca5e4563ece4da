"""Backgrounds that are no constant: an environment, a texture.

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

from drgs.cameras.camera import Camera
from drgs.integrator.film import pixel_corners, samples_in

LENS_POINTS = 16
"""At which an aperture is sampled, for each place on the film: always the same, so that nothing is
random. What is much brighter than its surroundings and smaller than the gaps between them is seen
as so many pictures of itself."""


class Background(Protocol):
    """A background that varies over the film."""

    def radiance(self, film: mi.Film, camera: Camera, place: mi.Point2f) -> mi.Color3f:
        """At places in the crop window, px."""


@dataclass(frozen=True)
class Environment:
    """An emitter that surrounds the scene, in the directions of the camera's rays."""

    emitter: mi.Emitter

    def radiance(self, film: mi.Film, camera: Camera, place: mi.Point2f) -> mi.Color3f:
        """At places in the crop window, px; black where the lens model ends."""
        del film
        ray, seen, count = camera.view_directions(place.x, place.y, LENS_POINTS)
        interaction = dr.zeros(mi.SurfaceInteraction3f, count * dr.width(place))
        # As the environment is infinitely far, only directions count.
        interaction.wi = -mi.Vector3f(dr.normalize(ray))
        radiance = mi.Color3f(self.emitter.eval(interaction))
        if seen is not True:
            radiance = dr.select(seen, radiance, 0)
        if count == 1 or dr.width(radiance) == 1:  # the latter: the same from everywhere
            return radiance
        return mi.Color3f([dr.block_sum(color, count) for color in radiance]) / count


@dataclass(frozen=True)
class StretchedTexture:
    """A texture that is stretched over the whole film."""

    texture: mi.Texture

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
    """Radiance of all pixels, by time and by pass.

    cameras: of each time; within: of each pass, x and y from the pixel's upper left corner, px.
    """
    places = [pixel_corners(film, samples_in(film, x)) + mi.Vector2f(x, y) for x, y in within]
    return [[background.radiance(film, camera, place) for place in places] for camera in cameras]
