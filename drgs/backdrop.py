"""What is seen past the splats that is no constant: an environment, a picture.

Layer 4, imported when a scene has an environment emitter or the background is a texture. Both are
linear radiance, evaluated where the pixels are, and differentiated by Dr.Jit. Derivatives of an
image's texels are added atomically: they, and no others, are the same in every run only up to
rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from drgs.camera import Camera

MISSED = 0.01
"""px: how far from its place a ray's point may be seen. Where no ray's is, a lens sees nothing."""


@dataclass(frozen=True)
class Environment:
    """An emitter that surrounds the scene, in the directions of the camera's rays."""

    emitter: mi.Emitter
    opaque = True  # as in Mitsuba's other integrators, an environment that is seen is covered film

    def radiance(self, film: mi.Film, camera: Camera, place: mi.Point2f) -> mi.Color3f:
        """At places in the crop window, px; black where the lens model ends."""
        del film
        if camera.shutter is not None:  # its rows are read one after the other
            row = (place.y - camera.film_start.y) / (camera.film_end.y - camera.film_start.y)
            camera = camera.shutter.pose(camera, row)
        ray = camera.lens.ray(camera, place.x, place.y)
        interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(place))
        interaction.wi = -mi.Vector3f(dr.normalize(camera.rotation.T @ ray))
        radiance = mi.Color3f(self.emitter.eval(interaction))
        if not camera.lens.distorts:
            return radiance
        seen, _, _ = camera.lens.look(replace(camera, near=mi.Float(0)), ray)
        missed = mi.Vector2f(camera.lens.film_point(camera, ray)) - mi.Vector2f(place)
        return dr.select(seen & (dr.squared_norm(missed) < MISSED**2), radiance, 0)


@dataclass(frozen=True)
class Picture:
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
    backdrop: Environment | Picture,
    cameras: Sequence[Camera],
    within: Sequence[tuple[mi.Float | float, mi.Float | float]],
) -> list[list[mi.Color3f]]:
    """Radiance of all pixels, by time and by sample.

    cameras: of each time; within: of each sample, x and y from the pixel's upper left corner, px.
    """
    width, height = film.crop_size()
    pixel = dr.arange(mi.UInt32, width * height)
    row = pixel // dr.opaque(mi.UInt32, width)
    corner = mi.Point2f(pixel - row * width, row)
    places = [corner + mi.Vector2f(x, y) for x, y in within]
    return [[backdrop.radiance(film, camera, place) for place in places] for camera in cameras]
