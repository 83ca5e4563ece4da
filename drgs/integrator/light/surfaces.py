"""Meshes and other surfaces among splats; imported when a scene has surfaces.

A nested integrator, such as Mitsuba's ``path``, renders them at the depths of the surfaces in each
pixel, between the splats (:mod:`drgs.integrator.light.visible_surfaces`).
With p_k the part of the light that the k-th surface stops, T_k the transmittance of the splats in
front of it, T that of all splats, L_k the surface's radiance, B the background, and C and A the
sums of the colours and weights of the splats as far as surfaces let them through
(``drgs.effects.occlusion``), a pixel is

    A D(C / A) + sum_k T_k L_k + T (1 - sum_k p_k) B.

With N_k the nested image from behind the first k surfaces, times their transmittance
(``drgs.integrator.light.rays``), L_k = N_(k - 1) - N_k. Behind the last surface, N_k is
(1 - sum_k p_k) B where the nested integrator shows the background, and else 0.

Not differentiated: the depth of a surface, the part of a pixel that it covers, its silhouette.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.core.arrays import image_of, planes_of
from drgs.core.errors import PluginError, UnsupportedError, format_names, one_line, root_cause
from drgs.core.private import same_variables
from drgs.integrator.film import Channels, develop_pixels, film_map, num_colors, pixels_adjoint
from drgs.integrator.light.derivatives import (
    Parameter,
    attached_parameters,
    parameter_value,
    type_of,
)
from drgs.integrator.light.rays import (
    UNBOUNDED_DEPTH,
    RaysBehind,
    StraightRays,
    TransportIntegrator,
    has_transparent_parts,
    sensor_behind,
)
from drgs.integrator.light.visible_surfaces import SurfaceLayers, transmittance_behind
from drgs.integrator.sensors import sensors_of
from drgs.integrator.state import SplatsState, surfaces_in

T = TypeVar("T")

INDEPENDENT = ("does not depend", "nothing that a path meets changes")
"""Words of Dr.Jit's and ``splatpath``'s errors for an image that no parameter changes."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The surfaces of a scene, and everything that they depend on.

    It holds no scene with the integrator that keeps it: neither would ever be freed.
    """

    objects: list[mi.Object]  # of the scene, without its Gaussians and integrator
    parameters: list[object]  # of these, detached: held, so that equal indices mean equal values
    apart: mi.Scene | None  # a scene of the objects, where the original one has Gaussians
    is_transparent: bool  # whether anything lets light pass straight on

    @staticmethod
    def find(scene: mi.Scene, last: Surfaces | None) -> Surfaces:
        """Find the surfaces of a scene, or return ``last`` if they are still the same."""
        objects, parameters = _surroundings(scene)
        has_gaussians = len(surfaces_in(scene)) < len(scene.shapes())
        if (
            last is not None
            and (last.apart is not None) == has_gaussians
            and list(map(id, last.objects)) == list(map(id, objects))
            and _same(last.parameters, parameters)
        ):
            return last
        apart = scene_of(objects) if has_gaussians else None
        return Surfaces(objects, dr.detach(parameters), apart, has_transparent_parts(scene))

    def scene_to_trace(self, scene: mi.Scene) -> mi.Scene:
        """Return the scene that the nested integrator renders; scene: the original one."""
        return scene if self.apart is None else self.apart


def _surroundings(scene: mi.Scene) -> tuple[list[mi.Object], list[object]]:
    """Return a scene's objects but Gaussians and integrators, and parameters of all but sensors."""
    params = mi.traverse(scene)
    objects, left_out = [], set()  # shape groups included: instances do not list what they repeat
    for node, (parent, depth) in params.hierarchy.items():
        is_gaussians = isinstance(node, mi.Shape) and node.is_ellipsoids()
        if parent in left_out or isinstance(node, mi.Integrator) or is_gaussians:
            left_out.add(node)
        elif depth == 1:
            objects.append(node)
            if isinstance(node, mi.Sensor):
                left_out.add(node)
    names = [name for name, (_, _, node, _) in params.properties.items() if node not in left_out]
    return objects, [parameter_value(params, name) for name in names]


def _same(parameters: list[object], others: list[object]) -> bool:
    """Return whether arrays are the same variables, and everything else has the same value."""
    on_host = [[v for v in of if not dr.is_array_v(v)] for of in (parameters, others)]
    return on_host[0] == on_host[1] and same_variables(parameters, dr.detach(others))


