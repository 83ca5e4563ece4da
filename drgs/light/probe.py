"""Probes: the splats as seen from one place, in all directions.

A probe is a cube of six images around a centre: colour, coverage, and distance of the splats in
each direction. A ray that starts near the centre sees about the same points, in other directions:
the search for the first one goes along the ray in steps of about equal angle from the centre, until
the probe's distance in the direction of the current point is smaller. If it was smaller all the
time, the ray is occluded from the centre, and the probe has no answer.

Rays of rough surfaces read smaller images, of which each texel is the mean over a larger angle
(Krivanek and Colbert 2008, "Real-time Shading with Filtered Importance Sampling").

Nothing here is differentiated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from drgs.cameras.camera import Camera
from drgs.core.arrays import ArrayTypes, types_of
from drgs.core.types import Array3f, Bool, Float, UInt32
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.projection import GaussianRows
from drgs.splatting.rendering import Pipeline, render

CUBE_SIZE_TEXELS = 256  # texels of an edge of the largest cube
NUM_LEVELS = 7  # cubes of a probe, each with half the edge of the one before
LOW_PASS = 0.03  # low-pass filter of the images, px^2: rays have none
LAST_DISTANCE_LEVEL = 2  # whose distances are searched: means over larger angles are no surface
MAX_RAY_STEPS = 8  # most steps of a search along a ray
STEP_HALVINGS = 4  # halvings of the step in which a ray meets splats
MIN_SOLID_COVERAGE = 0.5  # smallest coverage that ends a ray
BORDER_TEXELS = 1  # texels around each image that repeat the neighbours', for interpolation
MIN_FIRST_STEP = 0.1  # of a ray from the centre, relative to the distance of the nearest splats
HIT_DISTANCE_SHARE = 0.98  # least distance of splats that a step meets, relative to that before it


@dataclass(frozen=True)
class ProbeHit:
    """Results of looking rays up in a probe."""

    color: Array3f  # times the coverage
    coverage: Float
    is_known: Bool  # whether the probe has an answer


@dataclass(frozen=True)
class Probes:
    """Probes; texels are ordered by probe, level, face, row and column."""

    centers: Array3f  # world, by probe
    normals: Array3f  # of the planes beyond which they see, by probe; 0: no plane
    nearest: Float  # world units, by probe: to the nearest splats
    colors: Float  # 4 a texel: colour times coverage; the last one is 0
    places: Float  # 2 a texel: coverage, and coverage by distance

    @staticmethod
    def render(
        gaussians: Gaussians,
        pipeline: Pipeline,
        centers: np.ndarray,
        near: float,
        decode: Callable[[Float], Float],
        planes: np.ndarray | None = None,
    ) -> Probes:
        """Render probes.

        pipeline: with the features colour and depth; centers: (P, 3) world; near: near plane, world
        units; decode: of colours; planes: (P, 4), normal n and offset h of each probe,
        which only sees splats at n . x >= h.
        """
        t = types_of(type(gaussians.means.array))
        planes = np.zeros((len(centers), 4)) if planes is None else planes
        texels, nearest = [], []
        for center, plane in zip(centers, planes, strict=True):
            beyond = _clip_to_plane(t, plane, pipeline)
            faces = [_face(center, k, gaussians, beyond, near, decode) for k in range(6)]
            levels = [_concatenate(faces)]
            for level in range(1, NUM_LEVELS):
                levels.append(_halve(levels[-1], CUBE_SIZE_TEXELS >> level))
            texels.append(_concatenate(levels))
            coverage, nearness = levels[0][3:]
            distance = dr.select(coverage > MIN_SOLID_COVERAGE, coverage / nearness, dr.inf)
            nearest.append(dr.select(dr.min(distance) < dr.inf, dr.min(distance), 1))
        columns = _concatenate(texels)
        index = dr.arange(t.UInt32, dr.width(columns[0]))
        colors, places = (dr.empty(t.Float, n * dr.width(columns[0])) for n in (4, 2))
        dr.scatter(colors, t.Array4f(*columns[:3], 0), index)
        dr.scatter(places, t.Array2f(columns[3:]), index)
        place, normals = (
            t.Array3f(*(t.Float(list(values)) for values in np.asarray(vectors, np.float64).T))
            for vectors in (centers, planes[:, :3])
        )
        found = Probes(place, normals, dr.concat(nearest), colors, places)
        dr.make_opaque(found)  # or each place would be a new kernel
        return found

    def look(
        self,
        probe: UInt32,
        origin: Array3f,
        direction: Array3f,
        far: Float,
        level: UInt32,
        active: Bool,
    ) -> ProbeHit:
        """Look up rays along unit directions up to ``far``; probe, level: of each ray."""
        t = types_of(type(far))
        start = origin - dr.gather(t.Array3f, self.centers, probe, active)
        reach = MIN_FIRST_STEP * dr.gather(t.Float, self.nearest, probe, active)
        reach = dr.maximum(reach, dr.norm(start))
        end = dr.select(far < dr.inf, far / (far + reach), 1)
        towards = direction * reach

        def place(u: Float) -> Array3f:
            """Return the offset from the centre times 1 - u; u: 0 at the start, 1 at infinity."""
            return start * (1 - u) + towards * u

        active &= dr.dot(dr.gather(t.Array3f, self.normals, probe, active), direction) >= 0
        cube = _Cube.from_level(probe, dr.minimum(level, LAST_DISTANCE_LEVEL))
        u, meets, is_known = self._search(place, end, cube, active)
        is_known &= active
        v, texels = place(u), _Cube.from_level(probe, level).bilinear_texels(place(u))
        colors = [w * dr.gather(t.Array4f, self.colors, texel, is_known) for texel, w in texels]
        places = [w * dr.gather(t.Array2f, self.places, texel, is_known) for texel, w in texels]
        red, green, blue, _ = sum(colors[1:], colors[0])
        coverage, nearness = sum(places[1:], places[0])
        # Splats too thin to be met count if they are before the ray's end.
        shows = is_known & (meets | (coverage * (1 - u) < nearness * dr.norm(v)))
        color = dr.select(shows, t.Array3f(red, green, blue), 0)
        return ProbeHit(color, dr.select(shows, coverage, 0), is_known)

    def _search(
        self, place: Callable[[Float], Array3f], end: Float, cube: _Cube, active: Bool
    ) -> tuple[Float, Bool, Bool]:
        """Find where rays meet the splats, or end; whether they meet any; whether that is known."""
        t = types_of(type(end))

        def look(u: Float, active: Bool) -> tuple[Float, Float, Bool]:
            """Return the distances of a place and of splats there, and whether these are nearer."""
            v = place(u)
            coverage, nearness = dr.gather(t.Array2f, self.places, cube.nearest(v), active)
            is_solid, r = coverage > MIN_SOLID_COVERAGE, dr.norm(v)
            is_behind = is_solid & (r * nearness > (1 - u) * coverage)
            return r / (1 - u), dr.select(is_solid, coverage / nearness, dr.inf), is_behind

        def step(k: UInt32, before: Float, meets: Bool, is_known: Bool) -> tuple:
            r, distance, is_behind = look(end * (t.Float(k) / MAX_RAY_STEPS), active)
            meets = is_behind & (distance > HIT_DISTANCE_SHARE * before)
            return k + 1, r, meets, meets | ~is_behind

        r, _, is_behind = look(end * (0.01 / MAX_RAY_STEPS), active)
        nothing = dr.full(t.Bool, False, dr.width(r))
        k, _, meets, is_known = dr.while_loop(
            state=(dr.ones(t.UInt32, dr.width(r)), r, nothing, ~is_behind),
            cond=lambda k, before, meets, is_known: (
                active & (k <= MAX_RAY_STEPS) & ~meets & is_known
            ),
            body=step,
        )
        high = end * (t.Float(k - 1) / MAX_RAY_STEPS)
        low = high - end / MAX_RAY_STEPS
        for _ in range(STEP_HALVINGS):
            u = 0.5 * (low + high)
            _, _, is_behind = look(u, active & meets)
            low, high = dr.select(is_behind, low, u), dr.select(is_behind, u, high)
        return dr.select(meets, high, end), meets, is_known


def _clip_to_plane(t: ArrayTypes, plane: np.ndarray, pipeline: Pipeline) -> Pipeline:
    """Return a pipeline without the Gaussians whose means are on the other side of a plane."""
    *normal, offset = (dr.opaque(t.Float, float(value)) for value in plane)

    def rows(rows: GaussianRows) -> GaussianRows:
        rows = pipeline.rows(rows)
        is_beyond = dr.dot(t.Array3f(*normal), t.Array3f(rows.means)) >= offset
        return replace(rows, logit_opacities=dr.select(is_beyond, rows.logit_opacities, -dr.inf))

    return replace(pipeline, rows=rows)


def _num_texels(level: int) -> int:
    return 6 * ((CUBE_SIZE_TEXELS >> level) + 2 * BORDER_TEXELS) ** 2


NUM_TEXELS = sum(map(_num_texels, range(NUM_LEVELS)))


@dataclass(frozen=True)
class _Cube:
    first: UInt32
    size: UInt32  # texels of an edge, without border

    @staticmethod
    def from_level(probe: UInt32, level: UInt32) -> _Cube:
        UInt32 = type(level)
        before, first = 0, UInt32(0)
        for k in range(NUM_LEVELS):
            first = dr.select(level == k, before, first)
            before += _num_texels(k)
        return _Cube(probe * UInt32(NUM_TEXELS) + first, UInt32(CUBE_SIZE_TEXELS) >> level)

    def nearest(self, v: Array3f) -> UInt32:
        """Return the texel in the direction of a vector."""
        face, x, y = _place_on_cube(v)
        UInt32, size = type(self.size), type(x)(self.size)
        last = self.size - 1
        column, row = (dr.minimum(UInt32(place * size), last) + BORDER_TEXELS for place in (x, y))
        return self._texel(face, column, row)

    def bilinear_texels(self, v: Array3f) -> list[tuple[UInt32, Float]]:
        """Return four texels around the direction of a vector, and their weights."""
        face, x, y = _place_on_cube(v)
        UInt32, Float = type(self.size), type(x)
        x, y = (place * Float(self.size) + (BORDER_TEXELS - 0.5) for place in (x, y))
        column, row = UInt32(x), UInt32(y)
        texel, edge = self._texel(face, column, row), self.size + 2 * BORDER_TEXELS
        return bilinear_texels(texel, edge, x - Float(column), y - Float(row))

    def _texel(self, face: UInt32, column: UInt32, row: UInt32) -> UInt32:
        edge = self.size + 2 * BORDER_TEXELS
        return self.first + (face * edge + row) * edge + column


def bilinear_texels(
    texel: UInt32, width: UInt32, right: Float, down: Float
) -> list[tuple[UInt32, Float]]:
    """Return four texels and weights; texel: the upper left one; right, down: from it, 0..1."""
    return [
        (texel, (1 - right) * (1 - down)),
        (texel + 1, right * (1 - down)),
        (texel + width, (1 - right) * down),
        (texel + width + 1, right * down),
    ]


def _place_on_cube(v: Array3f) -> tuple[UInt32, Float, Float]:
    """Return the face that a vector points to (+x, -x, ...), and the place, 0..1 from its corner.

    On the face of an axis, the next axis points right and the one after it down; on the opposite
    face the other way around, so that neither is mirrored.
    """
    x, y, z = (dr.abs(c) for c in v)
    is_x = (x >= y) & (x >= z)
    is_y = ~is_x & (y >= z)
    along = dr.select(is_x, v[0], dr.select(is_y, v[1], v[2]))
    right = dr.select(is_x, v[1], dr.select(is_y, v[2], v[0]))
    down = dr.select(is_x, v[2], dr.select(is_y, v[0], v[1]))
    is_negative = along < 0
    half = 0.5 / dr.abs(along)
    right, down = (dr.clip(dr.fma(c, half, 0.5), 0, 1) for c in (right, down))
    UInt32 = types_of(type(along)).UInt32
    face = dr.select(is_x, UInt32(0), dr.select(is_y, UInt32(2), 4))
    face += dr.select(is_negative, UInt32(1), 0)
    return face, dr.select(is_negative, down, right), dr.select(is_negative, right, down)


def _face(
    center: np.ndarray,
    number: int,
    gaussians: Gaussians,
    pipeline: Pipeline,
    near: float,
    decode: Callable[[Float], Float],
) -> list[Float]:
    """Render red, green, blue, coverage, nearness of a cube's side (+x, -x, ...) with borders."""
    Float = type(gaussians.means.array)
    UInt32, edge = types_of(Float).UInt32, CUBE_SIZE_TEXELS + 2 * BORDER_TEXELS
    axis, is_negative = divmod(number, 2)
    forward, right, down = (np.eye(3)[(axis + k) % 3] for k in range(3))
    if is_negative:
        forward, right, down = -forward, down, right
    focal, middle = CUBE_SIZE_TEXELS / 2, edge / 2
    K = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    camera = Camera.create(Float, np.stack([right, down, forward]), center, K, edge, edge, near)
    T, *color, depth = render(gaussians, camera, pipeline).planes()
    coverage = 1 - T
    shows = coverage > 0
    color = [decode(c / dr.select(shows, coverage, 1)) for c in color]
    texel = dr.arange(UInt32, edge * edge)
    x, y = (
        (Float(p) + (0.5 - edge / 2)) * (2 / CUBE_SIZE_TEXELS)
        for p in (texel % edge, texel // edge)
    )
    distance = depth * dr.sqrt(1 + x * x + y * y)  # times coverage
    nearness = dr.select(shows & (distance > 0), coverage * coverage / distance, 0)
    columns = [*(c * coverage for c in color), coverage, nearness]
    dr.eval(columns)
    return columns


def _concatenate(parts: list[list[Float]]) -> list[Float]:
    columns = [dr.concat(columns) for columns in zip(*parts, strict=True)]
    dr.eval(columns)
    return columns


def _halve(columns: list[Float], size: int) -> list[Float]:
    """Downsample a cube to ``size`` texels an edge, from twice as many: means of four places."""
    t = types_of(type(columns[0]))
    edge, larger = size + 2 * BORDER_TEXELS, _Cube(t.UInt32(0), t.UInt32(2 * size))
    index = dr.arange(t.UInt32, 6 * edge * edge)
    face, row, column = index // (edge * edge), index // edge % edge, index % edge
    means = [t.Float(0) for _ in columns]
    for dx, dy in ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)):
        right, down = (
            (t.Float(p) + (d - BORDER_TEXELS)) * (2 / size) - 1
            for p, d in ((column, dx), (row, dy))
        )
        for texel, weight in larger.bilinear_texels(_vector_to(face, right, down)):
            values = (dr.gather(t.Float, values, texel) for values in columns)
            means = [dr.fma(0.25 * weight, v, m) for v, m in zip(values, means, strict=True)]
    dr.eval(means)
    return means


def _vector_to(face: UInt32, right: Float, down: Float) -> Array3f:
    """Return the vector to a place of a face, -1..1; beyond it, to a neighbour."""
    t = types_of(type(right))
    axis, is_negative = face >> 1, (face & 1) == 1
    right, down = dr.select(is_negative, down, right), dr.select(is_negative, right, down)
    along = dr.select(is_negative, t.Float(-1), 1)
    values = [along, right, down]
    turned = [
        dr.select(axis == 0, values[k], dr.select(axis == 1, values[k - 1], values[k - 2]))
        for k in range(3)
    ]
    return t.Array3f(turned)
