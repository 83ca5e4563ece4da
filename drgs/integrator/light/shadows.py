"""Shadows of surfaces on splats.

Splats have the colours of photographs, without the objects that were put among them. The shadow of
such objects is estimated once for each splat, not for each view: with E the irradiance at its mean
from the scene's emitters, which stand for those of the photographs, and E' that without the
objects, its colour is multiplied by

    f = (E / E')^(1 / 2.2),

in each channel: display-encoded colours are about the 2.2nd root of radiance, and f multiplies the
harmonics. A splat faces along its shortest axis, to both sides. Light is weakened by other splats,
to :data:`MIN_SHADOW_TRANSMITTANCE` at least. Light that objects reflect is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from drgs.core.constants import SH_C0
from drgs.gaussians.parameters import Gaussians, quat_to_rotation
from drgs.integrator.light.rays import StraightRays, has_transparent_parts
from drgs.integrator.light.splat_transport import check_ids, ray_splats_of
from drgs.integrator.light.surfaces import Surfaces, scene_of
from drgs.integrator.state import SplatsState
from drgs.light.walk import RaySplats, Segment
from drgs.splatting.projection import load_rows

GAMMA = 2.2  # exponent of radiance as a function of display values
MIN_SHADOW_TRANSMITTANCE = 1 / 64  # smallest transmittance of splats
EMITTER_SAMPLES = 64  # samples of the scene's emitters for each splat; a pixel averages many splats
MIN_SHADED_SHARE = 1 / 64  # least share of a splat's unoccluded light that objects block
SHADOW_OFFSET_STDS = 3.0  # along the shortest axis: a splat's own alpha does not count


def shade(splats: SplatsState, scene: mi.Scene) -> None:
    """Shade the Gaussians by the objects that cast shadows; PluginError for unknown names."""
    gaussians, cache = dr.detach(splats.gaussians), splats.cache  # not shaded yet
    surfaces = cache.surfaces = Surfaces.find(scene, cache.surfaces)

    def estimate() -> Gaussians:
        shapes = [node for node in surfaces.objects if isinstance(node, mi.Shape)]
        check_ids("shadows must be ids of the scene's shapes", splats.lighting.shadows, shapes)
        rays = _rays_through(surfaces.objects)
        others = [o for o in surfaces.objects if o.id() not in splats.lighting.shadows]
        without = _rays_through(others)
        blocked_by = ray_splats_of(gaussians, splats.approximations, degree=0)
        return _darken(gaussians, _Estimate(rays, without, blocked_by).ratios(gaussians))

    cache.shaded = cache.find("shaded", (surfaces,), gaussians, estimate).value


def _rays_through(objects: list[mi.Object]) -> StraightRays:
    scene = scene_of(objects)
    return StraightRays(scene, False, has_transparent_parts(scene))


@dataclass(frozen=True)
class _Estimate:
    scene: StraightRays
    without: StraightRays
    splats: RaySplats

    def ratios(self, gaussians: Gaussians) -> mi.Color3f:
        """Return E / E' of each Gaussian, at most 1."""
        rows = load_rows(gaussians, sh_degree=0)
        means, normals = mi.Point3f(rows.means), _shortest_axes(rows.quats, rows.log_scales)
        dr.eval(means, normals)
        ratio = dr.ones(mi.Color3f, gaussians.num_gaussians)
        if not self.scene.scene.emitters():
            return ratio
        lit, dark = self._irradiance(means, normals, lambda ray, sample: mi.Float(1))
        shaded = mi.UInt32(dr.compress(dr.max(dark) > MIN_SHADED_SHARE * dr.max(lit + dark)))
        if dr.width(shaded) > 0:
            points = dr.gather(mi.Point3f, means, shaded)
            directions = dr.gather(mi.Vector3f, normals, shaded)
            lit, dark = self._irradiance(points, directions, self._transmittance)
            found = dr.select(lit + dark > 0, lit / (lit + dark), 1)
            dr.scatter(ratio, found, shaded)
        dr.eval(ratio)
        return ratio

    def _irradiance(
        self,
        points: mi.Point3f,
        normals: mi.Vector3f,
        let_through: Callable[[mi.Ray3f, mi.Float], mi.Float],
    ) -> tuple[mi.Color3f, mi.Color3f]:
        scene, sampler = self.scene.scene, mi.load_dict({"type": "independent"})
        sampler.seed(0, dr.width(points))
        place = dr.zeros(mi.SurfaceInteraction3f, dr.width(points))
        place.p = points

        def body(k: mi.UInt32, lit: mi.Color3f, dark: mi.Color3f, sampler: mi.Sampler) -> tuple:
            ds, weight = scene.sample_emitter_direction(place, sampler.next_2d(), False, True)
            cosine = dr.dot(normals, ds.d)  # the normal is as long as the splat is thick
            start = points + SHADOW_OFFSET_STDS * dr.sign(cosine) * normals
            ray = mi.Ray3f(mi.Ray3f(start, ds.d), ds.dist * (1 - mi.math.ShadowEpsilon))
            weight *= dr.abs(cosine) * dr.rcp(dr.norm(normals))
            weight *= let_through(ray, sampler.next_1d())
            passes = self.scene.transmittance(ray, mi.Bool(True))
            held = dr.maximum(self.without.transmittance(ray, passes < 1) - passes, 0)
            lit = lit + passes * weight
            dark = dark + dr.select(passes < 1, held * weight, 0)
            return k + 1, lit, dark, sampler

        zero = dr.zeros(mi.Color3f, dr.width(points))
        state = mi.UInt32(0), zero, mi.Color3f(zero), sampler
        _, lit, dark, _ = dr.while_loop(state, lambda k, *others: k < EMITTER_SAMPLES, body)
        dr.eval(lit, dark)
        return lit, dark

    def _transmittance(self, ray: mi.Ray3f, sample: mi.Float) -> mi.Float:
        """Return MIN_SHADOW_TRANSMITTANCE or 1, with about the transmittance as their mean."""
        segment = Segment(mi.Vector3f(ray.o), mi.Vector3f(ray.d), ray.maxt, dr.full(mi.Bool, True))
        T = self.splats.transmittance(segment, sample)
        return dr.select(sample > T, MIN_SHADOW_TRANSMITTANCE, mi.Float(1))