def scene_of(objects: list[mi.Object]) -> mi.Scene:
    """Build a scene of the same objects, which keep their parameters and names."""
    names = [node.id() for node in objects]
    scene = mi.load_dict({"type": "scene", **{f"object_{k}": o for k, o in enumerate(objects)}})
    for node, name in zip(objects, names, strict=True):
        node.set_id(name)
    return scene


@dataclass(frozen=True)
class SurfaceCompositor:
    """Compositing of nested images with the image of the splats; all are developed already.

    The last channels of the splats' image are, for each surface, its share p_k T_k and coverage
    p_k, and where the nested image shows a background, (1 - sum p_k) B in linear RGB.
    """

    film: mi.Film
    maps: dict[str, np.ndarray]  # see drgs.integrator.film
    aovs: Sequence[str]  # of the user
    shows_background: bool
    display_space: bool  # of the splats' image; the nested one is linear
    num_surfaces: int = 1  # seen one through the other

    @property
    def channels(self) -> list[str]:
        """Names of the last channels of the splats' image."""
        names = ["share", "coverage"] * self.num_surfaces + ["R", "G", "B"] * self.shows_background
        return [f"surface.{k}.{name}" for k, name in enumerate(names)]

    def values(
        self, layers: SurfaceLayers, fronts: Sequence[mi.Float], radiance: mi.Color3f | None
    ) -> Channels:
        """Return a pass's last channels; fronts: sums of weights before surfaces; radiance: B."""
        values = []
        for surface, front in zip(layers, fronts, strict=True):
            values += [surface.share(front), surface.coverage]
        nothing = dr.zeros(mi.Float, dr.width(layers[0].coverage))
        values += [nothing] * (2 * (self.num_surfaces - len(layers)))
        if self.shows_background:
            assert radiance is not None, "of the background"
            values += list(transmittance_behind(layers) * radiance)
        return values

    def develop(self, image: mi.TensorXf, nested: list[mi.TensorXf]) -> mi.TensorXf:
        """Develop the complete image, which the film then holds."""
        channels = self._insert(planes_of(image), [planes_of(each) for each in nested])
        return develop_pixels(self.film, channels, self.aovs)

    def adjoint(
        self, image: mi.TensorXf, nested: list[mi.TensorXf], grad_in: mi.TensorXf
    ) -> tuple[mi.TensorXf, list[mi.TensorXf]]:
        """Return the loss's derivatives by image and nested images, given those by the result."""
        planes = planes_of(image), [planes_of(each) for each in nested]
        with dr.resume_grad():
            dr.enable_grad(planes)
            channels = self._insert(*planes)
            dr.accum_grad(channels, pixels_adjoint(self.film, self.maps, grad_in, self.aovs))
            dr.enqueue(dr.ADMode.Backward, channels)
            dr.traverse(dr.ADMode.Backward)
            d_image, d_nested = dr.grad(planes)
        d_image = image_of(d_image, image)
        d_nested = [image_of(d, each) for d, each in zip(d_nested, nested, strict=True)]
        dr.eval(d_image, d_nested)
        return d_image, d_nested

    def tangent(
        self,
        image: mi.TensorXf,
        nested: list[mi.TensorXf],
        d_image: mi.TensorXf,
        d_nested: list[mi.TensorXf],
    ) -> mi.TensorXf:
        """Return the directional derivative of :meth:`develop`."""
        planes = planes_of(image), [planes_of(each) for each in nested]
        d_planes = planes_of(d_image), [planes_of(each) for each in d_nested]
        with dr.resume_grad():
            dr.enable_grad(planes)
            dr.set_grad(planes, d_planes)
            channels = self._insert(*planes)
            dr.forward_to(channels)
            tangents = dr.grad(channels)
        dr.eval(tangents)
        return develop_pixels(self.film, tangents, self.aovs)

    def _insert(self, planes: list[mi.Float], nested: list[list[mi.Float]]) -> Channels:
        to_developed, to_rgb = self._color_maps()
        count = len(to_developed)
        rest, own = planes[count : -len(self.channels)], planes[-len(self.channels) :]
        behind = _apply_map(to_developed, own[2 * self.num_surfaces :]) or [mi.Float(0)] * count
        shown = self.visible_radiance(own, [*(each[:count] for each in nested), behind])
        colors = [s + c for s, c in zip(shown, planes[:count], strict=True)]
        return [*_apply_map(to_rgb, colors), *rest]

    def visible_radiance(self, own: list[mi.Float], images: list[list[mi.Float]]) -> list[mi.Float]:
        """Return sum_k T_k L_k; own: see :meth:`values`; images: colours of N_0, N_1, ..."""
        total, weight = [mi.Float(0)] * len(images[0]), mi.Float(0)
        for k in range(self.num_surfaces):
            share, coverage = own[2 * k : 2 * k + 2]
            part = dr.select(coverage > 0, share / dr.select(coverage > 0, coverage, 1), 0)
            lights = [here - behind for here, behind in zip(*images[k : k + 2], strict=True)]
            total = [dr.fma(part, light, t) for light, t in zip(lights, total, strict=True)]
            weight = weight + share
        if self.num_surfaces > 1:  # differences of noisy images may be negative
            total = [dr.maximum(t, 0) for t in total]
        if not self.display_space:
            return total
        part = dr.select(weight > 0, weight, 1)
        mean = mi.Color3f([dr.maximum(t / part, 0) for t in total])
        return list(weight * mi.math.linear_to_srgb(mean))

    def _color_maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the maps between linear RGB and the film's colours (RGB, XYZ, luminance)."""
        matrix = film_map(self.film, self.maps, ())
        has_alpha = num_colors(self.film) == 4
        to_developed = matrix[: len(matrix) - has_alpha, :3]
        if np.array_equal(to_developed, np.eye(3)):
            return to_developed, to_developed
        if self.display_space:
            raise PluginError(
                "splats: in a scene with surfaces and with srgb_primitives false, the film's "
                "pixel_format must be rgb or rgba"
            )
        return to_developed, np.linalg.pinv(to_developed)


