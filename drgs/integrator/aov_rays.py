"""Splats along the single rays of a whole image, inside Mitsuba's ``aov``.

Imported when ``aov`` calls ``sample`` with the rays of all pixels at once. With n rays per pixel,
ray k must start in pixel k // n of the sensor that was rendered last. The camera projects each to
its place on the film, where the splats are evaluated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from drgs.cameras.camera import Camera
from drgs.core.arrays import interleave
from drgs.core.errors import UnsupportedError
from drgs.integrator.film import Channels, SamplePoints, pixel_corners, split_passes, split_samples
from drgs.integrator.image_render import SensorRender, constant_background, nested_surfaces
from drgs.integrator.sensors import camera_from_sensor, is_batch, read_sensor
from drgs.integrator.state import SplatsState

if TYPE_CHECKING:  # imported where a scene has surfaces
    from drgs.integrator.light.surfaces import NestedSurfaces

NESTED_VIEW = -1  # index of the view in the cache
PIXEL_MARGIN_PX = 1 / 16  # largest distance of a ray from its pixel; float32 finds it to 1e-3 px
MAX_CENTER_ERROR = 1e-5  # distance of a ray from the camera's centre, relative to coordinates


@dataclass(frozen=True, eq=False)
class ImageRays:
    """Rays of a whole image and their sample positions. Equality is identity."""

    ray: mi.RayDifferential3f  # (H * W * count,): the rays of a pixel are neighbours
    count: int  # rays per pixel
    positions: tuple[SamplePoints, ...]  # by pass

    @staticmethod
    def from_rays(sensor: mi.Sensor | None, near: float, ray: mi.RayDifferential3f) -> ImageRays:
        """Find the rays' sample positions; UnsupportedError unless they are of an image."""
        if sensor is None:
            raise UnsupportedError(
                "splats: this integrator renders whole images: of those that sample the rays of "
                "another one, such as 'moment', it can only be nested in 'aov'"
            )
        film = sensor.film()
        width, height = film.crop_size()
        count, rest = divmod(dr.width(ray), width * height)
        _require(count > 0 and rest == 0 and not is_batch(sensor), sensor)
        camera = camera_from_sensor(read_sensor(sensor, near))
        _require(camera.shutter is None, sensor)
        corner = dr.repeat(pixel_corners(film), count)
        place, on_camera = _look_back(camera, ray)
        within = place - corner
        inside = (dr.min(within) > -PIXEL_MARGIN_PX) & (dr.max(within) < 1 + PIXEL_MARGIN_PX)
        _require(bool(dr.all(inside & on_camera)), sensor)
        within = mi.Point2f(dr.clip(within, 0, 1 - dr.epsilon(mi.Float)))
        positions = split_passes(within, count, width * height)
        dr.eval([(p.x, p.y) for p in positions])
        return ImageRays(ray, count, positions)

    def channels(
        self,
        splats: SplatsState,
        scene: mi.Scene,
        sensor: mi.Sensor,
        sampler: mi.Sampler,
        active: mi.Bool,
    ) -> Channels:
        """Return colour, alpha and AOVs of the rays, each Float (H * W * count,)."""
        nested = nested_surfaces(splats, scene, sensor, 0, 1)
        # A single sample would average the coverage of edges over their pixels.
        times = 2 if self.count == 1 and nested is not None else 1
        positions = times * self.positions
        view = SensorRender(
            splats, scene, NESTED_VIEW, sensor, positions, key=self, has_alpha=True, nested=nested
        )
        if nested is not None:
            nested = nested.with_surfaces(view.num_surfaces(nested))
            view = replace(view, nested=nested)
        passes = view.channels(view.planes(), constant_background(splats))
        samples = split_samples(self.positions, passes[: len(self.positions)])
        channels = [mi.Float(interleave(list(planes))) for planes in zip(*samples, strict=True)]
        for kind in ("frames", "surfaces"):
            splats.cache.forget(f"{kind} {NESTED_VIEW}")
        if nested is not None:
            channels = self._with_surfaces(channels, nested, sampler, active)
        return channels

    def _with_surfaces(
        self, channels: Channels, nested: NestedSurfaces, sampler: mi.Sampler, active: mi.Bool
    ) -> Channels:
        """Add the nested integrator's radiance along the rays."""
        compositor = nested.compositor
        aovs, own = channels[3 : -len(compositor.channels)], channels[-len(compositor.channels) :]
        behind = own[2 * compositor.num_surfaces :] or [mi.Float(0)] * 3
        images = [*map(list, nested.radiances(self.ray, sampler, active)), behind]
        shown = compositor.visible_radiance(own, images)
        return [*(s + c for s, c in zip(shown, channels[:3], strict=True)), *aovs]


def _look_back(camera: Camera, ray: mi.Ray3f) -> tuple[mi.Point2f, mi.Bool]:
    offset = camera.rotation @ mi.Vector3f(ray.o - mi.Point3f(camera.center))
    direction = camera.rotation @ mi.Vector3f(ray.d)
    place, radius = camera.place_of_ray(offset, direction)
    origin, axis, seen = camera.look_through(place.x, place.y)
    passes_by = dr.norm(dr.cross(offset - origin, direction))
    size = dr.norm(camera.center) + dr.norm(ray.o) + dr.norm(offset - origin)
    near = passes_by <= radius * (1 + PIXEL_MARGIN_PX) + MAX_CENTER_ERROR * size
    return mi.Point2f(place), near & (dr.dot(axis, direction) > 0) & seen


def _require(holds: bool, sensor: mi.Sensor) -> None:
    if not holds:
        raise UnsupportedError(
            "splats: inside 'aov', rays must be those of the whole film, without sample_border, of "
            "a sensor of type perspective, thinlens, orthographic or calibrated that stands still; "
            f"those of {sensor.class_name()} '{sensor.id()}' are not"
        )
