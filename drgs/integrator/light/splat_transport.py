"""Light between splats and surfaces, for the integrator ``splatpath``; imported on demand.

Splats have display-encoded colours: a ray's composited colour C with transmittance T is the colour
C / (1 - T) with the coverage 1 - T. Its radiance is

    s (1 - T) lin(C / (1 - T)),

with s the ``radiance_scale``, so that opaque splats look the same in a mirror, and a white fog
before a white wall stays white. Rays that leave a scene without environment end in black: s lin(C).

By default, n splats are drawn with their weights instead of compositing all. Their colours c
estimate the powers of C / (1 - T), without bias: from the sums s_k of c^k,

    m: s_1 / n,   m^2: (s_1^2 - s_2) / (n (n - 1)),
    m^3: (s_1^3 - 3 s_1 s_2 + 2 s_3) / (n (n - 1) (n - 2))

(Hoeffding 1948), of which lin is a sum to within 2e-3 (:data:`DECODING`). The distance that draws
search estimates T independently of the splats drawn: the product of both is without bias as well.
For rays that meet black at last, a draw is black with the probability T.

:class:`ProbeTransport` looks segments up in probes (:mod:`drgs.light.probe`) in the middle of
shapes and emitters: rays that start at the object, and for their transmittance, rays from shapes
without a probe to an emitter with one. All other rays pass no splats. A ray that a probe has no
answer for meets nothing or, with ``probe_fallback``, is traced by :class:`RayTransport`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from typing_extensions import override

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.core.arrays import reinterpret
from drgs.core.errors import PluginError
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.film import decode
from drgs.integrator.light.rays import PathSegment, SplatTransport
from drgs.integrator.sensors import SensorState, camera_from_sensor, read_sensor
from drgs.integrator.state import SplatsState
from drgs.light.probe import CUBE_SIZE_TEXELS, LOW_PASS, NUM_LEVELS, ProbeHit, Probes
from drgs.light.walk import RaySplats, Segment
from drgs.splatting.projection import load_rows
from drgs.splatting.rendering import color_features, depth_feature

if TYPE_CHECKING:
    from drgs.integrator.light.mirrors import FlatMirror, Mirrors
else:  # Dr.Jit evaluates annotations
    Mirrors = object


DECODING = (0.012522878, 0.682171111, 0.305306011)
"""Factors of the first three powers of an encoded colour, whose sum is its linear radiance to
within 2e-3 (Chapman, "sRGB approximations for HLSL", 2012)."""

MIN_DRAWN_SPLATS = 3  # least splats that a ray draws: the third power needs three
ROULETTE_TRANSMITTANCE = 0.25  # to an emitter: below it, Russian roulette ends the search


@dataclass(frozen=True, eq=False)
class RayTransport(SplatTransport):
    """Transport along rays that pass the splats themselves."""

    splats: RaySplats
    radiance_scale: mi.Float  # (1,): factor of the splats' radiance
    num_samples: int  # drawn splats; 0: all are composited

    @staticmethod
    def from_splats(splats: SplatsState) -> RayTransport:
        """Return the transport of an integrator's Gaussians."""
        gaussians = dr.detach(splats.gaussians)
        settings = splats.approximations, splats.sh_degree
        found = splats.cache.find(
            "ray splats", settings, gaussians, lambda: ray_splats_of(gaussians, *settings)
        )
        scale = dr.opaque(mi.Float, splats.lighting.radiance_scale)
        return RayTransport(found.value, scale, splats.lighting.light_samples)

    @override
    def composite_segment(
        self, segment: PathSegment, sample: mi.Float, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        ray = _segment(segment.ray, active)
        if self.num_samples:
            color, coverage = self._composite_sampled(ray, segment.is_open, sample)
        else:
            color, coverage = self._composite_all(ray, segment.is_open)
        return dr.select(active, self.radiance_scale * color, 0), dr.select(active, 1 - coverage, 1)

    def _composite_all(self, segment: Segment, is_open: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        color, T = self.splats.composite_segment(segment)
        return decode(mi.Color3f(color), dr.select(is_open, 1, 1 - T)), 1 - T

    def _composite_sampled(
        self, segment: Segment, is_open: mi.Bool, sample: mi.Float
    ) -> tuple[mi.Color3f, mi.Float]:
        seed, n = reinterpret(mi.UInt32, sample), max(self.num_samples, MIN_DRAWN_SPLATS)
        drawn, exist, T = self.splats.sample_splats(segment, seed, n)
        pairs = zip(drawn, exist, strict=True)
        colors = [dr.select(is_open & ~exists, 0, mi.Color3f(color)) for color, exists in pairs]
        s1, s2, s3 = (sum((color**k for color in colors), mi.Color3f(0)) for k in (1, 2, 3))
        mean = s1 / n
        square = (s1 * s1 - s2) / (n * (n - 1))
        cube = (s1 * s1 * s1 - 3 * s1 * s2 + 2 * s3) / (n * (n - 1) * (n - 2))
        a, b, c = DECODING
        coverage = 1 - T
        whole = dr.select(is_open, 1, coverage)
        return whole * (a * mean + b * square + c * cube), coverage

    @override
    def transmittance(self, segment: PathSegment, sample: mi.Float, active: mi.Bool) -> mi.Float:
        """Estimate the transmittance of the splats along segments.

        Russian roulette below :data:`ROULETTE_TRANSMITTANCE`: a ray of less than ``sample`` (in
        0..1) times that is dark, all others have that transmittance.
        """
        least = sample * ROULETTE_TRANSMITTANCE
        T = self.splats.transmittance(_segment(segment.ray, active), least)
        T = dr.select(least > T, 0, dr.maximum(T, ROULETTE_TRANSMITTANCE))
        return dr.select(active, T, 1)


def ray_splats_of(gaussians: Gaussians, approximations: Approximations, degree: int) -> RaySplats:
    """Prepare Gaussians for rays, their smoothing filter included."""
    rows = load_rows(gaussians, degree)
    if rows.smoothing is not None:
        from drgs.effects.smoothing import apply_smoothing

        rows = apply_smoothing(rows)
    return RaySplats.from_gaussians(rows, degree, pipeline_of(approximations, degree).model.cutoffs)


def transport_of(
    splats: SplatsState, scene: mi.Scene, num_paths: int, sensors: Sequence[mi.Sensor]
) -> SplatTransport:
    """Return the transport of an integrator's light; num_paths: per pixel; sensors: rendered."""
    if splats.lighting.light == "rays":
        return RayTransport.from_splats(splats)
    return ProbeTransport.from_splats(splats, scene, num_paths, sensors)


def _segment(ray: mi.Ray3f, active: mi.Bool) -> Segment:
    return Segment(mi.Vector3f(ray.o), mi.Vector3f(ray.d), mi.Float(ray.maxt), mi.Bool(active))


MIN_PROBE_DISTANCE = 1.25  # of splats without a warning, in halves of the object's size
NO_PROBE = 0xFFFFFFFF  # number of a missing probe


@dataclass(frozen=True, eq=False)
class ProbeTransport(SplatTransport):
    """Transport along rays that are looked up in probes."""

    probes: Probes
    mirrors: Mirrors | None  # images of flat mirrors; None: there are none
    radiance_scale: mi.Float  # (1,): factor of the splats' radiance
    shapes: dict[int, mi.ShapePtr]  # by number of their probe
    emitters: dict[int, mi.EmitterPtr]  # by number of their probe
    flat: dict[int, int]  # numbers of mirrors, by number of their probe
    num_paths: mi.Float  # (1,): per pixel
    fallback: SplatTransport | None  # for rays that probes have no answer for

    @staticmethod
    def from_splats(
        splats: SplatsState, scene: mi.Scene, num_paths: int, sensors: Sequence[mi.Sensor]
    ) -> ProbeTransport:
        """Return the transport by probes; sensors: of flat mirrors. PluginError for unknown ids."""
        nodes: list[mi.Emitter | mi.Shape] = [*scene.emitters(), *scene.shapes()]
        names, known = splats.lighting.probes, {node.id(): node for node in nodes}
        check_ids("probes must be ids of the scene's shapes and emitters", names, nodes)
        objects = [known[name] for name in names]
        shapes = {k: node for k, node in enumerate(objects) if isinstance(node, mi.Shape)}
        emitters = {k: shapes[k].emitter() if k in shapes else o for k, o in enumerate(objects)}
        states = [read_sensor(sensor, splats.near).detach() for sensor in sensors]
        flat = _flat_mirrors(splats, shapes)
        delta_mirrors = {k: mirror for k, mirror in flat.items() if mirror.has_delta}
        return ProbeTransport(
            _probes(splats, objects, flat, states[0]),
            _mirror_images(splats, scene, list(delta_mirrors.values()), states),
            dr.opaque(mi.Float, splats.lighting.radiance_scale),
            {k: mi.ShapePtr(shape) for k, shape in shapes.items()},
            {k: mi.EmitterPtr(node) for k, node in emitters.items() if node},
            {k: number for number, k in enumerate(delta_mirrors)},
            dr.opaque(mi.Float, num_paths),
            RayTransport.from_splats(splats) if splats.lighting.probe_fallback == "rays" else None,
        )

    @override
    def composite_segment(
        self, segment: PathSegment, sample: mi.Float, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        seen, is_asked, is_reversed = self._look(segment, active)
        is_known = is_asked & seen.is_known
        radiance, T = mi.Color3f(0), mi.Float(1)
        if self.fallback is not None:
            unknown = is_asked & ~seen.is_known
            radiance, T = self.fallback.composite_segment(segment, sample, unknown)
        color = mi.Color3f(seen.color)
        # Before black as the last splat: D(C), given A D(C / A) and A.
        display = mi.math.linear_to_srgb(color / dr.select(seen.coverage > 0, seen.coverage, 1))
        over_black = mi.math.srgb_to_linear(seen.coverage * display)
        color = dr.select(segment.is_open, over_black, color)
        radiance = dr.select(is_known, self.radiance_scale * color, radiance)
        # An emitter's probe has transmittances of its light, but no view of splats from elsewhere.
        radiance = dr.select(is_reversed, 0, radiance)
        return radiance, dr.select(is_known, 1 - seen.coverage, T)

    @override
    def transmittance(self, segment: PathSegment, sample: mi.Float, active: mi.Bool) -> mi.Float:
        seen, is_asked, _ = self._look(segment, active)
        return dr.select(is_asked & seen.is_known, 1 - seen.coverage, 1)

    def _look(self, segment: PathSegment, active: mi.Bool) -> tuple[ProbeHit, mi.Bool, mi.Bool]:
        """Look up segments: result, whether they have a probe, whether it is their end's."""
        probe, other = mi.UInt32(NO_PROBE), mi.UInt32(NO_PROBE)
        for k, shape in self.shapes.items():
            probe = dr.select(segment.start == shape, mi.UInt32(k), probe)
        for k, emitter in self.emitters.items():
            other = dr.select(segment.end == emitter, mi.UInt32(k), other)
        is_reversed = active & (probe == NO_PROBE) & (other != NO_PROBE)
        is_asked = active & ((probe != NO_PROBE) | is_reversed)
        mirrored = self._look_in_mirrors(probe, segment, is_asked)
        ray, far = segment.ray, segment.ray.maxt
        back = dr.select(is_reversed, far, 0)
        seen = self.probes.look(
            dr.select(is_reversed, other, probe),
            mi.Vector3f(ray.o + back * ray.d),
            mi.Vector3f(dr.select(is_reversed, -ray.d, ray.d)),
            mi.Float(far),
            dr.select(is_reversed, 0, self._level(segment.pdf)),
            is_asked & ~mirrored.is_known,
        )
        color = dr.select(mirrored.is_known, mirrored.color, seen.color)
        coverage = dr.select(mirrored.is_known, mirrored.coverage, seen.coverage)
        seen = ProbeHit(color, coverage, seen.is_known | mirrored.is_known)
        return seen, is_asked, is_reversed

    def _look_in_mirrors(self, probe: mi.UInt32, segment: PathSegment, active: mi.Bool) -> ProbeHit:
        """Look up segments that leave flat mirrors; probe: of the shape that they leave."""
        if self.mirrors is None:
            return ProbeHit(mi.Color3f(0), mi.Float(0), mi.Bool(False))
        mirror = mi.UInt32(NO_PROBE)
        for k, number in self.flat.items():
            mirror = dr.select(probe == k, mi.UInt32(number), mirror)
        return self.mirrors.look(mirror, segment, active & (mirror != NO_PROBE))

    def _level(self, pdf: mi.Float) -> mi.UInt32:
        texel = 4 * math.pi / (6 * CUBE_SIZE_TEXELS**2)
        level = 0.5 * dr.log2(dr.rcp(dr.maximum(pdf * self.num_paths * texel, 1e-20)))
        return mi.UInt32(dr.clip(level + 0.5, 0, NUM_LEVELS - 1))


def _probes(
    splats: SplatsState,
    objects: Sequence[mi.Emitter | mi.Shape],
    flat: dict[int, FlatMirror],
    sensor: SensorState,
) -> Probes:
    """Render the probes of objects; flat: mirrors by the probe's number; sensor: the first one."""
    gaussians, (centers, planes) = dr.detach(splats.gaussians), _places(objects, flat, sensor)

    def render() -> Probes:
        approximations = replace(splats.approximations, projection="exact", low_pass=LOW_PASS)
        pipeline = pipeline_of(approximations, splats.sh_degree, (color_features, depth_feature))
        if gaussians.smoothing is not None:
            from drgs.effects.smoothing import apply_smoothing

            pipeline = replace(pipeline, rows=apply_smoothing)
        linear = mi.math.srgb_to_linear
        probes = Probes.render(gaussians, pipeline, centers, splats.near, linear, planes)
        _warn_of_close(splats, objects, flat, probes)
        return probes

    places = centers.tolist(), planes.tolist()
    settings = splats.approximations, splats.sh_degree, splats.near, places
    return splats.cache.find("probes", settings, gaussians, render).value


def _warn_of_close(
    splats: SplatsState,
    objects: Sequence[mi.Emitter | mi.Shape],
    flat: dict[int, FlatMirror],
    probes: Probes,
) -> None:
    """Log a warning for each shape that is too close to splats, once."""
    close = {
        node.id()
        for k, node in enumerate(objects)
        if isinstance(node, mi.Shape)
        and not (k in flat and (flat[k].has_delta or flat[k].is_specular))
        and probes.nearest[k] < MIN_PROBE_DISTANCE * float(dr.max(node.bbox().extents())) / 2
    }
    for name in sorted(close - splats.cache.too_close):
        message = (
            f"splats: '{name}' has splats so close to its surface that the probe at its centre is "
            "inaccurate; compare with light 'rays'"
        )
        mi.Log(mi.LogLevel.Warn, message)  # pyright: ignore[reportCallIssue]  no type in the stub
    splats.cache.too_close |= close


def _flat_mirrors(splats: SplatsState, shapes: dict[int, mi.Shape]) -> dict[int, FlatMirror]:
    """Return flat mirrors among the shapes, by the probe's number."""
    from drgs.integrator.light.mirrors import FlatMirror

    def recognise() -> dict[int, FlatMirror]:
        every = {k: FlatMirror.from_shape(shape) for k, shape in shapes.items()}
        return {k: mirror for k, mirror in every.items() if mirror is not None}

    return splats.cache.find("flat mirrors", (splats.cache.surfaces,), (), recognise).value


def _mirror_images(
    splats: SplatsState, scene: mi.Scene, mirrors: list[FlatMirror], states: list[SensorState]
) -> Mirrors | None:
    from drgs.integrator.light.mirrors import Mirrors

    gaussians, surfaces = dr.detach(splats.gaussians), splats.cache.surfaces
    if not mirrors or surfaces is None:
        return None
    how = splats.approximations, splats.sh_degree
    return splats.cache.find(
        "mirrors",
        (surfaces, *how, *(state.settings for state in states)),
        (gaussians, [state.device for state in states]),
        lambda: Mirrors.render(mirrors, states, surfaces.scene_to_trace(scene), gaussians, *how),
    ).value


def _places(
    objects: Sequence[mi.Emitter | mi.Shape], flat: dict[int, FlatMirror], sensor: SensorState
) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (P, 3) of the objects' probes, and planes (P, 4) beyond which they see.

    A specular flat mirror's probe is at the first camera's mirror image, near which its rays pass.
    """
    centers, planes = np.array(list(map(_center, objects))), np.zeros((len(objects), 4))
    specular = {k: mirror for k, mirror in flat.items() if mirror.is_specular}
    if specular:
        camera = np.array(camera_from_sensor(sensor).center, np.float64).ravel()
        for k, mirror in specular.items():
            centers[k], planes[k] = mirror.mirror_camera(camera)
    return centers, planes


def check_ids(parameter: str, names: Sequence[str], nodes: Sequence[mi.Object]) -> None:
    """Raise PluginError for names that are no node's id; parameter: the property, in words."""
    known = [node.id() for node in nodes]
    for name in names:
        if name not in known:
            message = f"splats: {parameter}, got {name!r}; there are {', '.join(known)}"
            if any(isinstance(node, mi.Mesh) and not node.id() for node in nodes):
                message += (
                    "; Mitsuba merges meshes with equal BSDFs, which then have no id: load the "
                    "scene with optimize=False"
                )
            raise PluginError(message)


def _center(node: mi.Emitter | mi.Shape) -> list[float]:
    box = node.bbox()
    if not box.valid():
        raise PluginError(
            f"splats: probes must be ids of shapes and emitters that are somewhere, got "
            f"{node.id()!r}, which is infinitely far away"
        )
    return np.array(box.center(), np.float64).ravel().tolist()
