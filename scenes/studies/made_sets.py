"""Render two kinds of dataset that the studies lack: a landscape under a sky, and a room.

``outdoor`` has textured things in the middle of an arc of cameras, hills and houses at 20 to 60
times the cameras' distance, and a sky. ``outdoor_far`` and ``outdoor_unseen`` are other cameras of
it, to measure on only: farther back, and turned outward. In ``room``, cameras stand 3 to 5 m from
what they look at, and 0.3 to 0.6 m.

Each is a folder in nerfstudio's layout, with points on surfaces as structure from motion would find
them. All views of a folder that is to measure on are listed to train on: read it with ``--set
data.test_split=train``. Lengths are metres, z is up. Takes ten minutes on two idle cores.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import drgs  # noqa: F401  first: finds libLLVM
import mitsuba as mi
import numpy as np
from drgs.cameras.viewpoints import (
    OPENCV_TO_MITSUBA,
    Viewpoint,
    between_opencv_and_opengl,
    look_at,
    pinhole,
)
from drgs.capture.dataset import write_points
from drgs.cli.progress import RunProgress
from drgs.core.files import write_json
from drgs.integrator.scene import film_description
from drgs.io.images import read_image, to_uint8, write_png
from scipy.ndimage import map_coordinates
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, FOV = 400, 300, 62.0  # px; degrees, horizontal
EXPOSURE = 1.4
SPP, MAX_DEPTH = 144, 3  # a square, as samples are stratified; segments of a path
TEST_EVERY = 8  # the loader's default; points are not taken from test views
NUM_POINTS, POINT_NOISE = 5000, 5e-4  # noise: a share of the distance from the nearest camera
RAY_TOLERANCE = 1e-3  # of a point's distance, by which a ray to it may end before it

TEXTURE = 1024  # px
NEAR_GROUND, HORIZON = 14.0, 400.0  # m: half of the side of the finest ground; its last radius
SUN = np.array([0.46, -0.66, 0.6]) / math.hypot(0.46, 0.66, 0.6)  # direction to it
ROOM = np.array([2.7, 2.2, 1.3])  # m, half of its sides
UP = np.array([0.0, 0.0, 1.0])

WOOD, BRICKS, ROOF = "4a2f1b 8a5c34 b98a55", "6b2f22 a5523a c98662", "3d2b2b 7a3b30 a8604a"
STONE, LEAVES, BARK = "4c4a46 8b877e b9b3a6", "16260f 2f4f1c 5d8030 94a850", "2a1d13 6d5138"
BOOKS = "7a2420 c05a48", "1f3d56 5f8fae", "2b4a33 7c9a6a", "8a6a2c d8bf7a", "b8b0a0 e6dfce"
PLASTER, MANY = "b9b0a0 d8d0c0 e8e2d4", "b5382e d9a441 e8dcc0 3f7f6c 27506e 5a3a63 c96f3b"


# ----------------------------------------------------------------------------------------------
# Textures: (H, W, 3), display space
# ----------------------------------------------------------------------------------------------


def fractal(rng: np.random.Generator, slope: float = 1.3, stretch: float = 1) -> np.ndarray:
    """Return periodic noise in 0..1 with amplitudes f^-slope, drawn out along x by ``stretch``."""
    f = np.fft.fftfreq(TEXTURE, 1 / TEXTURE)
    spectrum = np.fft.fft2(rng.normal(size=(TEXTURE, TEXTURE)))
    spectrum /= np.maximum(np.hypot(f[:, None], stretch * f), 1) ** slope
    spectrum[0, 0] = 0
    noise = np.fft.ifft2(spectrum).real
    return np.clip(0.5 + 0.22 * noise / noise.std(), 0, 1)


def ramp(values: np.ndarray, colors: str) -> np.ndarray:
    """Return colours (..., 3) for values in 0..1, between evenly spaced ones such as ``b05a3c``."""
    table = np.array([list(bytes.fromhex(color)) for color in colors.split()]) / 255
    steps = np.linspace(0, 1, len(table))
    return np.stack([np.interp(values, steps, channel) for channel in table.T], axis=-1)


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Return the cubic step from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def cloth(rng: np.random.Generator, colors: str, slope: float = 0.8) -> np.ndarray:
    """Return noise in colours of a ramp: fabric, leaves, plaster."""
    return ramp(fractal(rng, slope), colors)


def masonry(
    rng: np.random.Generator, rows: int, columns: int, colors: str, grain: float = 1
) -> np.ndarray:
    """Return bricks, planks or tiles of a tint each, with dark joints."""
    y, x = np.mgrid[:TEXTURE, :TEXTURE] / TEXTURE
    row = np.floor(y * rows).astype(int)
    u, v = x * columns + 0.5 * (row % 2), y * rows % 1
    tint = rng.uniform(size=(rows, columns))[row, np.floor(u).astype(int) % columns]
    image = ramp(0.55 * tint + 0.6 * fractal(rng, 1.0, grain) - 0.08, colors)
    edge = np.minimum(np.minimum(v, 1 - v), np.minimum(u % 1, 1 - u % 1) * rows / columns)
    return image * (0.35 + 0.65 * smoothstep(0.02, 0.08, edge))[..., None]


def patchwork(rng: np.random.Generator, cells: int, colors: str = MANY) -> np.ndarray:
    """Return the cells of a Voronoi diagram in a colour each, with noise."""
    places = np.moveaxis(np.mgrid[:TEXTURE, :TEXTURE], 0, -1) / TEXTURE
    _, nearest = KDTree(rng.uniform(size=(cells, 2))).query(places)
    shade = 0.55 + 0.45 * fractal(rng, 0.9)
    return ramp(rng.uniform(size=cells), colors)[nearest] * shade[..., None]


def facade(rng: np.random.Generator, floors: int, colors: str) -> np.ndarray:
    """Return bricks with two windows a floor, and a door between them; the first row is lowest."""
    image, height = masonry(rng, 14 * floors, 8 * floors, colors), TEXTURE // floors
    frame, glass = cloth(rng, "c8c2b2 f4f0e4"), cloth(rng, "1c2733 4b6a86 a9c4d4", 1.6)
    planks = masonry(rng, 1, 40, WOOD)
    for floor, (left, right) in product(range(floors), ((0.1, 0.33), (0.42, 0.6), (0.68, 0.9))):
        door = left == 0.42 and floor == 0
        low, high = (0, 0.7) if door else (floor + 0.35, floor + 0.8)
        rows, columns = (
            slice(round(a * h), round(b * h))
            for a, b, h in ((low, high, height), (left, right, TEXTURE))
        )
        image[rows, columns] = frame[rows, columns]
        rows, columns = (slice(s.start + 12, s.stop - 12) for s in (rows, columns))
        image[rows, columns] = (planks if door else glass)[rows, columns]
    return image


# ----------------------------------------------------------------------------------------------
# Surfaces
# ----------------------------------------------------------------------------------------------


class SceneParts:
    """The surfaces of a scene, one mesh a texture, and other parts of its description."""

    def __init__(self, **parts: object) -> None:
        self._parts = parts
        self._grids: dict[int, tuple[np.ndarray, list[np.ndarray]]] = {}  # by id of the texture

    def grids(self, points: np.ndarray, texture: np.ndarray) -> None:
        """Add smooth grids (K, H, W, 3), each of which shows the texture, its rows along H."""
        self._grids.setdefault(id(texture), (texture, []))[1].append(points)

    def box(
        self, center: Sequence[float], half: Sequence[float], texture: np.ndarray, yaw: float = 0,
        roll: float = 0,
    ) -> None:  # fmt: skip
        """Add a box; half: of its sides; roll, yaw: degrees, about x and then about z."""
        turn = Rotation.from_euler("xz", [roll, yaw], degrees=True).as_matrix()
        self.grids(CUBE * half @ turn.T + center, texture)

    def ball(self, center: Sequence[float], radius: float, texture: np.ndarray) -> None:
        """Add a sphere."""
        rng = np.random.default_rng(0)
        self.grids(blobs(rng, np.array([center]), np.full((1, 3), radius), 0), texture)

    def house(
        self,
        base: Sequence[float],
        half: Sequence[float],
        yaw: float,
        wall: np.ndarray,
        roof: np.ndarray,
    ) -> None:
        """Add a house with a gable roof of 45 degrees, its ridge along its own x axis."""
        (x, y, z), (length, depth, height) = base, half
        side, turn = depth / math.sqrt(2), math.radians(yaw)
        self.box((x, y, z + height), half, wall, yaw)
        self.box((x, y, z + 2 * height), (0.98 * length, side, side), wall, yaw, 45)
        for sign in (-1, 1):
            out, up = 0.52 * sign * depth, 2 * height + 0.52 * depth
            center = (x - out * math.sin(turn), y + out * math.cos(turn), z + up)
            self.box(center, (1.1 * length, 1.15 * side, 0.04 * depth), roof, yaw, -45 * sign)

    def tree(
        self,
        rng: np.random.Generator,
        base: Sequence[float],
        size: float,
        leaves: np.ndarray,
        bark: np.ndarray,
    ) -> None:
        """Add a trunk and a clump of lumpy ellipsoids; size: height, m."""
        trunk = np.array([[0.04, 0.04, 0.5]]) * size
        self.grids(blobs(rng, np.array([base]) + 0.3 * size * UP, trunk, 0.05), bark)
        centers = base + size * (np.clip(rng.normal(size=(26, 3)), -1.5, 1.5) * 0.14 + 0.68 * UP)
        self.grids(blobs(rng, centers, size * rng.uniform(0.07, 0.16, (26, 3)), 0.12), leaves)

    def scene(self) -> mi.Scene:
        """Return the scene."""
        meshes = {f"mesh{k}": _mesh(*each) for k, each in enumerate(self._grids.values())}
        return mi.load_dict({"type": "scene", **self._parts, **meshes})


def _mesh(texture: np.ndarray, grids: Sequence[np.ndarray]) -> mi.Mesh:
    vertices, coordinates, faces, start = [], [], [], 0
    for points in grids:
        count, height, width, _ = points.shape
        k = start + np.arange(count * height * width).reshape(count, height, width)
        a, b, c, d = k[:, :-1, :-1], k[:, :-1, 1:], k[:, 1:, :-1], k[:, 1:, 1:]
        faces.append(np.stack([a, b, d, a, d, c], axis=-1).ravel())
        uv = np.stack(np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height)), axis=-1)
        coordinates.append(np.broadcast_to(uv, (count, height, width, 2)).ravel())
        vertices.append(points.ravel())
        start += k.size
    bitmap = mi.Bitmap(np.asarray(texture**2.2, np.float32))
    reflectance = {"type": "bitmap", "bitmap": bitmap, "raw": True}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(
        {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    )
    indices = np.concatenate(faces)
    mesh = mi.Mesh("grids", start, len(indices) // 3, properties, True, True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.float32(np.concatenate(vertices)))
    parameters["vertex_texcoords"] = mi.Float(np.float32(np.concatenate(coordinates)))
    parameters["faces"] = mi.UInt32(np.uint32(indices))
    parameters.update()
    return mesh


def _cube() -> np.ndarray:
    """Return the faces (6, 2, 2, 3) of a cube of half side 1; rows of the sides go up."""
    signs = np.array([-1.0, 1.0])
    faces = []
    for (u, v), side in product(((0, 2), (1, 2), (0, 1)), signs):
        face = np.full((2, 2, 3), side)
        face[..., u], face[..., v] = np.meshgrid(signs, signs)
        faces.append(face)
    return np.array(faces)


CUBE = _cube()


def blobs(
    rng: np.random.Generator, centers: np.ndarray, radii: np.ndarray, lumps: float
) -> np.ndarray:
    """Return grids (K, 18, 28, 3) of ellipsoids whose radii vary by the share ``lumps``."""
    phi, theta = np.meshgrid(np.linspace(0, 2 * np.pi, 28), np.linspace(np.pi - 1e-3, 1e-3, 18))
    sphere = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    phases = np.einsum("hwd,ksd->khws", sphere, 4 * rng.normal(size=(len(centers), 6, 3)))
    phases += 2 * np.pi * rng.uniform(size=(len(centers), 1, 1, 6))
    bumps = 1 + lumps * np.sin(phases).sum(axis=-1, keepdims=True) / math.sqrt(3)
    return centers[:, None, None] + radii[:, None, None] * sphere * bumps


# ----------------------------------------------------------------------------------------------
# Outdoor
# ----------------------------------------------------------------------------------------------


class Landscape:
    """Heights and colours of the ground, by places x, y of one shape, m."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._noise = fractal(rng, 1.1)
        self._waves = rng.normal(size=(9, 2)) / 60
        self._phases = rng.uniform(0, 2 * np.pi, 9)
        self._fields = KDTree(rng.uniform(-HORIZON, HORIZON, (500, 2)))
        self._tints = rng.uniform(size=500)

    def noise(self, x: np.ndarray, y: np.ndarray, period: float) -> np.ndarray:
        """Return noise in 0..1 that repeats after ``period``, m."""
        at = np.stack([y, x]) * (TEXTURE / period)
        return map_coordinates(self._noise, at, order=1, mode="grid-wrap")

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return heights: flat in the middle, hills far away."""
        wave = sum(
            np.sin(kx * x + ky * y + phase)
            for (kx, ky), phase in zip(self._waves, self._phases, strict=True)
        )
        radius = np.hypot(x, y)
        return smoothstep(50, 0.9 * HORIZON, radius) * (34 + 13 * wave)

    def colors(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return colours, display space: grass and a path; fields and woods; bluish far away."""
        radius, coarse = np.hypot(x, y), self.noise(x, y, 37)
        fine = 0.5 * self.noise(x, y, 3.1) + 0.5 * self.noise(y, x, 7.3)
        grass = ramp(0.65 * fine + 0.35 * coarse, "28331a 4d6128 7d8a3f b0a862")
        earth = ramp(0.8 * fine + 0.2 * coarse, "4d3d2c 8d7455 c4ab84")
        away = np.abs(y - 1.5 * np.sin(0.35 * x) + 2.6) + 2 * (fine - 0.5)
        color = grass + (earth - grass) * (1 - smoothstep(0.7, 1.3, away))[..., None]
        _, field = self._fields.query(np.stack([x, y], axis=-1))
        field = ramp(self._tints[field], "56702f 8f9a45 c2b25c 7c6a44 4f6b34 d2c27a")
        field = field * (0.6 + 0.5 * self.noise(x, y, 90))[..., None]
        color += (field - color) * smoothstep(24, 40, radius)[..., None]
        wood = smoothstep(0.52, 0.6, self.noise(y, x, 410)) * smoothstep(40, 90, radius)
        trees = ramp(self.noise(x, y, 55), "142312 2c4420 4a6430")
        color += (trees - color) * wood[..., None]
        haze = 0.55 * smoothstep(60, 1.2 * HORIZON, radius)[..., None]
        return np.clip(color + ([0.62, 0.71, 0.82] - color) * haze, 0, 1)


