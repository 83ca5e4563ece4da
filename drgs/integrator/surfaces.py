"""Meshes and other surfaces that a scene holds besides its splats.

Imported when a scene has surfaces. A nested integrator, such as Mitsuba's ``path``, makes a picture
of them. What that shows at a pixel lies at the depth of the first surface there, between the
splats: with c the part of the pixel that the surface covers, T_s the transmittance of the splats in
front of it, T that of all splats, C their colour as far as the surface lets it through
(``drgs.effects.occlusion``), N the nested picture and B the background,

    C + c T_s S + T (1 - c) B,   S = (N - (1 - c) B) / c.

S is what the surface itself shows; where the nested integrator does not show the background, its
share is not taken off. Light does not pass from one to the other: splats neither light surfaces
nor are lit by them, and cast no shadows.

Where a surface ends within a pixel, it covers a part of it. With one sample per pixel, rays are
traced through :data:`EDGE_SAMPLES` places of each pixel next to where surfaces end and the
background begins; with several samples, each has its own depth. A ``thinlens`` sees depths and
coverage from the middle of its aperture. What lets light pass straight on (``null``, ``mask``,
``thindielectric``) covers the rest; of several such surfaces on a ray, all cover at the place of
the first.

Derivatives flow to the splats and, through the nested integrator, to the parameters of surfaces and
emitters. Not differentiated: the depth of a surface and the part of a pixel that it covers, and
with that its silhouette.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.cameras.camera import Camera
from drgs.core.arrays import image_of, planes_of
from drgs.core.errors import PluginError, UnsupportedError, listed, one_line, root_cause
from drgs.core.private import same_variables
from drgs.effects.occlusion import Surface
from drgs.integrator.derivatives import (
    Parameter,
    attached_parameters,
    parameter_value,
    type_of,
)
from drgs.integrator.film import Channels, develop_pixels, film_map, num_colors, pixel_corners
from drgs.integrator.film import pixels_adjoint as film_adjoint

EDGE_GRID = 4

EDGE_SAMPLES = EDGE_GRID**2
"""Rays through a pixel in which a surface ends."""


# ----------------------------------------------------------------------------------------------
# What a scene holds
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What of a scene light is traced through, and all that this depends on.

    It holds no scene that has the integrator, which keeps it: neither would ever be freed.
    """

    objects: list[mi.Object]  # of the scene, without its Gaussians and integrator
    parameters: list[Any]  # of these, detached: held, so that equal indices mean equal values
    apart: mi.Scene | None  # made of the objects, where the scene has Gaussians besides

    @staticmethod
    def of(scene: mi.Scene, last: Surfaces | None) -> Surfaces:
        """Those of a scene, or ``last`` if they are still the same."""
        objects, parameters = _surroundings(scene)
        has_gaussians = any(shape.is_ellipsoids() for shape in scene.shapes())
        if (
            last is not None
            and (last.apart is not None) == has_gaussians
            and list(map(id, last.objects)) == list(map(id, objects))
            and _same(last.parameters, parameters)
        ):
            return last
        apart = scene_of(objects) if has_gaussians else None
        return Surfaces(objects, dr.detach(parameters), apart)

    def traced(self, scene: mi.Scene) -> mi.Scene:
        """What the nested integrator renders; scene: the one that these are of."""
        return scene if self.apart is None else self.apart


def _surroundings(scene: mi.Scene) -> tuple[list[mi.Object], list[Any]]:
    """A scene's own objects but Gaussians and integrators, and parameters of all but sensors.

    Shape groups are found among them alone: instances do not show what they repeat.
    """
    params = mi.traverse(scene)
    objects, left_out = [], set()
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


def _same(parameters: list[Any], others: list[Any]) -> bool:
    """Whether arrays are the same variables, and everything else has the same value."""
    on_host = [[v for v in of if not dr.is_array_v(v)] for of in (parameters, others)]
    return on_host[0] == on_host[1] and same_variables(parameters, dr.detach(others))


