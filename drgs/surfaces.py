"""Meshes and other surfaces that a scene holds besides its splats.

Layer 4, imported when a scene has surfaces. A nested integrator, such as Mitsuba's ``path``, makes
a picture of them. What that shows at a pixel lies at the depth of the first surface there, between
the splats: with c the part of the pixel that the surface covers, T_s the transmittance of the
splats in front of it, T that of all splats, C their colour as far as the surface lets it through
(``drgs.occlusion``), N the nested picture and B the background,

    C + c T_s S + T (1 - c) B,   S = (N - (1 - c) B) / c.

S is what the surface itself shows; where the nested integrator does not show the background, its
share is not taken off. Light does not pass from one to the other: splats neither light surfaces
nor are lit by them, and cast no shadows.

Where a surface ends within a pixel, it covers a part of it. With one sample per pixel, pixels next
to where surfaces end and the background begins are looked at in :data:`EDGE_SAMPLES` places; with
several samples, each has its own depth. A ``thinlens`` sees depths and coverage from the middle of
its aperture.

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

from drgs.camera import Camera
from drgs.exposure import Channels, develop_pixels, film_map, num_colors, pixel_corners
from drgs.exposure import pixels_adjoint as film_adjoint
from drgs.occlusion import Surface
from drgs.pixels import image_of, planes_of

EDGE_GRID = 4

EDGE_SAMPLES = EDGE_GRID**2
"""Places of a pixel at which the edge of a surface is looked at."""


# ----------------------------------------------------------------------------------------------
# What a scene holds
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What of a scene light is traced through, and all that its shapes depend on.

    It holds no scene that has the integrator, which keeps it: neither would ever be freed.
    """

    objects: list[mi.Object]  # shapes but Gaussians, emitters that are no shapes, sensors
    parameters: list[Any]  # of its shapes, detached: held, so that equal indices mean equal values
    apart: mi.Scene | None  # made of the objects, where the scene's shapes are not all surfaces

    @staticmethod
    def of(scene: mi.Scene, last: Surfaces | None) -> Surfaces:
        """Those of a scene, or ``last`` if they are still the same."""
        shapes = [shape for shape in scene.shapes() if not shape.is_ellipsoids()]
        emitters = [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
        objects = [*shapes, *emitters, *scene.sensors()]
        parameters = [dr.detach(value) for s in shapes for _, value in mi.traverse(s)]
        indices = dr.detail.collect_indices
        if (
            last is not None
            and list(map(id, last.objects)) == list(map(id, objects))
            and indices(last.parameters) == indices(parameters)
        ):
            return last
        apart = None
        if len(shapes) < len(scene.shapes()):
            # Of the same objects, so that their parameters are those of the scene.
            named = {f"object_{k}": value for k, value in enumerate(objects)}
            apart = mi.load_dict({"type": "scene", **named})
        return Surfaces(objects, parameters, apart)

    def traced(self, scene: mi.Scene) -> mi.Scene:
        """What the nested integrator renders; scene: the one that these are of."""
        return scene if self.apart is None else self.apart


# ----------------------------------------------------------------------------------------------
# Where its surfaces are
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SeenSurface(Surface):
    """The nearest surface at each pixel, as one camera sees it."""

    normal: Any  # Normal3f, world, times the coverage; None: nobody asked

    def share(self, front: mi.Float) -> mi.Float:
        """What the surface adds its own with; front: sum of the splats' weights in front of it."""
        return self.coverage * (1 - front)

    def added(self, kind: str, front: mi.Float) -> list[mi.Float] | None:
        """To the channels of an AOV; None: nothing."""
        if kind == "depth":
            return [self.share(front) * self.depth]
        if kind == "normal":
            return [(1 - front) * component for component in self.normal]
        return None


def look_at(
    scene: mi.Scene,
    film: mi.Film,
    cameras: Sequence[Camera],
    within: Sequence[tuple[Any, Any]],
    hide_emitters: bool,
    with_normals: bool,
) -> list[list[SeenSurface]]:
    """What is seen of the surfaces, by time and by sample, evaluated.

    cameras: of each time; within: of each sample, x and y from the pixel's upper left corner, px;
    hide_emitters: whether surfaces that are emitters are looked through.
    """
    eye = _Eye(scene, hide_emitters, with_normals)
    corner = pixel_corners(film)
    seen = [[eye.look(camera, corner, *place) for place in within] for camera in cameras]
    dr.eval(seen)
    if len(within) == 1:
        seen = [
            [eye.look_closer(camera, film, corner, surface) for surface in of_time]
            for camera, of_time in zip(cameras, seen, strict=True)
        ]
        dr.eval(seen)
    return seen


@dataclass(frozen=True)
class _Eye:
    scene: mi.Scene
    hide_emitters: bool
    with_normals: bool

    def look(self, camera: Camera, corner: mi.Point2f, x: Any, y: Any) -> SeenSurface:
        """At places of pixels."""
        place = corner + mi.Point2f(x, y)
        camera = camera.at_row(place.y)
        origin, direction, seen = camera.look_through(place.x, place.y)
        direction = dr.normalize(direction)
        start, _ = camera.lens.ray_range(direction, camera.near, camera.near)
        to_world = camera.rotation.T
        ray = mi.Ray3f(
            o=mi.Point3f(camera.center + to_world @ (origin + start * direction)),
            d=mi.Vector3f(to_world @ direction),
        )
        active = mi.Bool(seen)
        hit = self.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        if self.hide_emitters:
            ray, hit = _past_emitters(self.scene, ray, hit)
        valid = hit.is_valid()
        point = ray.o + dr.select(valid, hit.t, 1) * ray.d
        _, _, depth = camera.lens.look(camera, camera.rotation @ (point - camera.center))
        normal = None
        if self.with_normals:
            frame = hit.compute_surface_interaction(ray, mi.RayFlags.ShadingFrame, valid).sh_frame
            normal = dr.select(valid, mi.Normal3f(frame.n), 0)
        return SeenSurface(depth, dr.select(valid, mi.Float(1), 0), normal)

    def look_closer(
        self, camera: Camera, film: mi.Film, corner: mi.Point2f, surface: SeenSurface
    ) -> SeenSurface:
        """The same with the mean of several places in each pixel at an edge.

        The host reads how many there are.
        """
        edge = dr.compress(_differs_from_a_neighbour(surface.coverage, film))
        if dr.width(edge) == 0:
            return surface
        corner = dr.gather(mi.Point2f, corner, edge)
        places = [(k + 0.5) / EDGE_GRID for k in range(EDGE_GRID)]
        hits = [self.look(camera, corner, x, y) for y in places for x in places]
        covered = sum((h.coverage for h in hits), mi.Float(0))
        depth = sum((h.coverage * h.depth for h in hits), mi.Float(0)) / dr.maximum(covered, 1)
        means = [depth, covered / EDGE_SAMPLES]
        planes = [surface.depth, surface.coverage]
        if surface.normal is not None:
            means += list(sum((h.normal for h in hits), mi.Normal3f(0)) / EDGE_SAMPLES)
            planes += list(surface.normal)
        planes = [mi.Float(plane) for plane in planes]
        for plane, mean in zip(planes, means, strict=True):
            dr.scatter(plane, mean, edge)
        depth, coverage, *normal = planes
        return SeenSurface(depth, coverage, mi.Normal3f(*normal) if normal else None)


@dr.syntax
def _past_emitters(
    scene: mi.Scene, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f
) -> tuple[mi.Ray3f, mi.PreliminaryIntersection3f]:
    """The first hit that is no emitter, and the last part of the ray, which ends there."""
    emits = hit.is_valid() & hit.shape.is_emitter()
    while emits:
        ray = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, emits).spawn_ray(ray.d)
        hit = scene.ray_intersect_preliminary(ray, coherent=True, active=emits)
        emits &= hit.is_valid() & hit.shape.is_emitter()
    return ray, hit


