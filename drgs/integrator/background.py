"""Backgrounds that differ from pixel to pixel: environments, and textures stretched over the film.

Imported when there is one. Derivatives of texels are added atomically: runs agree only up to
rounding.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from drgs.cameras.camera import Camera
from drgs.integrator.film import num_samples, pixel_corners

LENS_POINTS = 16  # fixed points of an aperture; a small, bright light is seen as this many


def environment_radiance(emitter: mi.Emitter, camera: Camera, place: mi.Point2f) -> mi.Color3f:
    """Return an environment at places of the crop window, px; black where the lens ends."""
    ray, seen, count = camera.view_directions(place.x, place.y, LENS_POINTS)
    interaction = dr.zeros(mi.SurfaceInteraction3f, count * dr.width(place))
    interaction.wi = -mi.Vector3f(dr.normalize(ray))  # the environment is infinitely far
    radiance = mi.Color3f(emitter.eval(interaction))
    if seen is not True:
        radiance = dr.select(seen, radiance, 0)
    if count == 1 or dr.width(radiance) == 1:  # the latter: a constant environment
        return radiance
    return mi.Color3f([dr.block_sum(color, count) for color in radiance]) / count


def stretched_radiance(texture: mi.Texture, film: mi.Film, place: mi.Point2f) -> mi.Color3f:
    """Return a texture that is stretched over the film; place: on the crop window, px."""
    interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(place))
    interaction.uv = (place + mi.Vector2f(film.crop_offset())) / mi.Vector2f(film.size())
    return mi.Color3f(texture.eval(interaction))


def background_radiance(
    film: mi.Film,
    background: mi.Emitter | mi.Texture,
    cameras: Sequence[Camera],
    offsets: Sequence[tuple[mi.Float | float, mi.Float | float]],
) -> list[list[mi.Color3f]]:
    """Return the background at all pixels, by time and by pass.

    cameras: by time; offsets: by pass, x and y from the pixel's upper left corner, px.
    """
    places = [pixel_corners(film, num_samples(film, x)) + mi.Vector2f(x, y) for x, y in offsets]
    if isinstance(background, mi.Texture):
        found = [stretched_radiance(background, film, place) for place in places]
        return [found] * len(cameras)
    return [[environment_radiance(background, camera, p) for p in places] for camera in cameras]