def sky(rng: np.random.Generator) -> dict[str, Any]:
    """Return an environment map: a gradient, clouds, and a glow around the sun."""
    theta, phi = np.meshgrid(
        (np.arange(512) + 0.5) * np.pi / 512, (np.arange(1024) + 0.5) * np.pi / 512, indexing="ij"
    )
    # With Mitsuba's y axis turned to z: x = sin phi sin theta, y = cos phi sin theta.
    x, y, z = np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta)
    up = np.maximum(z, 0)
    radiance = ramp(up**0.5, "d9e2ea a9c6e6 5e93d4 2f66b4") ** 2.2
    cosine = np.stack([x, y, z], axis=-1) @ SUN
    glow = 0.9 * np.exp(30 * (cosine - 1)) + 0.35 * np.exp(5 * (cosine - 1))
    radiance += glow[..., None] * [1.0, 0.85, 0.6]
    at = np.stack([x, y]) * (150 / (up + 0.18))
    density = map_coordinates(fractal(rng, 1.6), at, order=1, mode="grid-wrap")
    cover = smoothstep(0.46, 0.72, density) * smoothstep(0.0, 0.12, z)
    light = 1.15 - 0.55 * smoothstep(0.55, 0.9, density) + 0.5 * glow
    radiance += (light[..., None] * [1.0, 0.98, 0.95] - radiance) * (0.9 * cover)[..., None]
    place = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.asarray(radiance, np.float32)),
        "to_world": place,
    }