def scene_of(objects: list[mi.Object]) -> mi.Scene:
    """Of the same objects, so that their parameters are those of the user's scene, and names."""
    names = [node.id() for node in objects]
    scene = mi.load_dict({"type": "scene", **{f"object_{k}": o for k, o in enumerate(objects)}})
    for node, name in zip(objects, names, strict=True):
        node.set_id(name)
    return scene


# ----------------------------------------------------------------------------------------------
# Where its surfaces are
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SeenSurface(Surface):
    """The nearest surface at each pixel, as one camera sees it."""

    normal: Any  # Normal3f, world, times the coverage; None: nobody asked

    def at(self, pixel: mi.UInt32) -> SeenSurface:
        """At some of the pixels."""
        planes = (dr.gather(mi.Float, plane, pixel) for plane in (self.depth, self.coverage))
        normal = None if self.normal is None else dr.gather(mi.Normal3f, self.normal, pixel)
        return SeenSurface(*planes, normal)

    def share(self, front: mi.Float) -> mi.Float:
        """What the surface adds its own with; front: sum of the splats' weights in front of it."""
        return self.coverage * (1 - front)

    def aov_values(self, kind: str, front: mi.Float) -> list[mi.Float] | None:
        """What the surface contributes to the channels of an AOV; None: nothing."""
        if kind == "depth":
            return [self.share(front) * self.depth]
        if kind == "normal":
            return [(1 - front) * component for component in self.normal]
        return None


def trace_surfaces(
    scene: mi.Scene,
    sensor: mi.Sensor,
    cameras: Sequence[Camera],
    within: Sequence[tuple[Any, Any]],
    hide_emitters: bool,
    with_normals: bool,
) -> list[list[SeenSurface]]:
    """What is seen of the surfaces, by time and by sample, evaluated.

    cameras: of each time; within: of each sample, x and y from the pixel's upper left corner, px;
    hide_emitters: whether rays pass through surfaces that are emitters.
    """
    tracer = _Tracer(
        scene=scene,
        far=dr.opaque(mi.Float, sensor.far_clip()),
        hide_emitters=hide_emitters,
        sees_through=hide_emitters or _has_transparent_parts(scene),
        with_normals=with_normals,
    )
    film = sensor.film()
    if len(within) == 1 and dr.width(within[0]) == 1:  # the same place in all pixels
        seen = [[tracer.trace_with_edges(camera, film, *within[0])] for camera in cameras]
    else:
        corner = pixel_corners(film)
        seen = [[tracer.trace(camera, corner, *place) for place in within] for camera in cameras]
    dr.eval(seen)
    return seen


def _has_transparent_parts(scene: mi.Scene) -> bool:
    """Whether anything lets light pass straight on."""
    bsdfs = (node for node in mi.traverse(scene).hierarchy if isinstance(node, mi.BSDF))
    return any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs)


