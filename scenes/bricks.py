"""Bricks, plates, wheels and rods as Mitsuba meshes: what the scenes of this folder are built of.

Every part is made of triangles, and the triangles of one material become one mesh. Lengths are in
studs (8 mm). Bricks sit on a grid whose height is counted in plates (3.2 mm); a brick is three
plates high.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mitsuba as mi
import numpy as np
from plyfile import PlyData, PlyElement
from scipy.spatial import ConvexHull

PLATE = 0.4  # studs
BEVEL = 0.05  # studs: rounded edges catch light, and a seam shows between two bricks
STUD_RADIUS, STUD_HEIGHT = 0.3, 0.22  # studs

COLORS = {
    "blue": "#0b55b5",
    "orange": "#f07a12",
    "yellow": "#f7c21c",
    "red": "#c4200f",
    "white": "#e2e1da",
    "light grey": "#a3a8ab",
    "dark grey": "#565c60",
    "asphalt": "#83878a",
    "asphalt 2": "#7b7f83",
    "black": "#16181a",
    "green": "#3f9a3c",
    "leaf": "#2b7a35",
    "tan": "#d9c08c",
    "brown": "#5f3520",
    "lamp": "#fff3c4",
    "rubber": "#1b1b1c",
}
"""Plastics, sRGB; "chrome" is a metal."""

Point = Sequence[float]


class Builder:
    """Collects the triangles of placed parts, by material."""

    def __init__(self) -> None:
        self.num_parts = 0  # bricks, plates, tiles, slopes, tyres, rims; not bars and hoses
        self._soups: dict[str, list[np.ndarray]] = defaultdict(list)  # (N, 3, 2, 3) p and normal
        self._frame = np.eye(4)

    @contextmanager
    def at(self, x: float, y: float, z: float, yaw: float = 0, pitch: float = 0) -> Iterator[None]:
        """Parts placed inside are turned (degrees; pitch raises the x axis), then moved."""
        outer, frame = self._frame, np.eye(4)
        frame[:3, :3] = rotation(2, yaw) @ rotation(1, -pitch)
        frame[:3, 3] = x, y, z
        self._frame = outer @ frame
        yield
        self._frame = outer

    def add(self, color: str, points: np.ndarray, normals: np.ndarray | None = None) -> None:
        """Triangles (N, 3, 3) in the current frame; flat where no ``normals`` (N, 3, 3) come."""
        if normals is None:
            a, b, c = points.swapaxes(0, 1)
            normals = np.repeat(np.cross(b - a, c - a)[:, None], 3, axis=1)
        turn, move = self._frame[:3, :3], self._frame[:3, 3]
        self._soups[color].append(np.stack([points @ turn.T + move, normals @ turn.T], axis=2))

    def meshes(self, scale: float, middle: float) -> dict[str, mi.Mesh]:
        """One mesh a material, ``scale`` world units per stud; the height ``middle`` becomes 0."""
        meshes = {}
        for color, soups in self._soups.items():
            soup = np.concatenate(soups)
            soup[:, :, 0] = (soup[:, :, 0] - [0, 0, middle]) * scale
            meshes[color.replace(" ", "_")] = mesh(color, soup)
        return meshes

    # Parts on the grid: x, y in studs (the corner with the smallest x, y), z in plates.

    def block(
        self, x: float, y: float, z: float, w: float, d: float, h: float, color: str, studs: bool
    ) -> None:
        """A part of w x d studs and h plates."""
        self.num_parts += 1
        self.box(x, y, z * PLATE, w, d, h * PLATE, color)
        if studs:
            for i, j in product(range(int(w)), range(int(d))):
                with self.at(x + i + 0.5, y + j + 0.5, (z + h) * PLATE):
                    r, top, edge = STUD_RADIUS, STUD_HEIGHT, 0.04
                    profile = [(r, 0), (r, top - edge), (r - edge, top), (0, top)]
                    self.lathe(profile, color, sides=16)

    def brick(self, x: float, y: float, z: float, w: int, d: int, color: str) -> None:
        """A brick: three plates high, with studs."""
        self.block(x, y, z, w, d, 3, color, studs=True)

    def plate(self, x: float, y: float, z: float, w: int, d: int, color: str) -> None:
        """A plate with studs."""
        self.block(x, y, z, w, d, 1, color, studs=True)

    def tile(self, x: float, y: float, z: float, w: float, d: float, color: str) -> None:
        """A plate without studs."""
        self.block(x, y, z, w, d, 1, color, studs=False)

    def wall(self, x: float, y: float, z: int, w: int, d: int, courses: int, color: str) -> None:
        """Courses of bricks up to four studs long, bonded: every other one starts with two."""
        for course in range(courses):
            start, length = 0, max(w, d)
            while start < length:
                step = min(2 if start == 0 and course % 2 else 4, length - start)
                if w >= d:
                    self.brick(x + start, y, z + 3 * course, step, d, color)
                else:
                    self.brick(x, y + start, z + 3 * course, w, step, color)
                start += step

    def slope(self, x: float, y: float, z: float, w: float, d: float, h: float, color: str) -> None:
        """h plates high at its low x, one plate at its high x; a negative w turns it around."""
        self.num_parts += 1
        outline = [(x, z), (x + w, z), (x + w, z + 1), (x + 0.3 * w, z + h), (x, z + h)]
        points = [(px, py, pz * PLATE) for px, pz in outline for py in (y + 0.02, y + d - 0.02)]
        self.add(color, hull(points))

    # Free parts: all lengths in studs.

    def box(self, x: float, y: float, z: float, w: float, d: float, h: float, color: str) -> None:
        """A bevelled box."""
        half = np.array([w, d, h]) / 2
        bevel = min(BEVEL, 0.3 * half.min())
        shape = BOX_SIGNS * (half - bevel * (1 - BOX_FACES))
        self.add(color, shape + half + [x, y, z])

    def lathe(self, profile: Sequence[Point], color: str, sides: int = 40) -> None:
        """(radius, z) points, from bottom to top on the outside, turned about the z axis."""
        angles = np.linspace(0, 2 * np.pi, sides + 1)
        circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(sides + 1)], axis=1)
        axis = np.array([0.0, 0.0, 1.0])
        for (r0, z0), (r1, z1) in pairwise(profile):
            rings = np.stack([circle * r0 + axis * z0, circle * r1 + axis * z1])
            normal = circle * (z1 - z0) + axis * (r0 - r1)
            self.add(color, *quads(rings, np.stack([normal, normal])))

    def rod(self, start: Point, end: Point, radius: float, color: str, sides: int = 12) -> None:
        """A round bar between two points."""
        self.hose([start, end], radius, color, sides)
        for center, other in ((start, end), (end, start)):
            ring = circle_around(np.subtract(center, other), sides) * radius + center
            middle = np.broadcast_to(np.asarray(center, float), (sides, 3))
            self.add(color, np.stack([middle, ring[:-1], ring[1:]], axis=1))

    def hose(self, path: Sequence[Point], radius: float, color: str, sides: int = 10) -> None:
        """A tube along a path."""
        path = np.asarray(path, float)
        tangents = np.gradient(path, axis=0)
        normals = np.stack([circle_around(tangent, sides) for tangent in tangents])
        self.add(color, *quads(path[:, None] + normals * radius, normals))

    def wheel(self, radius: float, width: float) -> None:
        """A wheel about the z axis, its outer side at z = 0: a tyre with lugs, a rim with bolts."""
        self.num_parts += 2
        r, rim = radius - 0.14, 0.58 * radius
        tread = [(rim, -width), (r - 0.15, -width), (r, 0.15 - width), (r, -0.15)]
        self.lathe([*tread, (r - 0.15, 0), (rim, 0), (rim - 0.04, -0.12)], "rubber", 48)
        dish = [(rim - 0.02, -0.12), (rim - 0.15, -0.12), (rim - 0.25, -0.4), (0.5, -0.3)]
        self.lathe([*dish, (0.42, 0.02), (0, 0.02)], "light grey", 32)
        for step in range(40):
            with self.at(0, 0, 0, yaw=9 * step):
                z = -0.6 * width if step % 2 else 0.04 - width
                self.box(radius - 0.3, -0.17, z, 0.3, 0.26, 0.56 * width, "rubber")
        for angle in np.arange(5) * 2 * np.pi / 5:
            x, y = 0.68 * np.cos(angle), 0.68 * np.sin(angle)
            self.rod((x, y, -0.36), (x, y, -0.18), 0.1, "chrome", 8)


def rotation(axis: int, degrees: float) -> np.ndarray:
    """(3, 3) right-handed rotation about a coordinate axis."""
    turn, (i, j) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
    return turn


def hull(points: Sequence[Point]) -> np.ndarray:
    """(N, 3, 3): triangles of the convex hull, counter-clockwise from outside."""
    points = np.asarray(points, float)
    shape = ConvexHull(points)
    triangles = points[shape.simplices]
    a, b, c = triangles.swapaxes(0, 1)
    inward = np.einsum("ni,ni->n", np.cross(b - a, c - a), shape.equations[:, :3]) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return triangles


def bevelled_box() -> tuple[np.ndarray, np.ndarray]:
    """Triangles (N, 3, 3) of a bevelled box: signs of the corners, and 1 on a face's own axis."""
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))
    points = np.concatenate([corners * (1 - 0.1 * (1 - row)) for row in np.eye(3)])
    triangles = hull(points)
    return np.sign(triangles), (np.abs(triangles) > 0.95).astype(float)


