"""Flat mirrors: the splats as seen by cameras that are mirrored in their planes.

A camera ray continues behind a flat mirror along a ray of the mirrored camera, and meets the splats
of that one's image, which has a few texels for each pixel. Splats on the other side of the plane
are left out, and so are those behind the surface that the mirrored ray meets: a ray reads only the
texels around it whose rays end where it does. Rays that leave the plane along none of the mirrored
camera's rays, after other bounces or scattered, have no answer.

Nothing here is differentiated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.accuracy.pipeline import pipeline_of
from drgs.accuracy.pixel_order import PixelOrder
from drgs.cameras.camera import Camera
from drgs.cameras.lens import Lens, Pinhole
from drgs.config.approximations import Approximations
from drgs.effects.compose import with_effects
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.film import decode
from drgs.integrator.light.rays import PathSegment, StraightRays, has_transparent_parts
from drgs.integrator.sensors import SensorState, camera_from_sensor
from drgs.light.probe import LOW_PASS, ProbeHit, bilinear_texels
from drgs.splatting.rendering import Pipeline, render

TEXELS_PER_PIXEL = 2  # texels per pixel of a small film, along either axis

FINE_TEXELS, MAX_TEXELS = 2**21, 2**26
"""Texels of all images, 20 bytes each, from which on a pixel has fewer; and fewer than one."""

BORDER_TEXELS = 8  # texels around an image: filters of the film reach beyond its edge
MAX_RELATIVE_DEPARTURE = 1e-5  # of vertices from the plane of a flat shape, relative to its size
MAX_ROUNDING_DEPARTURE = 1e-6  # the same, relative to the coordinates: both are allowed
MAX_RAY_OFFSET = 1e-3  # distance between a ray and the camera's, relative to that from the camera
MAX_ROUNDING_OFFSET = 2e-4  # the same, relative to coordinates: twice the offset of Mitsuba's rays
MIN_TEXEL_WEIGHT = 1e-3  # smallest weight, of 1, of the texels around a ray that end where it does
MAX_END_DISTANCES = (0.1, 0.01)  # of equal ends, relative to the lengths from and to the mirror


@dataclass(frozen=True)
class Plane:
    """Points x with normal . x = offset, world."""

    normal: mi.Vector3f  # unit
    offset: mi.Float

    def height(self, point: mi.Vector3f) -> mi.Float:
        """Return the signed distance of a point."""
        return dr.dot(self.normal, point) - self.offset

    def mirror(self, camera: Camera) -> Camera:
        """Mirror a camera, whose axes then have the other handedness."""
        n = self.normal
        axes, center = map(mi.Vector3f, camera.rotation), mi.Vector3f(camera.center)
        rotation = type(camera.rotation)([list(axis - 2 * dr.dot(axis, n) * n) for axis in axes])
        center = type(camera.center)(center - 2 * self.height(center) * n)
        return replace(camera, rotation=rotation, center=center)


@dataclass(frozen=True)
class FlatMirror:
    """A flat shape that reflects light about in a mirror's direction."""

    normal: list[float]  # world, unit
    offset: float  # of the plane along it
    has_delta: bool  # whether a part of the light goes exactly there
    is_specular: bool  # whether all reflected light goes about there

    @staticmethod
    def from_shape(shape: mi.Shape) -> FlatMirror | None:
        """Recognise a mirror; None for all other shapes, and for emitters."""
        bsdf = shape.bsdf()
        if bsdf is None or shape.is_emitter():
            return None
        flags, kinds = bsdf.flags(), mi.BSDFFlags
        delta = mi.has_flag(flags, kinds.DeltaReflection)
        glossy = mi.has_flag(flags, kinds.GlossyReflection)
        diffuse = mi.has_flag(flags, kinds.DiffuseReflection)
        through = mi.has_flag(flags, kinds.Transmission)
        plane = _plane_through(_points(shape)) if delta or glossy else None
        return plane and FlatMirror(*plane, delta, not (diffuse or through))

    def mirror_camera(self, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mirrored centre (3,), and the plane (4,) with its normal to the camera."""
        normal = np.array(self.normal)
        height = normal @ center - self.offset
        plane = np.sign(height) * np.array([*normal, self.offset])
        return center - 2 * height * normal, plane


def _points(shape: mi.Shape) -> np.ndarray:
    """Return points (N, 3) of a shape, world, on its plane if it is flat; none if it cannot be."""
    if isinstance(shape, mi.Mesh):
        vertices = dr.arange(mi.UInt32, shape.vertex_count())
        return np.array(shape.vertex_position(vertices), np.float64).T
    if shape.class_name() != "Disk":
        return np.zeros((0, 3))
    to_world = mi.traverse(shape)["to_world"]
    assert isinstance(to_world, mi.AffineTransform4f), "of a disk"
    matrix = np.array(to_world.matrix, np.float64).reshape(4, 4)
    return np.array([[0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1]]) @ matrix[:3].T


def _plane_through(points: np.ndarray) -> tuple[list[float], float] | None:
    """Fit normal and offset of the plane of points (N, 3); None where there is not just one."""
    if len(points) < 3 or not np.isfinite(points).all():
        return None
    middle = points.mean(0)
    offsets = points - middle
    extents, axes = np.linalg.eigh(offsets.T @ offsets)  # from the least on
    slack = MAX_RELATIVE_DEPARTURE * np.abs(offsets).max()
    slack += MAX_ROUNDING_DEPARTURE * np.abs(points).max()
    if extents[1] <= 1e-10 * extents[2] or np.abs(offsets @ axes[:, 0]).max() > slack:
        return None
    return axes[:, 0].tolist(), float(axes[:, 0] @ middle)


@dataclass(frozen=True, eq=False)
class Mirrors:
    """Images of the splats in mirrors, for each camera."""

    planes: Plane  # by mirror
    views: list[_View]  # by camera

    @staticmethod
    def render(
        mirrors: Sequence[FlatMirror],
        states: Sequence[SensorState],
        scene: mi.Scene,
        gaussians: Gaussians,
        approximations: Approximations,
        sh_degree: int,
    ) -> Mirrors:
        """Render the images, of cameras that do not move; scene: of the surfaces."""
        normals = np.array([mirror.normal for mirror in mirrors], np.float32)
        every = Plane(mi.Vector3f(normals.T), mi.Float([mirror.offset for mirror in mirrors]))
        cameras = [c for c in map(camera_from_sensor, states) if c.shutter is None]
        num_pixels = max(1, len(mirrors) * sum(c.width * c.height for c in cameras))
        fine, least = (math.sqrt(most / num_pixels) for most in (FINE_TEXELS, MAX_TEXELS))
        scale = min(TEXELS_PER_PIXEL, max(1.0, fine), least)
        cameras = [_enlarge(camera, scale) for camera in cameras]
        views = []
        for camera in cameras:
            pipeline = _pipeline(approximations, sh_degree, camera.lens)
            images = [
                _render_mirror(
                    camera, dr.gather(Plane, every, mi.UInt32(k)), scene, gaussians, pipeline
                )
                for k in range(len(mirrors))
            ]
            colors, ends = (dr.concat(parts) for parts in zip(*images, strict=True))
            size = mi.Vector2u(*(dr.opaque(mi.UInt32, n) for n in (camera.width, camera.height)))
            views.append(_View(camera, size, colors, ends))
        dr.make_opaque(every, views)
        return Mirrors(every, views)

    def look(self, mirror: mi.UInt32, segment: PathSegment, active: mi.Bool) -> ProbeHit:
        """Look up the splats along segments that leave a mirror; mirror: its number."""
        plane, ray = dr.gather(Plane, self.planes, mirror, active), segment.ray
        origin = ray.o - 2 * plane.height(ray.o) * plane.normal
        direction = ray.d - 2 * dr.dot(plane.normal, ray.d) * plane.normal
        color, coverage, is_known = mi.Color3f(0), mi.Float(0), mi.Bool(False)
        for view in self.views:
            seen = view.look(mirror, origin, direction, ray.maxt, active & ~is_known)
            color = dr.select(seen.is_known, seen.color, color)
            coverage = dr.select(seen.is_known, seen.coverage, coverage)
            is_known |= seen.is_known
        return ProbeHit(color, coverage, is_known)


@dataclass(frozen=True, eq=False)
class _View:
    """Images of the splats that one camera sees in each mirror."""

    camera: Camera  # with a pixel for each texel
    size: mi.Vector2u  # width and height, opaque
    colors: mi.Float  # 4 a texel: linear red, green, blue, times the coverage; coverage
    ends: mi.Float  # by texel: distance from the camera to the ray's end

    def look(
        self,
        mirror: mi.UInt32,
        origin: mi.Vector3f,
        direction: mi.Vector3f,
        far: mi.Float,
        active: mi.Bool,
    ) -> ProbeHit:
        """Look up mirrored rays that continue along those of the camera."""
        camera, rounding = self.camera, MAX_ROUNDING_OFFSET * (1 + dr.max(dr.abs(origin)))
        origin = camera.rotation @ (mi.Vector3f(origin) - camera.center)
        direction = camera.rotation @ mi.Vector3f(direction)
        place, off = camera.place_of_ray(origin, direction)
        start, towards, is_seen = camera.look_through(place.x, place.y)
        way = origin - start
        distance = dr.norm(way)
        off += MAX_RAY_OFFSET * distance + rounding
        active = active & is_seen & (dr.dot(towards, direction) > 0) & (dr.dot(way, direction) > 0)
        active &= dr.norm(dr.cross(way, direction)) <= off
        x, y = place - 0.5
        width, height = self.size
        active &= (x >= 0) & (y >= 0) & (x + 1 < mi.Float(width)) & (y + 1 < mi.Float(height))
        column, row = mi.UInt32(x), mi.UInt32(y)
        right, down = x - mi.Float(column), y - mi.Float(row)
        first = mirror * (width * height) + row * width + column
        total, weights = mi.Vector4f(0), mi.Float(0)
        for texel, weight in bilinear_texels(first, width, right, down):
            end = dr.gather(mi.Float, self.ends, texel, active)
            weight = dr.select(_is_same(distance, far, end), weight, 0)
            total += weight * dr.gather(mi.Vector4f, self.colors, texel, active)
            weights += weight
        is_known = active & (weights > MIN_TEXEL_WEIGHT)
        *color, coverage = dr.select(is_known, total / weights, 0)
        return ProbeHit(mi.Color3f(color), coverage, is_known)


def _is_same(distance: mi.Float, far: mi.Float, end: mi.Float) -> mi.Bool:
    """Return whether a ray ends at ``end``; distance, far: its lengths to and from the mirror."""
    of_far, of_distance = MAX_END_DISTANCES
    is_near = dr.abs(distance + far - end) <= of_far * far + of_distance * distance
    return dr.select((far < dr.inf) & (end < dr.inf), is_near, (far < dr.inf) == (end < dr.inf))


def _pipeline(approximations: Approximations, sh_degree: int, lens: Lens) -> Pipeline:
    """Build the pipeline that renders Gaussians as rays meet them, as far as a lens allows."""
    projection = "exact"
    if not isinstance(lens, Pinhole):
        projection = "ewa" if lens.parallel else "unscented"  # the former is exact then
    along_rays = {"low_pass": LOW_PASS, "order": "pixel", "sh_direction": "pixel"}
    return pipeline_of(replace(approximations, projection=projection, **along_rays), sh_degree)


def _enlarge(camera: Camera, scale: float) -> Camera:
    factor = dr.opaque(mi.Float, scale)
    places = ("principal", "film_start", "film_end")
    changes = {name: factor * getattr(camera, name) + BORDER_TEXELS for name in places}
    camera = replace(
        camera,
        focal=factor * camera.focal,
        width=math.ceil(scale * camera.width) + 2 * BORDER_TEXELS,
        height=math.ceil(scale * camera.height) + 2 * BORDER_TEXELS,
        **changes,
    )
    dr.make_opaque(camera)
    return camera


def _render_mirror(
    camera: Camera, plane: Plane, scene: mi.Scene, gaussians: Gaussians, pipeline: Pipeline
) -> tuple[mi.Float, mi.Float]:
    """Render the splats that the camera sees in a mirror: see :class:`_View`."""
    side = dr.sign(plane.height(mi.Vector3f(camera.center)))
    plane = Plane(side * plane.normal, side * plane.offset)
    camera = plane.mirror(camera)
    dr.make_opaque(plane, camera)
    nearest, farthest, ends = _trace(camera, plane, scene)
    pipeline = with_effects(pipeline, gaussians, camera)
    assert isinstance(pipeline.order, PixelOrder), "see _pipeline"
    depths = replace(pipeline.order.depths, bounds=(nearest, farthest))
    order = replace(pipeline.order, depths=depths)
    T, *color = render(gaussians, camera, replace(pipeline, order=order)).planes()
    coverage = 1 - T
    colors = mi.Float(dr.ravel(mi.Vector4f(*decode(mi.Color3f(color), coverage), coverage)))
    dr.eval(colors, ends)
    return colors, ends


def _trace(camera: Camera, plane: Plane, scene: mi.Scene) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Return the depths where mirrored camera rays pass the mirror and end, and their lengths."""
    texel = dr.arange(mi.UInt32, camera.width * camera.height)
    width = dr.opaque(mi.UInt32, camera.width)
    row = texel // width
    x, y = mi.Float(texel - row * width) + 0.5, mi.Float(row) + 0.5
    origin, direction, is_seen = camera.look_through(x, y)
    to_world = camera.rotation.T
    origin = mi.Point3f(camera.center + to_world @ origin)
    direction = mi.Vector3f(dr.normalize(to_world @ direction))
    t = -plane.height(mi.Vector3f(origin)) / dr.dot(plane.normal, direction)
    is_seen &= t > 0
    start = dr.fma(direction, t, origin)

    def depth(far: mi.Float, exists: mi.Bool) -> mi.Float:
        point = camera.rotation @ (mi.Vector3f(start) + far * direction - camera.center)
        return dr.select(exists, camera.lens.visibility(camera, point)[2], dr.inf)

    off = mi.math.RayEpsilon * (1 + dr.max(dr.abs(start)))  # as Mitsuba does
    rays = StraightRays(scene, False, has_transparent_parts(scene))
    ray, hit, _ = rays.next_visible(mi.Ray3f(start + off * plane.normal, direction), is_seen)
    hits = is_seen & hit.is_valid()
    end = dr.dot(ray.o - start, direction) + hit.t
    found = depth(mi.Float(0), is_seen), depth(end, hits), dr.select(hits, t + end, dr.inf)
    dr.eval(found)
    return found