@dataclass  # not frozen: ``dr.syntax`` carries it through a loop
class _Tracer:
    """Traces rays of a camera to the surfaces of a scene."""

    scene: mi.Scene
    far: mi.Float  # depth, scene units: farther surfaces are not seen
    hide_emitters: bool
    sees_through: bool  # anything at all
    with_normals: bool

    def trace(self, camera: Camera, corner: mi.Point2f, x: Any, y: Any) -> SeenSurface:
        """What rays meet at places of pixels.

        corner: upper left corners of the pixels, px; x, y: from there.
        """
        place = corner + mi.Point2f(x, y)
        camera = camera.at_row(place.y)
        origin, direction, seen = camera.look_through(place.x, place.y)
        direction = dr.normalize(direction)
        start, end = camera.lens.ray_range(direction, camera.near, self.far)
        to_world = camera.rotation.T
        ray = mi.Ray3f(
            o=mi.Point3f(camera.center + to_world @ (origin + start * direction)),
            d=mi.Vector3f(to_world @ direction),
        )
        ray.maxt = end - start
        ray, hit, coverage = self._meet(ray, mi.Bool(seen))
        valid = coverage > 0
        point = ray.o + dr.select(valid, hit.t, 1) * ray.d
        _, _, depth = camera.lens.look(camera, camera.rotation @ (point - camera.center))
        normal = None
        if self.with_normals:
            frame = hit.compute_surface_interaction(ray, mi.RayFlags.ShadingFrame, valid).sh_frame
            normal = dr.select(valid, coverage * mi.Normal3f(frame.n), 0)
        return SeenSurface(depth, coverage, normal)

    def trace_with_edges(self, camera: Camera, film: mi.Film, x: Any, y: Any) -> SeenSurface:
        """The same at one place of each pixel, or at several where coverage changes next to it.

        Around the crop window is a row of pixels more, so that its edges are those of the film.
        The host reads how many of the latter there are.
        """
        count = dr.prod(film.crop_size() + 2)
        width = dr.opaque(mi.UInt32, film.crop_size()[0] + 2)
        row = dr.arange(mi.UInt32, count) // width
        column = dr.arange(mi.UInt32, count) - row * width
        around = self.trace(camera, mi.Point2f(column, row) - 1, x, y)
        dr.eval(around)

        corner = pixel_corners(film)
        number = mi.UInt32(corner.y + 1) * width + mi.UInt32(corner.x + 1)
        surface = around.at(number)
        differs = mi.Bool(False)
        for down in (number - width, number, number + width):
            for neighbour in (down - 1, down, down + 1):
                differs |= dr.gather(mi.Float, around.coverage, neighbour) != surface.coverage
        edge = dr.compress(differs)
        if dr.width(edge) > 0:
            surface = self._trace_edges(camera, corner, surface, edge)
        return surface

    def _trace_edges(
        self, camera: Camera, corner: mi.Point2f, surface: SeenSurface, edge: mi.UInt32
    ) -> SeenSurface:
        """``surface`` with means over several rays in the pixels ``edge``."""
        corner = dr.gather(mi.Point2f, corner, edge)
        places = [(k + 0.5) / EDGE_GRID for k in range(EDGE_GRID)]
        hits = [self.trace(camera, corner, x, y) for y in places for x in places]
        covered = sum((h.coverage for h in hits), mi.Float(0))
        depth = sum((h.coverage * h.depth for h in hits), mi.Float(0))
        means = [depth / dr.select(covered > 0, covered, 1), covered / EDGE_SAMPLES]
        planes = [surface.depth, surface.coverage]
        if surface.normal is not None:
            means += list(sum((h.normal for h in hits), mi.Normal3f(0)) / EDGE_SAMPLES)
            planes += list(surface.normal)
        planes = [mi.Float(plane) for plane in planes]
        for plane, mean in zip(planes, means, strict=True):
            dr.scatter(plane, mean, edge)
        depth, coverage, *normal = planes
        return SeenSurface(depth, coverage, mi.Normal3f(*normal) if normal else None)

    def _meet(
        self, ray: mi.Ray3f, active: mi.Bool
    ) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f, mi.Float]:
        """The first hit that is seen, the ray that ends there, and how much all cover, 0..1."""
        hit = self.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        if self.sees_through:
            return self._trace_through(ray, hit)
        return ray, hit, dr.select(hit.is_valid(), mi.Float(1), 0)

    @dr.syntax
    def _trace_through(
        self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f
    ) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f, mi.Float]:
        """As :meth:`_meet`, past what is transparent in all or part."""
        coverage = dr.select(hit.is_valid(), self._opacity(ray, hit), 0)
        seen_ray, seen_hit = mi.Ray3f(ray), mi.PreliminaryIntersection3f(hit)
        goes_on = hit.is_valid() & (coverage < 1)
        while goes_on:
            rest = ray.maxt - hit.t
            si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, goes_on)
            ray = si.spawn_ray(ray.d)
            ray.maxt = rest
            hit = self.scene.ray_intersect_preliminary(ray, coherent=True, active=goes_on)
            goes_on &= hit.is_valid()
            opacity = dr.select(goes_on, self._opacity(ray, hit), 0)
            is_first = (coverage == 0) & (opacity > 0)
            seen_ray = dr.select(is_first, ray, seen_ray)
            seen_hit = dr.select(is_first, hit, seen_hit)
            coverage = dr.fma(1 - coverage, opacity, coverage)
            goes_on &= coverage < 1
        return seen_ray, seen_hit, coverage

    def _opacity(self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f) -> mi.Float:
        """Of what a ray has hit: what it does not let pass straight on."""
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, hit.is_valid())
        opacity = 1 - dr.mean(si.bsdf().eval_null_transmission(si, hit.is_valid()))
        if self.hide_emitters:
            opacity = dr.select(si.shape.is_emitter(), 0, opacity)
        return opacity


