"""Rays that pass straight through surfaces, and segments of paths between them.

The opacity of a surface at a point is the part of light that it does not let pass straight on
(``null``, ``mask``, ``thindielectric``), averaged over red, green and blue. Rays ignore surfaces of
at most :data:`MAX_INVISIBLE_OPACITY`. A sensor whose rays start behind the first k visible surfaces
makes any nested integrator render the light that these let through.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol, TypeVar, runtime_checkable

import drjit as dr
import mitsuba as mi
from typing_extensions import override

from drgs.core.types import Bool, Float

Ray = TypeVar("Ray", bound="mi.Ray3f")

MAX_INVISIBLE_OPACITY = 1e-6  # rounding leaves up to 2e-7 where surfaces are invisible
UNBOUNDED_DEPTH = 0xFFFFFFFF  # ``max_depth`` of Mitsuba's integrators where paths have no limit


def has_transparent_parts(scene: mi.Scene) -> bool:
    """Return whether any BSDF of a scene lets light pass straight on."""
    with dr.suspend_grad():  # values that are read would be new nodes of a graph in use
        nodes = mi.traverse(scene).hierarchy
    bsdfs = (node for node in nodes if isinstance(node, mi.BSDF))
    return any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs)


@dataclass(frozen=True)
class StraightRays:
    """Tracing of rays up to visible surfaces. Keep it out of loop states, which would attach it."""

    scene: mi.Scene
    hide_emitters: bool  # whether surfaces that are emitters are invisible
    sees_through: bool  # whether anything in the scene may let light pass

    def next_visible(
        self, ray: mi.Ray3f, active: mi.Bool
    ) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f, mi.Float]:
        """Return the ray past invisible surfaces, its hit, and the hit's opacity (0 for no hit)."""
        hit, opacity = self._hit(ray, active)
        if not self.sees_through:
            return ray, hit, opacity

        def step(ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, opacity: mi.Float) -> tuple:
            ray = self.continue_rays(ray, hit, mi.Bool(True))
            return ray, *self._hit(ray, mi.Bool(True))

        return dr.while_loop(
            (mi.Ray3f(ray), hit, opacity),
            lambda ray, hit, opacity: hit.is_valid() & (opacity <= MAX_INVISIBLE_OPACITY),
            step,
        )

    def continue_rays(
        self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
    ) -> mi.Ray3f:
        """Return the rest of rays behind their hits; ``ray`` where not active."""
        si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        rest = mi.Ray3f(ray)
        rest.o = dr.select(active, si.spawn_ray(ray.d).o, ray.o)
        rest.maxt = dr.select(active, ray.maxt - hit.t, ray.maxt)
        return rest

    def transmittance(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
        """Return the transmittance, 0..1, of all surfaces up to the rays' ends."""
        if not self.sees_through:
            return dr.select(active & self.scene.ray_test(ray, active), 0, mi.Float(1))

        def pass_surface(ray: mi.Ray3f, T: mi.Float, active: mi.Bool) -> tuple:
            hit, opacity = self._hit(ray, active)
            T = T * (1 - opacity)
            active = active & hit.is_valid() & (T > MAX_INVISIBLE_OPACITY)
            return self.continue_rays(ray, hit, active), T, active

        state = mi.Ray3f(ray), dr.full(mi.Float, 1, dr.width(ray)), mi.Bool(active)
        _, T, _ = dr.while_loop(state, lambda ray, T, active: active, pass_surface)
        return dr.select(T > MAX_INVISIBLE_OPACITY, T, 0)

    def _hit(self, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.PreliminaryIntersection3f, mi.Float]:
        """Return the first hit and its opacity, 0 where nothing is hit."""
        hit = self.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        if not self.sees_through:
            return hit, dr.select(hit.is_valid(), mi.Float(1), 0)
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, hit.is_valid())
        opacity = dr.mean(1 - si.bsdf().eval_null_transmission(si, hit.is_valid()))
        if self.hide_emitters:
            opacity = dr.select(si.shape.is_emitter(), 0, opacity)
        return hit, dr.select(hit.is_valid(), opacity, 0)