def outdoor(rng: np.random.Generator) -> mi.Scene:
    """Return a garden with a house, a country around it, and a sky."""
    sun = {"type": "directional", "direction": (-SUN).tolist()}
    sun |= {"irradiance": {"type": "rgb", "value": [3.0, 2.75, 2.3]}}
    parts, land = SceneParts(sky=sky(rng), sun=sun), Landscape(rng)

    def ground(x: np.ndarray, y: np.ndarray, *, size: tuple[int, int], drop: float) -> None:
        """Add ground with a texel a place and ``size`` vertices; drop: m below the height."""
        i, j = (np.linspace(0, n - 1, k).astype(int) for n, k in zip(x.shape, size, strict=True))
        some = np.ix_(i, j)
        points = np.stack([x[some], y[some], land.height(x[some], y[some]) - drop], axis=-1)
        parts.grids(points[None], land.colors(x, y))

    side = np.linspace(-NEAR_GROUND, NEAR_GROUND, 2048)
    ground(*np.meshgrid(side, side), size=(2, 2), drop=0)
    angle, radius = np.meshgrid(
        np.linspace(0, 2 * np.pi, 4096), np.geomspace(0.9 * NEAR_GROUND, HORIZON, 1024)
    )
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    ground(x, y, size=(128, 512), drop=0.003)  # below the finer one, where they overlap

    walls = [facade(rng, floors, BRICKS) for floors in (1, 2, 3)]
    walls += [facade(rng, floors, PLASTER) for floors in (1, 2)]
    roofs = [masonry(rng, 16, 20, colors) for colors in (ROOF, STONE)]
    leaves = [cloth(rng, colors, 0.7) for colors in (LEAVES, "2c2a10 6a5a1e a88a34 c9b865")]
    bark, planks = cloth(rng, BARK), masonry(rng, 7, 1, WOOD, 8)
    stone = cloth(rng, STONE)

    parts.house((-0.6, 0.9, 0), (1.5, 1.05, 0.85), 25, walls[0], roofs[0])
    parts.tree(rng, (1.9, 1.7, 0), 2.7, leaves[0], bark)
    parts.tree(rng, (-2.7, -1.3, 0), 2.3, leaves[1], bark)
    for x, y, size, yaw in ((1.5, -0.7, 0.35, 20), (1.62, -0.6, 0.25, 50), (2.5, -0.2, 0.3, -15)):
        parts.box((x, y, size + 0.7 * (size == 0.25)), (size,) * 3, planks, yaw)
    for x, y, radius in ((0.2, -1.5, 0.42), (-1.2, -1.9, 0.3), (0.9, -2.2, 0.22), (3.1, 0.9, 0.36)):
        parts.ball((x, y, 0.94 * radius), radius, patchwork(rng, 40))
    centers = np.stack([*rng.uniform(-4.2, 4.2, (2, 24)), np.full(24, 0.05)], axis=-1)
    parts.grids(blobs(rng, centers, rng.uniform(0.08, 0.3, (24, 3)), 0.15), stone)
    for turn in np.radians(np.arange(-150, 151, 10)):  # a fence
        center, yaw = 9 * np.array([math.cos(turn), math.sin(turn)]), math.degrees(turn)
        parts.box((*center, 0.45), (0.06, 0.06, 0.5), planks, yaw)
        for height in (0.35, 0.75):
            parts.box((*center, height), (0.02, 0.8, 0.06), planks, yaw)
    for k in range(60):  # trees beyond the cameras, and far away
        turn, away = 2.4 * k, 30 * (HORIZON / 60) ** (k / 60)
        x, y = away * math.cos(turn), away * math.sin(turn)
        base = x, y, float(land.height(np.array(x), np.array(y))) - 0.2
        parts.tree(rng, base, rng.uniform(6, 11), leaves[k % 4 == 0], bark)
    for k in range(40):  # houses at 20 to 60 times the distance of the cameras
        turn, away = 2.4 * k + rng.uniform(), rng.uniform(20, 56) * 6.2
        x, y = away * math.cos(turn), away * math.sin(turn)
        base = x, y, float(land.height(np.array(x), np.array(y))) - 2.5
        half = *rng.uniform([5, 4], [9, 6]), rng.uniform(3, 6) + 9 * (k % 8 == 0)
        parts.house(base, half, 360 * rng.uniform(), walls[k % 5], roofs[k % 2])
    return parts.scene()