# ----------------------------------------------------------------------------------------------
# The nested picture between the splats
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Insertion:
    """Puts the nested picture into that of the splats; both are developed already.

    The latter has channels of its own at its end: the share c T_s of the surface, its coverage c,
    and where the nested picture shows a background, (1 - c) B in linear RGB.
    """

    film: mi.Film
    maps: dict[str, np.ndarray]  # see drgs.integrator.film
    aovs: Sequence[str]  # that the user asked for
    shows_background: bool
    display_space: bool  # of the splats' picture; the nested one is linear

    @property
    def channels(self) -> list[str]:
        """Names of the channels that the picture of the splats must have at its end."""
        names = ["share", "coverage"] + ["R", "G", "B"] * self.shows_background
        return [f"surface.{k}.{name}" for k, name in enumerate(names)]

    def values(
        self, surface: SeenSurface, front: mi.Float, radiance: mi.Color3f | None
    ) -> Channels:
        """Those channels of a pass; front: see :class:`SeenSurface`; radiance: B, linear."""
        values = [surface.share(front), surface.coverage]
        if self.shows_background:
            values += list((1 - surface.coverage) * radiance)
        return values

    def develop(self, image: mi.TensorXf, nested: mi.TensorXf) -> mi.TensorXf:
        """The picture of both, which the film then holds."""
        channels = self._inserted(planes_of(image), planes_of(nested))
        return develop_pixels(self.film, channels, self.aovs)

    def adjoint(
        self, image: mi.TensorXf, nested: mi.TensorXf, grad_in: mi.TensorXf
    ) -> tuple[mi.TensorXf, mi.TensorXf]:
        """Derivatives of the loss with respect to both, given those of :meth:`develop`."""
        planes = planes_of(image), planes_of(nested)
        with dr.resume_grad():
            dr.enable_grad(planes)
            channels = self._inserted(*planes)
            dr.accum_grad(channels, film_adjoint(self.film, self.maps, grad_in, self.aovs))
            dr.enqueue(dr.ADMode.Backward, channels)
            dr.traverse(dr.ADMode.Backward)
            d_image, d_nested = dr.grad(planes)
        d_image, d_nested = image_of(d_image, image), image_of(d_nested, nested)
        dr.eval(d_image, d_nested)
        return d_image, d_nested

    def tangent(
        self,
        image: mi.TensorXf,
        nested: mi.TensorXf,
        d_image: mi.TensorXf,
        d_nested: mi.TensorXf,
    ) -> mi.TensorXf:
        """Directional derivative of :meth:`develop` along those of both."""
        planes = planes_of(image), planes_of(nested)
        with dr.resume_grad():
            dr.enable_grad(planes)
            dr.set_grad(planes, (planes_of(d_image), planes_of(d_nested)))
            channels = self._inserted(*planes)
            dr.forward_to(channels)
            tangents = dr.grad(channels)
        dr.eval(tangents)
        return develop_pixels(self.film, tangents, self.aovs)

    def _inserted(self, planes: list[mi.Float], nested: list[mi.Float]) -> Channels:
        """What the film gets."""
        to_developed, to_rgb = self._color_maps()
        count = len(to_developed)
        rest, own = planes[count : -len(self.channels)], planes[-len(self.channels) :]
        share, coverage, *background = own
        shown = nested[:count]
        if background:
            behind = _mapped(to_developed, background)
            shown = [n - b for n, b in zip(shown, behind, strict=True)]
        covered = coverage > 0
        part = dr.select(covered, coverage, 1)
        shown = [dr.select(covered, n / part, 0) for n in shown]
        if self.display_space:
            shown = list(mi.math.linear_to_srgb(dr.maximum(mi.Color3f(*shown), 0)))
        colors = [dr.fma(share, s, c) for s, c in zip(shown, planes[:count], strict=True)]
        return [*_mapped(to_rgb, colors), *rest]

    def _color_maps(self) -> tuple[np.ndarray, np.ndarray]:
        """From linear RGB to what the film makes of it (RGB, XYZ, luminance), and back.

        Of luminance there is no way back but to some colour that has it.
        """
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


