"""The surfaces that a camera sees at each pixel: depths and coverage.

Rays go from the camera to the first visible surface, and through transparent ones to the next. A
surface that ends within a pixel covers a part of it: with one sample per pixel, 16 rays are traced
through such pixels; with several samples, each has its own depth. A ``thinlens`` sees depths and
coverage from the middle of its aperture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from drgs.cameras.camera import Camera
from drgs.core.types import Float
from drgs.effects.occlusion import Surface
from drgs.integrator.film import num_samples, pixel_corners
from drgs.integrator.light.rays import MAX_INVISIBLE_OPACITY, StraightRays

EDGE_GRID = 4  # rays along each axis of a pixel in which a surface ends
MAX_SURFACES = 4  # seen one through the other; the last one stands for all that follow
MISSING_SURFACE_DEPTH = 1e30  # depth of a missing surface: behind all splats, and 0 times it is 0


@dataclass(frozen=True, eq=False)
class VisibleSurface(Surface):
    """A visible surface at each pixel."""

    normal: mi.Normal3f | None  # world, to the camera, times the coverage; None: no AOV needs it

    def gather(self, pixel: mi.UInt32) -> VisibleSurface:
        """Return the surfaces of some pixels."""
        return VisibleSurface(
            dr.gather(mi.Float, self.depth, pixel),
            dr.gather(mi.Float, self.coverage, pixel),
            None if self.normal is None else dr.gather(mi.Normal3f, self.normal, pixel),
        )

    def share(self, front: mi.Float) -> mi.Float:
        """Return the surface's weight; front: sum of the weights of splats in front of it."""
        return self.coverage * (1 - front)

    def aov_values(self, kind: str, front: mi.Float) -> list[mi.Float] | None:
        """Return the values of an AOV, or None for one that surfaces do not have."""
        if kind == "depth":
            return [self.share(front) * self.depth]
        if kind == "normal":
            assert self.normal is not None, "traced where there is this AOV"
            return [(1 - front) * component for component in self.normal]
        return None


SurfaceLayers = list[VisibleSurface]  # the surfaces of each pixel, nearest first


def transmittance_behind(surfaces: Sequence[Surface]) -> mi.Float:
    """Return the transmittance of all surfaces at each pixel."""
    rest = mi.Float(1)
    for surface in surfaces:
        rest = rest - surface.coverage
    return dr.maximum(rest, 0)


def trace_surfaces(
    rays: StraightRays,
    far: float,
    film: mi.Film,
    cameras: Sequence[Camera],
    within: Sequence[tuple[Float | float, Float | float]],
    with_normals: bool,
) -> list[list[SurfaceLayers]]:
    """Return the visible surfaces by time and by pass, evaluated, all with the same number.

    far: largest depth of surfaces; cameras: by time; within: by pass, x and y from the pixel's
    upper left corner, px. The host reads whether more surfaces are seen through others.
    """
    tracer = _Tracer(rays, dr.opaque(mi.Float, far), with_normals)
    if len(within) == 1 and dr.width(within[0]) == 1:  # the same place in all pixels
        seen = [[tracer.trace_with_edges(camera, film, *within[0])] for camera in cameras]
    else:
        places = [(pixel_corners(film, num_samples(film, x)), x, y) for x, y in within]
        seen = [[tracer.trace(camera, *place) for place in places] for camera in cameras]
    most = max(len(layers) for of_time in seen for layers in of_time)
    seen = [[_pad(layers, most) for layers in of_time] for of_time in seen]
    dr.eval(seen)
    return seen


def _pad(layers: SurfaceLayers, count: int) -> SurfaceLayers:
    first = layers[0]
    zero = dr.zeros(mi.Float, dr.width(first.coverage))
    far = zero + MISSING_SURFACE_DEPTH
    normal = None if first.normal is None else dr.zeros(mi.Normal3f, dr.width(zero))
    return layers + [VisibleSurface(far, zero, normal)] * (count - len(layers))