def outdoor_views() -> dict[str, list[Viewpoint]]:
    """Return the cameras of each folder: on an arc, farther back, and turned outward."""
    rng = np.random.default_rng(4)
    views: dict[str, list[Viewpoint]] = {"outdoor": [], "outdoor_far": [], "outdoor_unseen": []}
    for k in range(60):
        turn = math.radians(-135 + 270 * k / 59)
        origin = polar(rng.uniform(5.4, 7.0), turn, rng.uniform(1.4, 3.2))
        target = np.array([*rng.uniform(-0.9, 0.9, 2), rng.uniform(1.0, 1.7)])
        views["outdoor"].append(camera(f"orbit_{k:03d}", origin, target))
    for k in range(6):
        turn = math.radians(-112 + 45 * k)
        origin = polar(6.2 * (2 + 2 * k / 5), turn, rng.uniform(2, 6))
        views["outdoor_far"].append(camera(f"far_{k}", origin, np.array([0, 0, 1.8])))
        turn += math.radians(22)
        origin = polar(rng.uniform(4.5, 5.5), turn, rng.uniform(1.4, 2.4))
        target = origin + polar(1, turn + rng.uniform(-0.5, 0.5), math.tan(rng.uniform(0.1, 0.4)))
        views["outdoor_unseen"].append(camera(f"unseen_{k}", origin, target))
    return views


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def polar(radius: float, turn: float, height: float) -> np.ndarray:
    """Return a place (3,) at ``radius`` from the z axis; turn: radians."""
    return np.array([radius * math.cos(turn), radius * math.sin(turn), height])