def _mapped(matrix: np.ndarray, planes: list[mi.Float]) -> list[mi.Float]:
    if np.array_equal(matrix, np.eye(3)):
        return planes
    return [sum(float(m) * p for m, p in zip(row, planes, strict=True)) for row in matrix]


@dataclass(frozen=True)
class Hybrid:
    """One rendering of splats and surfaces: the part of the surfaces."""

    scene: mi.Scene  # what the nested integrator is given
    surfaces: Surfaces
    integrator: mi.Integrator  # of the picture
    adjoint_integrator: mi.Integrator  # of its derivatives
    sensor: mi.Sensor
    seed: int | mi.UInt32
    spp: int  # of the nested integrator; 0: as the sensor's sampler has it
    insertion: Insertion

    def picture(self) -> mi.TensorXf:
        """The nested one, developed. Leaves the film with it."""
        with _sample_count_kept(self.sensor):
            return self.integrator.render(
                self.scene, sensor=self.sensor, seed=self.seed, spp=self.spp
            )

    def backward(self, params: object, d_picture: mi.TensorXf) -> None:
        """Accumulate derivatives into the parameters of surfaces and emitters."""
        with self._differentiating() as parameters:
            if parameters:
                self.adjoint_integrator.render_backward(
                    self.scene, params, d_picture, self.sensor, self.seed, self.spp
                )

    def tangent(self, params: object, picture: mi.TensorXf) -> mi.TensorXf:
        """Directional derivative of the nested picture, along those set on the parameters."""
        with self._differentiating() as parameters:
            if parameters:
                # A loop sees tangents of what is inside of it alone, so that those of all that
                # objects have computed from their parameters must be known before.
                dr.enqueue(dr.ADMode.Forward, [parameter.value for parameter in parameters])
                dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
                return self.adjoint_integrator.render_forward(
                    self.scene, params, self.sensor, self.seed, self.spp
                )
        return dr.zeros(mi.TensorXf, picture.shape)

    @contextmanager
    def _differentiating(self) -> Iterator[list[Parameter]]:
        """What the nested integrator is to differentiate.

        Its errors, which are about variables, are raised again with the parameters' names.
        """
        with dr.resume_grad(), _sample_count_kept(self.sensor):
            parameters = list(attached_parameters(self.scene))
            try:
                yield parameters
            except Exception as error:
                raise UnsupportedError(
                    f"splats: {type_of(self.adjoint_integrator)} does not differentiate the "
                    f"surfaces with respect to {listed([p.name for p in parameters])}: "
                    f"{one_line(root_cause(error))}"
                ) from None


@contextmanager
def _sample_count_kept(sensor: mi.Sensor) -> Iterator[None]:
    """Mitsuba's integrators leave theirs with the sampler: the splats' next picture would have it.

    With ``nested_spp``, that would have other samples than the one before, and its gradients.
    """
    sampler = sensor.sampler()
    count = sampler.sample_count()
    try:
        yield
    finally:
        sampler.set_sample_count(count)