def _differs_from_a_neighbour(plane: mi.Float, film: mi.Film) -> mi.Bool:
    """Of pixels, row by row: whether one of the eight around has another value."""
    width, height = (dr.opaque(mi.Int32, size) for size in film.crop_size())
    pixel = dr.arange(mi.Int32, dr.width(plane))
    row = pixel // width
    column = pixel - row * width
    differs = mi.Bool(False)
    for down in (-1, 0, 1):
        y = dr.clip(row + down, 0, height - 1)
        for right in (-1, 0, 1):
            x = dr.clip(column + right, 0, width - 1)
            differs |= dr.gather(mi.Float, plane, mi.UInt32(y * width + x)) != plane
    return differs


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
    maps: dict[str, np.ndarray]  # see drgs.exposure
    aovs: Sequence[str]  # that the user asked for
    shows_background: bool
    display_space: bool  # of the splats' picture; the nested one is linear

    @property
    def channels(self) -> list[str]:
        """Names of the channels that the picture of the splats must have at its end."""
        names = ["share", "coverage"] + ["R", "G", "B"] * self.shows_background
        return [f"surface.{k}.{name}" for k, name in enumerate(names)]

    def values(self, surface: SeenSurface, front: mi.Float, radiance: Any) -> Channels:
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
            raise ValueError(
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
    integrator: mi.Integrator
    sensor: mi.Sensor
    seed: Any
    spp: int  # of the nested integrator; 0: as the sensor's sampler has it
    insertion: Insertion

    def picture(self) -> mi.TensorXf:
        """The nested one, developed. Leaves the film with it."""
        with _sample_count_kept(self.sensor):
            return self.integrator.render(
                self.scene, sensor=self.sensor, seed=self.seed, spp=self.spp
            )

    def backward(self, params: Any, d_picture: mi.TensorXf) -> None:
        """Accumulate derivatives into the parameters of surfaces and emitters."""
        with dr.resume_grad(), _sample_count_kept(self.sensor):
            if self._is_attached():
                self.integrator.render_backward(
                    self.scene, params, d_picture, self.sensor, self.seed, self.spp
                )

    def tangent(self, params: Any, picture: mi.TensorXf) -> mi.TensorXf:
        """Directional derivative of the nested picture, along those set on the parameters."""
        with dr.resume_grad(), _sample_count_kept(self.sensor):
            if self._is_attached():
                return self.integrator.render_forward(
                    self.scene, params, self.sensor, self.seed, self.spp
                )
        return dr.zeros(mi.TensorXf, picture.shape)

    def _is_attached(self) -> bool:
        """Whether derivatives are asked for that the nested integrator gives."""
        objects = [*self.scene.shapes(), *self.scene.emitters(), self.sensor]
        return any(dr.grad_enabled(value) for o in objects for _, value in mi.traverse(o))


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