def _shortest_axes(quats: mi.Vector4f, log_scales: mi.Vector3f) -> mi.Vector3f:
    """Return the shortest axes of splats, as long as their standard deviations."""
    rotation = quat_to_rotation(quats)
    axes = [mi.Vector3f([rotation[row, k] for row in range(3)]) for k in range(3)]
    shortest, thickness = axes[0], log_scales[0]
    for axis, scale in zip(axes[1:], log_scales[1:], strict=True):
        is_shorter = scale < thickness
        shortest = dr.select(is_shorter, axis, shortest)
        thickness = dr.select(is_shorter, scale, thickness)
    return shortest * dr.exp(thickness)


def _darken(gaussians: Gaussians, ratio: mi.Color3f) -> Gaussians:
    """Multiply colours, 0.5 + basis x coefficients, by ratio^(1 / GAMMA)."""
    factor = [dr.power(channel, 1 / GAMMA) for channel in ratio]

    def scale(tensor: mi.TensorXf, of_half: float) -> mi.TensorXf:
        flat, width = tensor.array, tensor.shape[1] * 3
        if width == 0:
            return tensor
        element = dr.arange(mi.UInt32, dr.width(flat))
        row, channel = element // width, element % 3
        f = dr.zeros(mi.Float, dr.width(flat))
        for k, values in enumerate(factor):
            f = dr.select(channel == k, dr.gather(mi.Float, values, row), f)
        return mi.TensorXf(f * flat + (f - 1) * of_half, tensor.shape)

    found = replace(gaussians, sh0=scale(gaussians.sh0, 0.5 / SH_C0), shN=scale(gaussians.shN, 0))
    dr.eval(found.sh0, found.shN)
    return found
