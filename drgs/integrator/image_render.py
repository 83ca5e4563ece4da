"""An image of the integrator ``splats``: its sensors, and the channels of the film.

An :class:`ImageRender` has a :class:`SensorRender` for each sensor of a ``batch``, or one. The film
develops their channels (``drgs.integrator.film``), and a nested integrator's image of surfaces is
inserted (``drgs.integrator.surfaces``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from drgs.gaussians.parameters import Gaussians
from drgs.integrator.checks import check_image
from drgs.integrator.film import CenterSamples
from drgs.integrator.light.rays import TransportIntegrator
from drgs.integrator.sensor_render import Planes, SensorRender, constant_background
from drgs.integrator.sensors import is_batch, num_poses, sensors_of
from drgs.integrator.state import SplatsState
from drgs.splatting import rendering

if TYPE_CHECKING:  # imported where a scene requires them
    from drgs.integrator.sensors import SideBySide
    from drgs.integrator.surfaces import Hybrid


@dataclass(frozen=True, eq=False)
class ImageRender:
    """An image of one sensor, or of several side by side."""

    views: list[SensorRender]
    samples: CenterSamples
    hybrid: Hybrid | None  # the surfaces; None: the scene has none
    batch: SideBySide | None = None  # for several views

    @staticmethod
    def prepare(
        splats: SplatsState, scene: mi.Scene, sensor: mi.Sensor, seed: int | mi.UInt32, spp: int
    ) -> ImageRender:
        """Choose sample positions; spp: 0 for that of the sensor's sampler."""
        hybrid = hybrid_of(splats, scene, sensor, seed, spp)
        names = splats.aov_names()
        film, spp = sensor.film(), spp or sensor.sampler().sample_count()
        poses = 1 if "motion" in splats.ignore else max(map(num_poses, sensors_of(sensor)))
        nested_spp = 0 if hybrid is None else hybrid.spp or spp
        check_image(film, spp, poses, len(names), nested_spp)
        maps = splats.cache.film_maps
        if spp == 1 and film.rfilter().is_box_filter():
            samples = CenterSamples(film, maps, names)
        else:
            from drgs.integrator.film import DrawnSamples

            samples = DrawnSamples(sensor, seed, spp, maps, names)
        whole = SensorRender(
            splats=splats,
            scene=scene,
            index=0,
            sensor=sensor,
            positions=samples.positions,
            key=samples.key,
            has_alpha=mi.has_flag(film.flags(), mi.FilmFlags.Alpha),
            hybrid=hybrid,
        )
        if not is_batch(sensor):
            return ImageRender([whole], samples, hybrid)._with_surfaces()
        from drgs.integrator.sensors import SideBySide

        batch = SideBySide.from_batch(sensor)
        views = [
            replace(
                whole, index=index, sensor=one, positions=batch.positions(whole.positions, index)
            )
            for index, one in enumerate(batch.sensors)
        ]
        return ImageRender(views, samples, hybrid, batch)._with_surfaces()

    def _with_surfaces(self) -> ImageRender:
        if self.hybrid is None:
            return self
        count = max(view.num_surfaces(self.hybrid) for view in self.views)
        hybrid = self.hybrid.with_surfaces(count)
        self.samples.aovs += hybrid.insertion.channels
        return replace(self, views=[replace(v, hybrid=hybrid) for v in self.views], hybrid=hybrid)

    def image(self) -> mi.TensorXf:
        """Return the developed image."""
        image = self._image_of_splats()
        if self.hybrid is None:
            return image
        return self.hybrid.insertion.develop(image, self.hybrid.images())

    def backward(self, params: object, grad_in: mi.TensorXf) -> rendering.GaussianGradients:
        """Return derivatives with respect to the Gaussians; accumulate all others."""
        d_nested: list[mi.TensorXf] = []
        if self.hybrid is not None:
            own, nested = self._image_of_splats(), self.hybrid.images()
            grad_in, d_nested = self.hybrid.insertion.adjoint(own, nested, grad_in)
        d_passes = self.samples.adjoint(grad_in)
        gradients = [
            view.backward(d_passes if self.batch is None else self.batch.cut(d_passes, view.index))
            for view in self.views
        ]
        if self.hybrid is not None:
            self.hybrid.backward(params, d_nested)
        return reduce(rendering.sum_of_gradients, gradients)

    def tangent(self, params: object, tangents: Gaussians) -> mi.TensorXf:
        """Return the directional derivative; tangents: of the Gaussians."""
        splats = self.views[0].splats
        d_planes = [view.plane_tangents(tangents) for view in self.views]
        planes = [view.planes() for view in self.views]
        dr.eval(planes, d_planes)
        with dr.resume_grad():
            constant = constant_background(splats)
            dr.enable_grad(planes, constant)
            dr.set_grad(planes, d_planes)
            if constant is not None:
                dr.set_grad(constant, dr.grad(splats.background))
            image = self._develop(planes, constant)
            # Keep vertices: the nested integrator and other images read the gradients again.
            dr.forward_to(image, flags=dr.ADFlag.ClearEdges)
            d_image = dr.grad(image)
        if self.hybrid is None:
            return d_image
        nested = self.hybrid.images()
        d_nested = self.hybrid.tangents(params, nested)
        return self.hybrid.insertion.tangent(dr.detach(image), nested, d_image, d_nested)

    def _image_of_splats(self) -> mi.TensorXf:
        constant = constant_background(self.views[0].splats)
        return self._develop([view.planes() for view in self.views], constant)

    def _develop(self, planes: list[Planes], constant: mi.Color3f | None) -> mi.TensorXf:
        images = [v.channels(p, constant) for v, p in zip(self.views, planes, strict=True)]
        passes = images[0] if self.batch is None else self.batch.concatenate(images)
        return self.samples.develop(passes)