def _apply_map(matrix: np.ndarray, planes: list[mi.Float]) -> list[mi.Float]:
    if not planes or np.array_equal(matrix, np.eye(3)):
        return planes
    rows = (zip(row, planes, strict=True) for row in matrix)
    return [sum((float(m) * p for m, p in row), mi.Float(0)) for row in rows]


@dataclass(frozen=True)
class NestedSurfaces:
    """The surfaces in an image of splats and surfaces, and their nested integrator."""

    surfaces: Surfaces
    integrator: mi.SamplingIntegrator  # of the image
    adjoint_integrator: mi.SamplingIntegrator  # of its derivatives
    sensor: mi.Sensor
    seed: int | mi.UInt32
    spp: int  # of the nested integrator; 0: as the sensor's sampler has it
    compositor: SurfaceCompositor
    rays: StraightRays  # through the scene that the nested integrator renders

    @staticmethod
    def from_scene(
        splats: SplatsState, scene: mi.Scene, sensor: mi.Sensor, seed: int | mi.UInt32, spp: int
    ) -> NestedSurfaces:
        """Choose the nested integrator; spp: 0 for that of the sensor's sampler."""
        cache, hide_emitters = splats.cache, splats.hide_emitters
        surfaces = cache.surfaces = Surfaces.find(scene, cache.surfaces)
        count = splats.nested_spp or spp
        is_lit = splats.lighting.light != "none"
        # The paths of ``path``, with more correct derivatives, and lamps seen through surfaces.
        default = {"type": "splatpath", "hide_emitters": hide_emitters}
        nested: mi.SamplingIntegrator = splats.nested or mi.load_dict(default)
        adjoint = nested
        if splats.nested is None and not (is_lit or surfaces.is_transparent):
            nested = mi.load_dict({"type": "path", "hide_emitters": hide_emitters})
        if isinstance(nested, TransportIntegrator):
            transport = None  # another integrator may have given it one
            if is_lit:
                from drgs.integrator.light.splat_transport import transport_of

                num_paths = count or sensor.sampler().sample_count()
                transport = transport_of(splats, scene, num_paths, sensors_of(sensor))
            nested.use_transport(transport)
        shows_background = not hide_emitters and scene.environment() is not None
        film, maps, names = sensor.film(), cache.film_maps, splats.aov_names()
        display_space = not splats.srgb_primitives
        compositor = SurfaceCompositor(film, maps, names, shows_background, display_space)
        traced = surfaces.scene_to_trace(scene)
        rays = StraightRays(traced, hide_emitters, hide_emitters or surfaces.is_transparent)
        return NestedSurfaces(surfaces, nested, adjoint, sensor, seed, count, compositor, rays)

    def with_surfaces(self, count: int) -> NestedSurfaces:
        """Return a copy for ``count`` surfaces that are seen one through the other."""
        return replace(self, compositor=replace(self.compositor, num_surfaces=count))

    def images(self) -> list[mi.TensorXf]:
        """Return N_0, N_1, ..., developed. Leaves the film with the last."""
        return [
            self.integrator.render(self.rays.scene, sensor=sensor, seed=self.seed, spp=self.spp)
            for sensor in self._sensors()
        ]

    def radiances(
        self, ray: mi.RayDifferential3f, sampler: mi.Sampler, active: mi.Bool
    ) -> list[mi.Color3f]:
        """Return N_0, N_1, ... along single rays."""
        found = []
        for count in range(self.compositor.num_surfaces):
            behind, weight = mi.RayDifferential3f(ray), mi.Float(1)
            if self.surfaces.is_transparent:
                behind, weight = RaysBehind(self.rays, count).advance(behind, active)
            with _reduce_depth(self.integrator, count):
                # The base class's: integrators written in Python have another signature.
                radiance, *_ = mi.SamplingIntegrator.sample(
                    self.integrator, self.rays.scene, sampler, behind, None, active
                )
            found.append(weight * mi.Color3f(radiance))
        return found

    def backward(self, params: object, d_images: list[mi.TensorXf]) -> None:
        """Accumulate derivatives into the parameters of surfaces and emitters."""
        gradients = iter(d_images)
        with self._differentiating() as parameters:
            if parameters:
                self._needed_surfaces(
                    lambda sensor: self.adjoint_integrator.render_backward(
                        self.rays.scene, params, next(gradients), sensor, self.seed, self.spp
                    )
                )

    def tangents(self, params: object, images: list[mi.TensorXf]) -> list[mi.TensorXf]:
        """Return derivatives of the nested images along those set on the parameters."""
        found: list[mi.TensorXf | None] = [None] * len(images)
        with self._differentiating() as parameters:
            if parameters:
                # A loop sees only tangents inside of it: compute before those of everything that
                # objects have derived from their parameters.
                dr.enqueue(dr.ADMode.Forward, [parameter.value for parameter in parameters])
                dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
                found = self._needed_surfaces(
                    lambda sensor: self.adjoint_integrator.render_forward(
                        self.rays.scene, params, sensor, self.seed, self.spp
                    )
                )
        pairs = zip(found, images, strict=True)
        return [dr.zeros(mi.TensorXf, p.shape) if d is None else d for d, p in pairs]

    def _needed_surfaces(self, differentiate: Callable[[mi.Sensor], T]) -> list[T | None]:
        """Differentiate nested images; None for those that do not depend on parameters."""
        found: list[T | None] = []
        reasons: list[str] = []  # not errors: their tracebacks hold the scene until it is collected
        for sensor in self._sensors():
            try:
                found.append(differentiate(sensor))
            except Exception as error:
                reasons.append(str(root_cause(error)))
                if not any(words in reasons[-1] for words in INDEPENDENT):
                    raise
                found.append(None)
        if len(reasons) == len(found):
            raise UnsupportedError(reasons[0])
        return found

    def _sensors(self) -> Iterator[mi.Sensor]:
        """Yield sensors whose rays start behind 0, 1, ... surfaces, for the nested images.

        Paths from behind windows have fewer bounces where ``max_depth`` can be set in Python.
        """
        sampler = self.sensor.sampler()
        sample_count = sampler.sample_count()
        for count in range(self.compositor.num_surfaces):
            sensor = self.sensor
            if self.surfaces.is_transparent:
                sensor = sensor_behind(sensor, sensors_of(sensor), RaysBehind(self.rays, count))
            with (
                _reduce_depth(self.integrator, count),
                _reduce_depth(self.adjoint_integrator, count),
            ):
                try:
                    yield sensor
                finally:  # the nested integrator sets its own
                    sampler.set_sample_count(sample_count)

    @contextmanager
    def _differentiating(self) -> Iterator[list[Parameter]]:
        """Yield the attached parameters of the surfaces; errors are raised with their names."""
        with dr.resume_grad():
            parameters = list(attached_parameters(self.rays.scene))
            try:
                yield parameters
            except Exception as error:
                raise UnsupportedError(
                    f"splats: {type_of(self.adjoint_integrator)} does not differentiate the "
                    f"surfaces with respect to {format_names([p.name for p in parameters])}: "
                    f"{one_line(root_cause(error))}"
                ) from None


@contextmanager
def _reduce_depth(integrator: Any, count: int) -> Iterator[None]:
    """Shorten paths by ``count`` bounces, but for TransportIntegrators, where windows are none."""
    depth = getattr(integrator, "max_depth", UNBOUNDED_DEPTH)
    is_bounded = isinstance(depth, int) and depth < UNBOUNDED_DEPTH
    if isinstance(integrator, TransportIntegrator) or not is_bounded:
        yield
        return
    integrator.max_depth = max(depth - count, 0)
    try:
        yield
    finally:
        integrator.max_depth = depth
