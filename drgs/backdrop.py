"""What is seen past the splats that is no constant: an environment, a picture.

Layer 4, imported when a scene has an environment emitter or the background is a texture. Both are
linear radiance, evaluated where the pixels are, and differentiated by Dr.Jit. Derivatives of an
image's texels are added atomically: they, and no others, are the same in every run only up to
rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass(frozen=True)
class Environment:
    """An emitter that surrounds the scene, in the directions of the sensor's rays."""

    emitter: mi.Emitter
    opaque = True  # as in Mitsuba's other integrators, an environment that is seen is covered film

    def radiance(self, sensor: mi.Sensor, place: mi.Point2f, time: float) -> mi.Color3f:
        """At places in the crop window, px."""
        size = mi.Vector2f(sensor.film().crop_size())
        ray, _ = sensor.sample_ray(mi.Float(time), mi.Float(0.5), place / size, mi.Point2f(0.5))
        interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(place))
        interaction.wi = -ray.d
        return mi.Color3f(self.emitter.eval(interaction))


@dataclass(frozen=True)
class Picture:
    """A texture that is stretched over the whole film."""

    texture: mi.Texture
    opaque = False

    def radiance(self, sensor: mi.Sensor, place: mi.Point2f, time: float) -> mi.Color3f:
        """At places in the crop window, px."""
        del time
        film = sensor.film()
        interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(place))
        whole = (place + mi.Vector2f(film.crop_offset())) / mi.Vector2f(film.size())
        interaction.uv = whole
        return mi.Color3f(self.texture.eval(interaction))


def seen_by(
    sensor: mi.Sensor,
    backdrop: Environment | Picture,
    times: Sequence[float],
    within: Sequence[tuple[mi.Float | float, mi.Float | float]],
) -> list[list[mi.Color3f]]:
    """Radiance of all pixels, by time and by sample.

    within: of each sample, x and y from the pixel's upper left corner, px.
    """
    width, height = sensor.film().crop_size()
    pixel = dr.arange(mi.UInt32, width * height)
    row = pixel // dr.opaque(mi.UInt32, width)
    corner = mi.Point2f(pixel - row * width, row)
    places = [corner + mi.Vector2f(x, y) for x, y in within]
    return [[backdrop.radiance(sensor, place, t) for place in places] for t in times]