@dataclass(frozen=True)
class _Tracer:
    rays: StraightRays
    far: mi.Float  # depth, scene units: farther surfaces are not seen
    with_normals: bool

    def trace(
        self, camera: Camera, corner: mi.Point2f, x: Float | float, y: Float | float
    ) -> SurfaceLayers:
        """Return the surfaces at x, y from the corners of pixels, px."""
        place = corner + mi.Point2f(x, y)
        camera = camera.at_row(place.y)
        ray, active = self._camera_rays(camera, place)
        layers, rest = [], dr.ones(mi.Float, dr.width(ray))
        while True:
            ray, hit, opacity = self.rays.next_visible(ray, active)
            active = active & (rest * (1 - opacity) > MAX_INVISIBLE_OPACITY) & hit.is_valid()
            goes_on = self.rays.sees_through and dr.any(active)
            is_last = len(layers) == MAX_SURFACES - 1
            if goes_on and is_last:
                opacity = 1 - (1 - opacity) * self.rays.transmittance(
                    self.rays.continue_rays(ray, hit, active), active
                )
            layers.append(self._surface(camera, ray, hit, rest * opacity))
            if not goes_on or is_last:
                return layers
            rest = dr.select(active, rest * (1 - opacity), 0)
            ray = self.rays.continue_rays(ray, hit, active)
            dr.eval(ray, rest, active)

    def _camera_rays(self, camera: Camera, place: mi.Point2f) -> tuple[mi.Ray3f, mi.Bool]:
        """Return rays through places of the film (px), and whether the lens has one there."""
        origin, direction, seen = camera.look_through(place.x, place.y)
        direction = dr.normalize(direction)
        start, end = camera.lens.ray_range(direction, camera.near, self.far)
        to_world = camera.rotation.T
        first = mi.Point3f(camera.center + to_world @ (origin + start * direction))
        ray = mi.Ray3f(first, mi.Vector3f(to_world @ direction))
        ray.maxt = end - start
        return ray, dr.full(mi.Bool, True, dr.width(ray)) & mi.Bool(seen)

    def _surface(
        self, camera: Camera, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, coverage: mi.Float
    ) -> VisibleSurface:
        valid = coverage > 0
        point = ray.o + dr.select(valid, hit.t, 1) * ray.d
        _, _, depth = camera.lens.visibility(camera, camera.rotation @ (point - camera.center))
        normal = None
        if self.with_normals:
            frame = hit.compute_surface_interaction(ray, mi.RayFlags.ShadingFrame, valid).sh_frame
            towards = dr.select(dr.dot(frame.n, ray.d) > 0, -frame.n, frame.n)
            normal = dr.select(valid, coverage * mi.Normal3f(towards), 0)
        return VisibleSurface(dr.select(valid, depth, MISSING_SURFACE_DEPTH), coverage, normal)

    def trace_with_edges(
        self, camera: Camera, film: mi.Film, x: Float | float, y: Float | float
    ) -> SurfaceLayers:
        """Trace at one place of each pixel, or at several where coverage differs in its neighbours.

        One more row of pixels surrounds the crop window, which has the film's edges then. The host
        reads the number of edge pixels.
        """
        count = dr.prod(film.crop_size() + 2)
        width = dr.opaque(mi.UInt32, film.crop_size()[0] + 2)
        row = dr.arange(mi.UInt32, count) // width
        column = dr.arange(mi.UInt32, count) - row * width
        around = self.trace(camera, mi.Point2f(column, row) - 1, x, y)
        rest = transmittance_behind(around)
        dr.eval(around, rest)

        corner = pixel_corners(film)
        number = mi.UInt32(corner.y + 1) * width + mi.UInt32(corner.x + 1)
        own, differs = dr.gather(mi.Float, rest, number), mi.Bool(False)
        for down in (number - width, number, number + width):
            for neighbour in (down - 1, down, down + 1):
                differs |= dr.gather(mi.Float, rest, neighbour) != own
        edge = mi.UInt32(dr.compress(differs))
        layers = [surface.gather(number) for surface in around]
        if dr.width(edge) == 0:
            return layers
        corner = dr.gather(mi.Point2f, corner, edge)
        places = [(k + 0.5) / EDGE_GRID for k in range(EDGE_GRID)]
        hits = [self.trace(camera, corner, x, y) for y in places for x in places]
        most = max(map(len, [layers, *hits]))
        layers, hits = _pad(layers, most), [_pad(found, most) for found in hits]
        return [
            _with_means(surface, [found[k] for found in hits], edge)
            for k, surface in enumerate(layers)
        ]


def _with_means(
    surface: VisibleSurface, hits: Sequence[VisibleSurface], edge: mi.UInt32
) -> VisibleSurface:
    """Return ``surface`` with means over several rays in the pixels ``edge``."""
    covered = sum((h.coverage for h in hits), mi.Float(0))
    depth = sum((h.coverage * h.depth for h in hits), mi.Float(0))
    mean = depth / dr.select(covered > 0, covered, 1)
    depth = dr.select(covered > 0, mean, MISSING_SURFACE_DEPTH)
    means, planes = [depth, covered / len(hits)], [surface.depth, surface.coverage]
    if surface.normal is not None:
        normals = (h.normal for h in hits if h.normal is not None)
        means += list(sum(normals, mi.Normal3f(0)) / len(hits))
        planes += list(surface.normal)
    planes = [mi.Float(plane) for plane in planes]
    for plane, mean in zip(planes, means, strict=True):
        dr.scatter(plane, mean, edge)
    depth, coverage, *normal = planes
    return VisibleSurface(depth, coverage, mi.Normal3f(*normal) if normal else None)