def circle_around(direction: np.ndarray, sides: int) -> np.ndarray:
    """(sides + 1, 3): unit vectors perpendicular to ``direction``, counter-clockwise about it."""
    direction = direction / np.linalg.norm(direction)
    other = np.eye(3)[1] if abs(direction[1]) < 0.9 else np.eye(3)[0]
    u = np.cross(direction, other)
    u /= np.linalg.norm(u)
    angles = np.linspace(0, 2 * np.pi, sides + 1)[:, None]
    return np.cos(angles) * u + np.sin(angles) * np.cross(direction, u)


def quads(grid: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a grid (rows, columns, 3) of points, and their normals."""
    corners = [(slice(None, -1), slice(None, -1)), (slice(None, -1), slice(1, None))]
    corners += [(slice(1, None), slice(1, None)), (slice(1, None), slice(None, -1))]
    a, b, c, d = (np.stack([grid[i], normals[i]], axis=-2).reshape(-1, 2, 3) for i in corners)
    soup = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return soup[:, :, 0], soup[:, :, 1]


BOX_SIGNS, BOX_FACES = bevelled_box()


def linear(color: str) -> list[float]:
    """Linear RGB of an sRGB colour #rrggbb."""
    values = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).tolist()


def material(name: str) -> dict[str, Any]:
    """A Mitsuba BSDF."""
    if name == "chrome":
        return {"type": "roughconductor", "material": "Al", "alpha": 0.3}
    return {
        "type": "roughplastic",
        "diffuse_reflectance": {"type": "rgb", "value": linear(COLORS[name])},
        "alpha": 0.4 if name == "rubber" else 0.15,
        "nonlinear": True,
    }


def mesh(name: str, soup: np.ndarray) -> mi.Mesh:
    """A mesh of triangles (N, 3, 2, 3): corner, position and normal; read back from a PLY file."""
    corners = soup.reshape(-1, 6).astype(np.float64)
    corners[:, 3:] /= np.linalg.norm(corners[:, 3:], axis=1, keepdims=True)
    columns = [(column, "f4") for column in ("x", "y", "z", "nx", "ny", "nz")]
    vertices = np.array([tuple(corner) for corner in corners], columns)
    faces = np.empty(len(soup), [("vertex_indices", "i4", (3,))])
    faces["vertex_indices"] = np.arange(len(corners)).reshape(-1, 3)
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    with TemporaryDirectory() as folder:
        path = Path(folder, f"{name}.ply")
        PlyData(elements).write(str(path))
        return mi.load_dict({"type": "ply", "filename": str(path), "bsdf": material(name)})