def camera(name: str, origin: np.ndarray, target: np.ndarray) -> Viewpoint:
    """Return a camera of every set's size and angle of view."""
    return pinhole(name, look_at(origin, target, UP), WIDTH, HEIGHT, FOV)


# ----------------------------------------------------------------------------------------------
# Room
# ----------------------------------------------------------------------------------------------


def room(rng: np.random.Generator) -> mi.Scene:
    """Return a room with furniture and two lamps below its ceiling."""
    x, y, z = ROOM
    parts = SceneParts(lamp0=lamp(-1.2, 2 * z), lamp1=lamp(1.2, 2 * z))
    wood, dark = masonry(rng, 8, 1, WOOD, 8), masonry(rng, 5, 1, "2a1a10 5c3a22", 8)
    fabric = [masonry(rng, 110, 50, colors) for colors in ("22384f 3f6282", "6e2f2a a05a46")]
    striped = ramp(0.5 + 0.4 * np.sign(np.sin(np.arange(TEXTURE) * np.pi / 32)), "b9b58f dcd8bc")
    papered = np.broadcast_to(striped, (TEXTURE, TEXTURE, 3)) * cloth(rng, "c8c8c8 ffffff", 0.9)
    parts.box((0, 0, -0.05), (x, y, 0.05), masonry(rng, 26, 3, "6a4526 a9794a d0a672", 10))
    parts.box((0, 0, 2 * z + 0.05), (x, y, 0.05), cloth(rng, PLASTER, 1))
    parts.box((-x - 0.05, 0, z), (0.05, y, z), masonry(rng, 30, 14, BRICKS))
    parts.box((x + 0.05, 0, z), (0.05, y, z), cloth(rng, "7d97a0 9db4b8 b9cac8", 1.1))
    for sign in (-1, 1):
        parts.box((0, sign * (y + 0.05), z), (x, 0.05, z), papered)
        parts.box((0, sign * (y - 0.01), 0.06), (x, 0.01, 0.06), dark)
    parts.box((0.2, -0.1, 0.005), (1.3, 0.9, 0.006), patchwork(rng, 120))  # a carpet
    for k, (px, py) in enumerate(((-1.3, 1), (0.3, 1), (1.6, 1), (-0.4, -1), (1.2, -1))):
        parts.box((px, py * (y - 0.02), 1.6), (0.42, 0.02, 0.32), dark)
        parts.box((px, py * (y - 0.035), 1.6), (0.37, 0.02, 0.27), patchwork(rng, 15 + 20 * k))
    furnish(rng, parts, wood, dark, fabric)
    return parts.scene()


