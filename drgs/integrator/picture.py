"""One picture of the integrator ``splats``: what its sensor sees, as channels of the film.

A :class:`Picture` has a :class:`View` for each sensor, which are several only for a batch. A view
renders frames (``drgs.splatting.rendering``), one for each time at which its shutter is open and
each pass of samples; puts what is behind the splats behind them; and gives the film its channels.
The film develops these (``drgs.integrator.film``), and a nested integrator's picture of surfaces
comes in between (``drgs.integrator.surfaces``). :meth:`Picture.backward` and
:meth:`Picture.tangent` run the same way back and along.

Frames are reused while nothing that they depend on has changed: ``mi.render`` calls ``render`` and,
later, ``render_backward`` on the same integrator, with other pictures possibly in between.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from drgs.gaussians.parameters import Gaussians
from drgs.integrator.film import CenterSamples, FilmSamples
from drgs.integrator.limits import check_picture
from drgs.integrator.sensors import is_batch, num_poses
from drgs.integrator.settings import LitIntegrator, SplatsSettings
from drgs.integrator.view import Planes, View, constant_background
from drgs.splatting import rendering

if TYPE_CHECKING:  # imported where a scene calls for them
    from drgs.integrator.batch import SideBySide
    from drgs.integrator.surfaces import Hybrid


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture of a sensor, by view."""

    views: list[View]
    samples: FilmSamples
    hybrid: Hybrid | None  # None: there are splats alone
    batch: SideBySide | None = None  # for several views

    @staticmethod
    def of(
        integrator: SplatsSettings,
        scene: mi.Scene,
        sensor: mi.Sensor,
        seed: int | mi.UInt32,
        spp: int,
    ) -> Picture:
        """Where the sensor's pixels are evaluated, and how its film develops them.

        seed, spp: as ``mi.render`` has them; 0 samples per pixel: those of the sensor's sampler.
        """
        hybrid = hybrid_of(integrator, scene, sensor, seed, spp)
        names = integrator.aov_names()
        film, spp = sensor.film(), spp or sensor.sampler().sample_count()
        poses = 1 if "motion" in integrator.ignore else max(map(num_poses, sensors_of(sensor)))
        nested_spp = 0 if hybrid is None else hybrid.spp or spp
        check_picture(film, spp, poses, len(names), nested_spp)
        maps = integrator.memory.film_maps
        if spp == 1 and film.rfilter().is_box_filter():
            samples = CenterSamples(film, maps, names)
        else:
            from drgs.integrator.sampling import DrawnSamples

            samples = DrawnSamples(sensor, seed, spp, maps, names)
        whole = View(
            integrator=integrator,
            scene=scene,
            index=0,
            sensor=sensor,
            positions=samples.positions,
            within=samples.within,
            key=samples.key,
            has_alpha=mi.has_flag(film.flags(), mi.FilmFlags.Alpha),
            hybrid=hybrid,
        )
        if not is_batch(sensor):
            return Picture([whole], samples, hybrid)._with_surfaces()
        from drgs.integrator.batch import SideBySide

        batch = SideBySide.of(sensor)
        views = [
            replace(
                whole,
                index=index,
                sensor=one,
                positions=batch.positions(whole.positions, index),
                within=batch.within(whole.within, index),
            )
            for index, one in enumerate(batch.sensors)
        ]
        return Picture(views, samples, hybrid, batch)._with_surfaces()

    def _with_surfaces(self) -> Picture:
        """Return the same with channels for all surfaces that are seen one through the other."""
        if self.hybrid is None:
            return self
        hybrid = self.hybrid.with_surfaces(max(view.num_surfaces() for view in self.views))
        self.samples.aovs += hybrid.insertion.channels
        return replace(self, views=[replace(v, hybrid=hybrid) for v in self.views], hybrid=hybrid)

    def image(self) -> mi.TensorXf:
        """The developed picture."""
        image = self._image_of_splats()
        if self.hybrid is None:
            return image
        return self.hybrid.insertion.develop(image, self.hybrid.pictures())

    def backward(self, params: object, grad_in: mi.TensorXf) -> rendering.GaussianGradients:
        """Derivatives with respect to the Gaussians; all others are accumulated.

        params: as ``mi.render`` has them; grad_in: derivative of the loss with respect to the
        image.
        """
        if self.hybrid is not None:
            own, nested = self._image_of_splats(), self.hybrid.pictures()
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
        """Directional derivative of the image.

        tangents: of the Gaussians; those of all other parameters are set on them.
        """
        integrator = self.views[0].integrator
        d_planes = [view.plane_tangents(tangents) for view in self.views]
        planes = [view.planes() for view in self.views]
        dr.eval(planes, d_planes)
        with dr.resume_grad():
            constant = constant_background(integrator)
            dr.enable_grad(planes, constant)
            dr.set_grad(planes, d_planes)
            if constant is not None:
                dr.set_grad(constant, dr.grad(integrator.background))
            image = self._developed(planes, constant)
            # The nested integrator, and other pictures of the same pass, read the gradients of
            # parameters again, also of those that are computed from others.
            dr.forward_to(image, flags=dr.ADFlag.ClearEdges)
            d_image = dr.grad(image)
        if self.hybrid is None:
            return d_image
        nested = self.hybrid.pictures()
        d_nested = self.hybrid.tangents(params, nested)
        return self.hybrid.insertion.tangent(dr.detach(image), nested, d_image, d_nested)

    def _image_of_splats(self) -> mi.TensorXf:
        """For a hybrid picture, with the channels that the insertion needs."""
        constant = constant_background(self.views[0].integrator)
        return self._developed([view.planes() for view in self.views], constant)

    def _developed(self, planes: list[Planes], constant: mi.Color3f | None) -> mi.TensorXf:
        """planes: by view."""
        pictures = [v.channels(p, constant) for v, p in zip(self.views, planes, strict=True)]
        passes = pictures[0] if self.batch is None else self.batch.put_together(pictures)
        return self.samples.develop(passes)