@dataclass(frozen=True)
class RaysBehind:
    """Rays behind the first ``count`` visible surfaces, weighted by their transmittance."""

    rays: StraightRays
    count: int

    def advance(self, ray: Ray, active: mi.Bool) -> tuple[Ray, mi.Float]:
        """Return rays, also with differentials, and their weights. Not differentiated."""
        with dr.suspend_grad():
            rest, active = mi.Ray3f(ray), dr.full(mi.Bool, True, dr.width(ray)) & active
            weight = dr.full(mi.Float, 1, dr.width(ray))
            for _ in range(self.count):
                rest, hit, opacity = self.rays.next_visible(rest, active)
                weight *= 1 - opacity
                rest = self.rays.continue_rays(rest, hit, active & hit.is_valid())
            rest, _, _ = self.rays.next_visible(rest, active & (weight > MAX_INVISIBLE_OPACITY))
            offset = rest.o - ray.o
            ray.o, ray.maxt = rest.o, rest.maxt
            if isinstance(ray, mi.RayDifferential3f):
                ray.o_x, ray.o_y = ray.o_x + offset, ray.o_y + offset
            return ray, dr.select(weight > MAX_INVISIBLE_OPACITY, weight, 0)


def sensor_behind(sensor: mi.Sensor, sensors: list[mi.Sensor], behind: RaysBehind) -> mi.Sensor:
    """Return a sensor whose rays start behind surfaces; sensors: the children of a ``batch``."""
    return _sensor_type(mi.variant())(sensor, sensors, behind)


@cache
def _sensor_type(variant: str) -> type:
    del variant

    class SensorBehind(mi.Sensor):
        """Rays of another sensor, from behind the first surfaces on."""

        def __init__(self, sensor: mi.Sensor, sensors: list[mi.Sensor], behind: RaysBehind) -> None:
            props = mi.Properties("behind")
            props["film"], props["sampler"] = sensor.film(), sensor.sampler()
            props["shutter_open"] = sensor.shutter_open()
            props["shutter_close"] = sensor.shutter_open() + sensor.shutter_open_time()
            super().__init__(props)
            self.sensors, self.behind = sensors, behind
            self.m_needs_sample_2 = sensor.needs_sample_2()
            self.m_needs_sample_3 = sensor.needs_sample_3()

        @override
        def sample_ray_differential(
            self,
            time: Float,
            sample1: Float,
            sample2: mi.Point2f,
            sample3: mi.Point2f,
            active: Bool | bool = True,
        ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
            # Not through the batch, whose virtual calls reach all sensors, this one included.
            place, found = sample2.x * len(self.sensors), None
            for k, sensor in enumerate(self.sensors):
                point = mi.Point2f(place - k, sample2.y)
                own = sensor.sample_ray_differential(time, sample1, point, sample3, active)
                found = own if found is None else dr.select(place >= k, own, found)
            assert found is not None, "a batch has sensors"
            ray, passes = self.behind.advance(found[0], mi.Bool(active))
            return ray, found[1] * passes

        def to_string(self) -> str:
            return f"SensorBehind[{self.sensors}]"

    return SensorBehind


@dataclass(frozen=True)
class PathSegment:
    """A segment of a path: from one vertex to the next, or to an emitter."""

    ray: mi.Ray3f  # maxt: the segment's end
    start: mi.ShapePtr  # the shape that it leaves
    end: mi.EmitterPtr  # the emitter that it reaches, or null
    pdf: mi.Float  # of the direction, by solid angle; inf: delta
    is_open: mi.Bool  # whether it leaves a scene without an environment: black is the last splat


class SplatTransport(Protocol):
    """Radiance and transmittance of the splats along segments of paths."""

    def composite_segment(
        self, segment: PathSegment, sample: mi.Float, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        """Return linear radiance and transmittance of segments; sample: in 0..1."""
        ...

    def transmittance(self, segment: PathSegment, sample: mi.Float, active: mi.Bool) -> mi.Float:
        """Return the transmittance of the splats along segments, or an estimate of it."""
        ...


@runtime_checkable
class TransportIntegrator(Protocol):
    """An integrator whose paths can pass splats: ``splatpath``, a class of each variant."""

    def use_transport(self, transport: SplatTransport | None) -> None:
        """Set the splats that paths pass from now on; None: paths pass none."""