def lamp(x: float, z: float) -> dict[str, Any]:
    """Return a rectangle that shines down."""
    place = mi.ScalarTransform4f().translate([x, 0, z - 0.02]).rotate([1, 0, 0], 180)
    return {
        "type": "rectangle",
        "to_world": place.scale([0.5, 0.9, 1]),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.5, 7.6]}},
    }


def furnish(
    rng: np.random.Generator, parts: SceneParts, wood: np.ndarray, dark: np.ndarray,
    fabric: Sequence[np.ndarray],
) -> None:  # fmt: skip
    """Add a table, a sofa, a shelf of books, a chest, and things on them."""
    x, y, _ = ROOM
    parts.box((0.2, 0, 0.72), (0.7, 0.42, 0.025), wood)
    for i, j in product((-1, 1), repeat=2):
        parts.box((0.2 + 0.63 * i, 0.35 * j, 0.35), (0.035, 0.035, 0.35), wood)
    for k, (px, py) in enumerate(((-0.25, 0.1), (0.1, -0.15), (0.55, 0.12), (0.35, 0.2))):
        radius = (0.13, 0.09, 0.16, 0.07)[k]
        parts.ball((px, py, 0.745 + radius), radius, patchwork(rng, 60))
    parts.box((0.72, -0.2, 0.8), (0.1, 0.07, 0.055), patchwork(rng, 25), 30)
    for half, center in (
        ((0.85, 0.4, 0.2), (0.6, 0.45 - y, 0.22)),
        ((0.85, 0.1, 0.42), (0.6, 0.12 - y, 0.44)),
        ((0.1, 0.4, 0.3), (-0.33, 0.45 - y, 0.32)),
        ((0.1, 0.4, 0.3), (1.53, 0.45 - y, 0.32)),
    ):
        parts.box(center, half, fabric[0])
    for px, yaw in ((0.0, 12), (1.1, -20)):
        parts.box((px, 0.36 - y, 0.6), (0.2, 0.07, 0.2), fabric[1], yaw, -20)
    covers = [cloth(rng, colors, 0.6) for colors in BOOKS]
    for level in range(5):  # the shelf
        parts.box((0.17 - x, 0.3, 0.1 + 0.42 * level), (0.16, 0.8, 0.015), dark)
        at = -0.46
        while level < 4 and at < 1.0:
            width, height = rng.uniform(0.02, 0.05), rng.uniform(0.12, 0.18)
            cover = covers[rng.integers(len(covers))]
            parts.box((0.16 - x, at, 0.115 + 0.42 * level + height), (0.11, width, height), cover)
            at += 2 * width + rng.choice([0.005, 0.005, 0.005, 0.2])
    parts.box((x - 0.3, -0.5, 0.4), (0.27, 0.7, 0.4), wood)  # the chest
    centers = np.array([[x - 0.3, -0.8, 1.0], [x - 0.3, -0.2, 0.94]])
    radii = np.array([[0.14, 0.14, 0.22], [0.2, 0.2, 0.15]])
    parts.grids(blobs(rng, centers, radii, 0.06), masonry(rng, 12, 18, "e0d3b0 4b7a86 23404f"))
    parts.box((1.7, 1.6, 0.25), (0.25, 0.25, 0.25), patchwork(rng, 30), 35)
    parts.ball((1.7, 1.6, 0.7), 0.2, masonry(rng, 12, 12, "f0e6d0 2d2a26"))
    parts.tree(rng, (-2.3, -1.8, 0.0), 1.4, cloth(rng, LEAVES, 0.7), dark)