def hybrid_of(
    integrator: SplatsSettings,
    scene: mi.Scene,
    sensor: mi.Sensor,
    seed: int | mi.UInt32,
    spp: int,
) -> Hybrid | None:
    """The part that surfaces take in a picture; None where there are none."""
    if all(shape.is_ellipsoids() for shape in scene.shapes()):
        return None
    from drgs.integrator.surfaces import Hybrid, Insertion, Surfaces
    from drgs.integrator.transparency import StraightRays

    memory, hide_emitters = integrator.memory, integrator.hide_emitters
    surfaces = memory.surfaces = Surfaces.of(scene, memory.surfaces)
    if integrator.light == "none":
        nested = adjoint = integrator.nested
        if nested is None:
            # The same paths, whose derivatives are right for more of their parameters, and which
            # see lamps through what lets light pass straight on.
            adjoint = mi.load_dict({"type": "splatpath", "hide_emitters": hide_emitters})
            nested = adjoint
            if not surfaces.is_transparent:
                nested = mi.load_dict({"type": "path", "hide_emitters": hide_emitters})
        if isinstance(nested, LitIntegrator):  # that another integrator may have lit
            nested.light = None
    else:
        from drgs.integrator.light import lit

        num_paths = integrator.nested_spp or spp or sensor.sampler().sample_count()
        nested = adjoint = lit(integrator, scene, num_paths, sensors_of(sensor))
    insertion = Insertion(
        sensor.film(),
        memory.film_maps,
        integrator.aov_names(),
        shows_background=not hide_emitters and scene.environment() is not None,
        display_space=not integrator.srgb_primitives,
    )
    traced, count = surfaces.traced(scene), integrator.nested_spp or spp
    rays = StraightRays(traced, hide_emitters, hide_emitters or surfaces.is_transparent)
    sensors = sensors_of(sensor)
    return Hybrid(traced, surfaces, nested, adjoint, sensor, sensors, seed, count, insertion, rays)


def sensors_of(sensor: mi.Sensor) -> list[mi.Sensor]:
    """Those of a batch, or the one."""
    if not is_batch(sensor):
        return [sensor]
    from drgs.integrator.batch import SideBySide

    return SideBySide.of(sensor).sensors
