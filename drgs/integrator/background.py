"""Backgrounds that are no constant: an environment, a texture.

Imported when a scene has an environment emitter or the background is a texture. Both are linear
radiance, evaluated where the pixels are, and differentiated by Dr.Jit. Derivatives of an image's
texels are added atomically: they, and no others, are the same in every run only up to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from drgs.cameras.camera import Camera
from drgs.integrator.film import pixel_corners, samples_in

LENS_POINTS = 16
"""At which an aperture is sampled, for each place on the film: always the same, so that nothing is
random. What is much brighter than its surroundings and smaller than the gaps between them is seen
as so many pictures of itself."""


def environment_radiance(emitter: mi.Emitter, camera: Camera, place: mi.Point2f) -> mi.Color3f:
    """Return an emitter's radiance along the camera's rays; black where the lens model ends.

    place: on the crop window, px.
    """
    ray, seen, count = camera.view_directions(place.x, place.y, LENS_POINTS)
    interaction = dr.zeros(mi.SurfaceInteraction3f, count * dr.width(place))
    # As the environment is infinitely far, only directions count.
    interaction.wi = -mi.Vector3f(dr.normalize(ray))
    radiance = mi.Color3f(emitter.eval(interaction))
    if seen is not True:
        radiance = dr.select(seen, radiance, 0)
    if count == 1 or dr.width(radiance) == 1:  # the latter: the same from everywhere
        return radiance
    return mi.Color3f([dr.block_sum(color, count) for color in radiance]) / count


def stretched_radiance(texture: mi.Texture, film: mi.Film, place: mi.Point2f) -> mi.Color3f:
    """Return a texture that is stretched over the whole film; place: on the crop window, px."""
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

    cameras: of each time; offsets: of each pass, x and y from the pixel's upper left corner, px.
    """
    places = [pixel_corners(film, samples_in(film, x)) + mi.Vector2f(x, y) for x, y in offsets]
    if isinstance(background, mi.Texture):
        found = [stretched_radiance(background, film, place) for place in places]
        return [found] * len(cameras)
    return [[environment_radiance(background, camera, p) for p in places] for camera in cameras]