def room_views(scene: mi.Scene) -> list[Viewpoint]:
    """Return 26 cameras that look across the room, and 24 close-ups, in random order."""
    rng = np.random.default_rng(5)
    far: list[tuple[np.ndarray, np.ndarray]] = []  # origins and targets
    while len(far) < 26:
        side = rng.choice([-1, 1], 2)
        origin = np.array([*side * ROOM[:2] * rng.uniform(0.5, 0.88, 2), rng.uniform(0.9, 1.9)])
        target = np.array([*-0.4 * side * ROOM[:2] * rng.uniform(0, 1, 2), rng.uniform(0.6, 1.1)])
        around = unit(unit(target - origin) + 0.25 * rng.normal(size=(64, 3)))
        seen = distances(scene, origin, around)
        if is_clear(scene, origin, 0.3) and np.median(seen) > 2.8 and np.quantile(seen, 0.1) > 1.2:
            far.append((origin, target))
    near: list[tuple[np.ndarray, np.ndarray]] = []
    while len(near) < 24:
        near += close_ups(scene, *far[rng.integers(len(far))], rng)
    places = [("far", *place) for place in far] + [("near", *place) for place in near]
    order = enumerate(rng.permutation(len(places)))
    return [camera(f"{k:02d}_{places[i][0]}", *places[i][1:]) for k, i in order]


def close_ups(
    scene: mi.Scene, origin: np.ndarray, target: np.ndarray, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return origins and targets of three cameras near what is seen about ``target``, or none."""
    ahead = unit(unit(target - origin) + 0.25 * rng.normal(size=3))
    target = origin + ahead * distances(scene, origin, ahead[None])[0]
    if not 0.25 < target[2] < 2 or (np.abs(target[:2]) > ROOM[:2] - 0.1).any():
        return []  # the floor, the ceiling or a wall
    places = []
    for _ in range(12):
        back, length = unit(-ahead + 0.5 * rng.normal(size=3)), rng.uniform(0.3, 0.6)
        start = target + length * back
        is_seen = distances(scene, start, -back[None])[0] > 0.99 * length
        if is_seen and is_clear(scene, start, 0.2):
            places.append((start, target))
    return places[:3] if len(places) >= 3 else []


# ----------------------------------------------------------------------------------------------
# Images and points
# ----------------------------------------------------------------------------------------------


def distances(scene: mi.Scene, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return distances (N,) of surfaces along unit directions (N, 3); inf: none."""
    rays = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(directions.T))
    return np.array(scene.ray_intersect_preliminary(rays).t)


def is_clear(scene: mi.Scene, origin: np.ndarray, air: float) -> bool:
    """Return whether a camera in the room has so much air around it, m."""
    around = unit(np.random.default_rng(0).normal(size=(200, 3)))
    inside = (np.abs(origin - ROOM * UP) < ROOM - air).all()
    return bool(inside and distances(scene, origin, around).min() > air)