def hybrid_of(
    splats: SplatsState, scene: mi.Scene, sensor: mi.Sensor, seed: int | mi.UInt32, spp: int
) -> Hybrid | None:
    """Return the surfaces in an image; None where the scene has none."""
    if all(shape.is_ellipsoids() for shape in scene.shapes()):
        return None
    from drgs.integrator.light.rays import StraightRays
    from drgs.integrator.surfaces import Hybrid, Insertion, Surfaces

    cache, hide_emitters = splats.cache, splats.hide_emitters
    surfaces = cache.surfaces = Surfaces.find(scene, cache.surfaces)
    nested: mi.SamplingIntegrator
    adjoint: mi.SamplingIntegrator
    if splats.light == "none":
        if splats.nested is not None:
            nested = adjoint = splats.nested
        else:
            # The same paths as ``path``, with correct derivatives for more parameters, and lamps
            # seen through transparent surfaces.
            adjoint = mi.load_dict({"type": "splatpath", "hide_emitters": hide_emitters})
            nested = adjoint
            if not surfaces.is_transparent:
                nested = mi.load_dict({"type": "path", "hide_emitters": hide_emitters})
        if isinstance(nested, TransportIntegrator):
            nested.use_transport(None)  # another integrator may have given it one
    else:
        from drgs.integrator.light.splat_transport import nested_with_transport

        num_paths = splats.nested_spp or spp or sensor.sampler().sample_count()
        nested = adjoint = nested_with_transport(splats, scene, num_paths, sensors_of(sensor))
    insertion = Insertion(
        sensor.film(),
        cache.film_maps,
        splats.aov_names(),
        shows_background=not hide_emitters and scene.environment() is not None,
        display_space=not splats.srgb_primitives,
    )
    traced, count = surfaces.scene_to_trace(scene), splats.nested_spp or spp
    rays = StraightRays(traced, hide_emitters, hide_emitters or surfaces.is_transparent)
    return Hybrid(surfaces, nested, adjoint, sensor, seed, count, insertion, rays)
