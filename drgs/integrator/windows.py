"""Pictures of what is seen through windows, by any integrator.

Imported when a scene has surfaces that let light pass straight on. A sensor whose rays start behind
the first k visible surfaces has a nested integrator render what these let through.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from drgs.integrator.transparency import INVISIBLE, StraightRays


@dataclass(frozen=True)
class RaysBehind:
    """Rays behind the first ``count`` visible surfaces, and all that is invisible before the next.

    Rays that end at one of these surfaces have the weight 0, others what the surfaces let through.
    """

    rays: StraightRays
    count: int

    def moved(self, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.Ray3f, mi.Float]:
        """Return the rays, which may have differentials, and their weights. Not differentiated."""
        with dr.suspend_grad():
            rest, active = mi.Ray3f(ray), dr.full(mi.Bool, True, dr.width(ray)) & active
            weight = dr.full(mi.Float, 1, dr.width(ray))
            for _ in range(self.count):
                rest, hit, opacity = self.rays.next_visible(rest, active)
                weight *= 1 - opacity
                rest = self.rays.behind(rest, hit, active & hit.is_valid())
            rest, _, _ = self.rays.next_visible(rest, active & (weight > INVISIBLE))
            offset = rest.o - ray.o
            ray.o, ray.maxt = rest.o, rest.maxt
            if isinstance(ray, mi.RayDifferential3f):
                ray.o_x, ray.o_y = ray.o_x + offset, ray.o_y + offset
            return ray, dr.select(weight > INVISIBLE, weight, 0)


def sensor_behind(sensor: mi.Sensor, sensors: Sequence[mi.Sensor], behind: RaysBehind) -> mi.Sensor:
    """Return a sensor with the same film, sampler and rays, which start behind surfaces.

    sensors: those of a ``batch``, side by side; else the sensor itself.
    """
    return _sensor_type(mi.variant())(sensor, sensors, behind)


@cache
def _sensor_type(variant: str) -> type:
    """Return the type of such sensors, which derives from the variant's own."""
    del variant

    class SensorBehind(mi.Sensor):
        """Another sensor's rays, without their beginning."""

        def __init__(
            self, sensor: mi.Sensor, sensors: Sequence[mi.Sensor], behind: RaysBehind
        ) -> None:
            props = mi.Properties("behind")
            props["film"], props["sampler"] = sensor.film(), sensor.sampler()
            props["shutter_open"] = sensor.shutter_open()
            props["shutter_close"] = sensor.shutter_open() + sensor.shutter_open_time()
            super().__init__(props)
            self.sensors, self.behind = sensors, behind
            self.m_needs_sample_2 = sensor.needs_sample_2()
            self.m_needs_sample_3 = sensor.needs_sample_3()

        def sample_ray(
            self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
        ) -> tuple[mi.Ray3f, mi.Spectrum]:
            """See ``mi.Sensor.sample_ray``."""
            ray, weight = self.sample_ray_differential(time, sample1, sample2, sample3, active)
            return mi.Ray3f(ray), weight

        def sample_ray_differential(
            self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
        ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
            """See ``mi.Sensor.sample_ray_differential``."""
            # Not by the batch, whose calls reach all sensors that there are, this one included.
            place, found = sample2.x * len(self.sensors), None
            for k, sensor in enumerate(self.sensors):
                point = mi.Point2f(place - k, sample2.y)
                own = sensor.sample_ray_differential(time, sample1, point, sample3, active)
                found = own if found is None else dr.select(place >= k, own, found)
            ray, passes = self.behind.moved(found[0], mi.Bool(active))
            return ray, found[1] * passes

        def to_string(self) -> str:
            """Return the text that Mitsuba prints."""
            return f"SensorBehind[{self.sensors}]"

    return SensorBehind