def take_image(scene: mi.Scene, view: Viewpoint, seed: int) -> np.ndarray:
    """Return an image (H, W, 3) in display space: 1 - exp(-EXPOSURE radiance), as sRGB."""
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": FOV,
            "near_clip": 0.01,
            "far_clip": 10 * HORIZON,
            "to_world": mi.ScalarTransform4f(view.camera_to_world @ OPENCV_TO_MITSUBA),
            "film": film_description(view.width, view.height),
            "sampler": {"type": "multijitter", "sample_count": SPP},
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH})
    linear = np.array(mi.render(scene, sensor=sensor, integrator=integrator, seed=seed))  # pyright: ignore[reportArgumentType]  # also an int
    tone = 1 - np.exp(-EXPOSURE * linear)
    return np.where(tone <= 0.0031308, 12.92 * tone, 1.055 * tone ** (1 / 2.4) - 0.055)


def visible_points(
    scene: mi.Scene, views: Sequence[Viewpoint], images: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) on what at least two images show, and their mean colours (N, 3) uint8.

    Of each image, random pixels are taken. Noise is added that grows with the distance.
    """
    rng, found = np.random.default_rng(3), []
    for view in views:
        spots = rng.uniform(size=(4 * NUM_POINTS // len(views), 2)) * [view.width, view.height]
        local = np.column_stack([(spots - [view.cx, view.cy]) / view.fx, np.ones(len(spots))])
        rays = unit(local @ view.camera_to_world[:3, :3].T)
        depths = distances(scene, view.center, rays)[:, None]
        shown = np.isfinite(depths[:, 0])
        found.append(view.center + depths[shown] * rays[shown])
    points = np.concatenate(found)
    colors, counts = np.zeros((len(points), 3)), np.zeros((len(points), 1))
    nearest = np.full((len(points), 1), np.inf)
    for view, image in zip(views, images, strict=True):
        rays = points - view.center
        local = rays @ view.camera_to_world[:3, :3]
        x, y = np.floor(local[:, :2] * view.fx / local[:, 2:] + [view.cx, view.cy]).T
        away = np.linalg.norm(rays, axis=1, keepdims=True)
        reached = distances(scene, view.center, rays / away)[:, None] > (1 - RAY_TOLERANCE) * away
        inside = (local[:, 2] > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
        shown = np.flatnonzero(inside & reached[:, 0])
        colors[shown] += image[y[shown].astype(int), x[shown].astype(int)]
        counts[shown] += 1
        nearest[shown] = np.minimum(nearest[shown], away[shown])
    chosen = rng.permutation(np.flatnonzero(counts >= 2))[:NUM_POINTS]
    noise = POINT_NOISE * nearest[chosen] * rng.normal(size=(len(chosen), 3))
    return (points[chosen] + noise).astype(np.float32), to_uint8(colors[chosen] / counts[chosen])


def write_set(scene: mi.Scene, views: Sequence[Viewpoint], folder: Path, has_points: bool) -> None:
    """Write a dataset; images that are there are not rendered again."""
    files = {view.name: folder / "images" / f"{view.name}.png" for view in views}
    with RunProgress("image", len(views)) as progress:
        for done, view in enumerate(views, 1):
            if not files[view.name].exists():
                write_png(files[view.name], take_image(scene, view, seed=done))
            progress.update(done, len(views), folder.name)
    # Every 8th of each kind of camera: the loader would choose by the names' order alone.
    by_kind = sorted(views, key=lambda view: view.name.split("_")[::-1])
    test = by_kind[::TEST_EVERY] if has_points else []
    train, first = [view for view in views if view not in test], views[0]
    content: dict[str, object] = {"w": WIDTH, "h": HEIGHT, "fl_x": first.fx, "fl_y": first.fy}
    content |= {"cx": first.cx, "cy": first.cy}
    for key, listed in (("train_filenames", train), ("test_filenames", test)):
        if listed:
            content[key] = [f"images/{view.name}.png" for view in listed]
    if has_points:
        images = [read_image(files[view.name]) for view in train]
        write_points(folder / "points.ply", *visible_points(scene, train, images))
        content["ply_file_path"] = "points.ply"
    content["frames"] = [
        {
            "file_path": f"images/{view.name}.png",
            "transform_matrix": between_opencv_and_opengl(view.camera_to_world).tolist(),
        }
        for view in views
    ]
    write_json(folder / "transforms.json", content)


def main() -> None:
    """Entry point of the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="of the folders")
    output = parser.parse_args().output
    mi.set_variant("llvm_ad_rgb")
    garden, inside = outdoor(np.random.default_rng(1)), room(np.random.default_rng(2))
    sets = {name: (garden, views) for name, views in outdoor_views().items()}
    sets["room"] = inside, room_views(inside)
    for name, (scene, views) in sets.items():
        write_set(scene, views, output / name, has_points=name in ("outdoor", "room"))


if __name__ == "__main__":
    main()
