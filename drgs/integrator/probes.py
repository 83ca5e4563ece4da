"""Light between splats and surfaces, looked up in probes (:mod:`drgs.light.probe`).

Imported where a scene asks for it. A probe stands in the middle of an object of the scene: of a
shape, or of an emitter. Rays that start at the object look there; so do rays to an emitter that has
one, from shapes that have none, as far as their transmittance goes. All others pass no splats.

What a ray meets where a probe does not know is said by another light: nothing (:class:`Unlit`), or,
where an object is so close to splats that its middle sees others than its surface does, what rays
pass of the splats themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.accuracy.pipeline import pipeline_of
from drgs.core.errors import PluginError
from drgs.core.private import same_variables
from drgs.integrator.legs import Leg, Light
from drgs.integrator.settings import SplatsSettings
from drgs.light.probe import LEVELS, SIZE, Probes, Seen
from drgs.splatting.rendering import color_features, depth_feature

LOW_PASS = 0.03
"""px^2 of a probe's pictures: rays have none at all."""

NOBODY = 0xFFFFFFFF
"""In place of a probe's number."""


@dataclass(frozen=True, eq=False)
class LightOfProbes:
    """What probes see of a scene's splats."""

    probes: Probes
    exposure: mi.Float  # (1,): factor of the splats' radiance
    shapes: dict[int, mi.ShapePtr]  # that have a probe, by its number
    emitters: dict[int, mi.EmitterPtr]  # likewise
    num_paths: mi.Float  # (1,): of a pixel
    unseen: Light  # for rays of which probes do not know what they meet

    @staticmethod
    def of(
        integrator: SplatsSettings, scene: mi.Scene, num_paths: int, unseen: Light
    ) -> LightOfProbes:
        """Those of an integrator's objects, or the last ones if nothing has changed.

        Raises PluginError for the name of an object that the scene does not have, and for an
        emitter that is nowhere.
        """
        objects = _objects(scene, integrator.probes)
        shapes = {k: node for k, node in enumerate(objects) if isinstance(node, mi.Shape)}
        emitters = {k: shapes[k].emitter() if k in shapes else o for k, o in enumerate(objects)}
        return LightOfProbes(
            _probes(integrator, np.array(list(map(_center, objects)))),
            dr.opaque(mi.Float, integrator.exposure),
            {k: mi.ShapePtr(shape) for k, shape in shapes.items()},
            {k: mi.EmitterPtr(node) for k, node in emitters.items() if node},
            dr.opaque(mi.Float, num_paths),
            unseen,
        )

    def passed(self, leg: Leg, sample: mi.Float, active: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        """See :meth:`drgs.integrator.legs.Light.passed`."""
        seen, is_asked, is_reversed = self._look(leg, active)
        is_known = is_asked & seen.is_known
        radiance, T = self.unseen.passed(leg, sample, is_asked & ~seen.is_known)
        color = mi.Color3f(seen.color)
        color = dr.select(leg.is_open, _over_black(color, seen.coverage), color)
        radiance = dr.select(is_known, self.exposure * color, radiance)
        # An emitter knows how much of its light arrives, but not how splats look from elsewhere.
        radiance = dr.select(is_reversed, 0, radiance)
        return radiance, dr.select(is_known, 1 - seen.coverage, T)

    def transmittance(self, leg: Leg, sample: mi.Float, active: mi.Bool) -> mi.Float:
        """See :meth:`drgs.integrator.legs.Light.transmittance`; 1 where that is not known."""
        seen, is_asked, _ = self._look(leg, active)
        return dr.select(is_asked & seen.is_known, 1 - seen.coverage, 1)

    def _look(self, leg: Leg, active: mi.Bool) -> tuple[Seen, mi.Bool, mi.Bool]:
        """What a probe sees; whether there is one to ask; whether it is that of the other end."""
        probe, other = mi.UInt32(NOBODY), mi.UInt32(NOBODY)
        for k, shape in self.shapes.items():
            probe = dr.select(leg.start == shape, mi.UInt32(k), probe)
        for k, emitter in self.emitters.items():
            other = dr.select(leg.end == emitter, mi.UInt32(k), other)
        is_reversed = active & (probe == NOBODY) & (other != NOBODY)
        is_asked = active & ((probe != NOBODY) | is_reversed)
        ray, far = leg.ray, leg.ray.maxt
        back = dr.select(is_reversed, far, 0)
        seen = self.probes.look(
            dr.select(is_reversed, other, probe),
            mi.Vector3f(ray.o + back * ray.d),
            mi.Vector3f(dr.select(is_reversed, -ray.d, ray.d)),
            mi.Float(far),
            dr.select(is_reversed, 0, self._level(leg.pdf)),
            is_asked,
        )
        return seen, is_asked, is_reversed

    def _level(self, pdf: mi.Float) -> mi.UInt32:
        """Of the cube whose texels are as large as what a path of a pixel stands for."""
        texel = 4 * math.pi / (6 * SIZE**2)
        level = 0.5 * dr.log2(dr.rcp(dr.maximum(pdf * self.num_paths * texel, 1e-20)))
        return mi.UInt32(dr.clip(level + 0.5, 0, LEVELS - 1))


def _probes(integrator: SplatsSettings, centers: np.ndarray) -> Probes:
    """Those at (P, 3) places among an integrator's Gaussians; the last ones if all is the same."""
    gaussians, degree = dr.detach(integrator.gaussians), integrator.sh_degree
    how = (integrator.approximations, degree, integrator.near, centers.tolist())
    last = integrator.memory.probes
    if last is not None and last[0] == how and same_variables(last[1], gaussians):
        return last[2]
    approximations = replace(integrator.approximations, projection="exact", low_pass=LOW_PASS)
    pipeline = pipeline_of(approximations, degree, (color_features, depth_feature))
    probes = Probes.of(gaussians, pipeline, centers, integrator.near, _decoded)
    integrator.memory.probes = (how, gaussians, probes)  # holding Gaussians keeps their indices
    return probes


def _objects(scene: mi.Scene, names: Sequence[str]) -> list[mi.Object]:
    known = {node.id(): node for node in (*scene.emitters(), *scene.shapes())}
    for name in names:
        if name not in known:
            raise PluginError(
                "splats: probes must be ids of the scene's shapes and emitters, got "
                f"{name!r}; there are {', '.join(known)}"
            )
    return [known[name] for name in names]


def _center(node: mi.Object) -> list[float]:
    """World."""
    box = node.bbox()
    if not box.valid():
        raise PluginError(
            f"splats: probes must be ids of shapes and emitters that are somewhere, got "
            f"{node.id()!r}, which is infinitely far away"
        )
    return np.array(box.center(), np.float64).ravel().tolist()


def _over_black(color: mi.Color3f, coverage: mi.Float) -> mi.Color3f:
    """D(C), of A D(C / A) and A: with black as the last splat."""
    display = mi.math.linear_to_srgb(color / dr.select(coverage > 0, coverage, 1))
    return mi.math.srgb_to_linear(coverage * display)


def _decoded(color: list[mi.Float]) -> list[mi.Float]:
    """Linear radiance."""
    return [mi.math.srgb_to_linear(channel) for channel in color]
