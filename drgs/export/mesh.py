"""The surface of Gaussians as a mesh: depths of many views, fused into a signed distance.

Source: Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images",
SIGGRAPH 1996: a voxel has the mean of (d - z) / t over the views that see it, with the depth d of
its pixel, its own depth z and the truncation t; at most 1, and without views in which it is below
-1, which is hidden behind the surface. The mesh is where the mean is zero, between seen voxels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.cameras.camera import Camera
from drgs.cameras.viewpoints import Viewpoint
from drgs.config.schema import ModelConfig
from drgs.core.arrays import types_of
from drgs.core.environment import require_module
from drgs.core.errors import UserError
from drgs.core.memory import require_memory
from drgs.core.origin import WORLD, Origin
from drgs.datasets.types import evenly_spaced
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, make_sensors
from drgs.io.formats import ORIGIN, Z_TO_Y

Trimesh = Any  # ``trimesh.Trimesh``, of the extra ``mesh``

MODULES = ("skimage.measure", "trimesh")  # of the extra ``mesh``

UNLIT = "KHR_materials_unlit"  # colours are radiance: lamps of a viewer would light them again

MAX_VIEWS, MAX_SIDE_PX = 150, 800  # of views that are rendered: 16 bytes a pixel are kept

VIEWS_PER_RING, RING_SIDE_PX = 24, 500  # of the cameras around Gaussians that come without

MIN_ALPHA = 0.5  # of pixels that show a surface

TRUNCATION = 7.0  # voxels: with 4, depths leave more of their noise

OUTLIERS, MARGIN = 0.01, 0.25  # shares: of depths that may be far away, of the others' extent

MIN_COMPONENT = 1e-3  # of all faces, in a connected part that is kept

VOXEL_BYTES, VOXELS_AT_ONCE = 12, 1 << 22


@dataclass(frozen=True, eq=False)
class DepthImage:
    """The surface that a view shows."""

    view: Viewpoint  # a pinhole camera that stands still
    colors: np.ndarray  # (H, W, 3) float32, display space 0..1
    depth: np.ndarray  # (H, W) float32, camera z, scene units; inf: no surface

    def points(self) -> np.ndarray:
        """Return the points (N, 3) of the surface, world."""
        view, (row, column) = self.view, np.nonzero(np.isfinite(self.depth))
        z = self.depth[row, column]
        x, y = (column + 0.5 - view.cx) / view.fx, (row + 0.5 - view.cy) / view.fy
        return np.stack([x * z, y * z, z], axis=1) @ view.camera_to_world[:3, :3].T + view.center


def depth_images(
    gaussians: Gaussians[np.ndarray], model: ModelConfig, views: Sequence[Viewpoint]
) -> Iterator[DepthImage]:
    """Render colours and mean depths of the views, through pinholes that stand still.

    At most :data:`MAX_VIEWS` views are rendered, with sides of at most :data:`MAX_SIDE_PX`.
    """
    views = [_pinhole(view) for view in evenly_spaced(views, MAX_VIEWS)]
    scene = make_scene(gaussians, model, (0.0, 0.0, 0.0), aovs="depth:depth, alpha:alpha")
    for view, sensor in zip(views, make_sensors(views), strict=True):
        with dr.suspend_grad():
            image = mi.render(scene, sensor=sensor, spp=1).numpy()
        colors, depth, alpha = image[:, :, :3], image[:, :, -2], image[:, :, -1]
        opaque = alpha >= MIN_ALPHA
        share = np.where(opaque, alpha, 1)
        colors = np.clip(colors / share[:, :, None], 0, 1)
        yield DepthImage(view, colors, np.where(opaque, depth / share, np.inf))


def _pinhole(view: Viewpoint) -> Viewpoint:
    scale = min(1.0, MAX_SIDE_PX / max(view.width, view.height))
    width, height = (max(1, round(scale * side)) for side in (view.width, view.height))
    x, y = width / view.width, height / view.height
    optics = view.fx * x, view.fy * y, view.cx * x, view.cy * y
    return Viewpoint(view.name, view.camera_to_world, *optics, width, height)


def mesh_of(images: Sequence[DepthImage], size: int) -> Trimesh:
    """Return the mesh of the surface in the images; size: voxels along the longest side.

    Triangles are counter-clockwise from outside; vertices have colours, display space. Connected
    parts of less than :data:`MIN_COMPONENT` of the faces are left out.

    Raises :class:`UserError` for images without a surface, and if memory is too small.
    """
    measure, trimesh = (require_module(name, "mesh", "--format mesh") for name in MODULES)
    corner, voxel, shape = volume_of(images, size)
    distance, known = np.ones(shape, np.float32), np.zeros(shape, bool)
    colors = np.zeros((*shape, 3), np.uint8)
    layers = max(1, VOXELS_AT_ONCE // (shape[1] * shape[2]))
    for first in range(0, shape[0], layers):
        part, start = slice(first, first + layers), corner + np.array([first * voxel, 0, 0])
        distance[part], colors[part], known[part] = fuse(images, start, voxel, distance[part].shape)
    for axis in range(3):  # a cube is known where all eight corners are; its last one stands for it
        shifted = np.moveaxis(known, axis, 0)
        shifted[1:] &= shifted[:-1]
    vertices, faces, _, _ = measure.marching_cubes(distance, 0.0, mask=known)
    shown = colors[tuple(np.rint(vertices).astype(np.int64).T)]
    places = (vertices + 0.5) * voxel + corner
    mesh = trimesh.Trimesh(places, faces, vertex_colors=shown, process=False)
    part = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(faces))
    mesh.update_faces(np.bincount(part)[part] >= MIN_COMPONENT * len(faces))
    mesh.remove_unreferenced_vertices()
    return mesh


def encode_ply(mesh: Trimesh, origin: Origin) -> bytes:
    """Return a binary PLY file; origin: of the vertices, world, which comments record."""
    values = () if origin == WORLD else zip(ORIGIN, origin, strict=True)
    lines = "".join(f"comment drgs {name} {value}\n" for name, value in values)
    return mesh.export(file_type="ply").replace(b"element", lines.encode() + b"element", 1)


def encode_glb(mesh: Trimesh, origin: Origin) -> bytes:
    """Return a binary glTF file, y up: linear colours of an unlit material."""

    def make_unlit(tree: dict[str, Any]) -> None:
        tree["materials"] = [{"extensions": {UNLIT: {}}, "doubleSided": True}]
        tree["extensionsUsed"] = [UNLIT]
        tree["meshes"][0]["primitives"][0]["material"] = 0

    mesh, c = mesh.copy(), mesh.visual.vertex_colors / 255
    mesh.vertices = mesh.vertices @ Z_TO_Y.T
    c = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    mesh.visual.vertex_colors = np.rint(255 * c).astype(np.uint8)
    scene, to_world = mesh.scene(), np.eye(4)
    to_world[:3, 3] = Z_TO_Y @ origin
    scene.apply_transform(to_world)
    return scene.export(file_type="glb", tree_postprocessor=make_unlit)


def volume_of(images: Sequence[DepthImage], size: int) -> tuple[np.ndarray, float, tuple[int, ...]]:
    """Return the corner (3,), world, of the volume, the side of a voxel, and their numbers."""
    points = np.concatenate([image.points() for image in images])
    if not len(points):
        raise UserError(
            f"--format mesh: there is no surface: none of {len(images)} views shows anything of "
            f"an opacity of {MIN_ALPHA:g}; give more opaque Gaussians"
        )
    few = points[:: len(points) // 1_000_000 + 1]
    low, high = np.quantile(few, [OUTLIERS, 1 - OUTLIERS], axis=0)
    margin = MARGIN * (high - low).max()
    low, high = np.clip([low - margin, high + margin], points.min(axis=0), points.max(axis=0))
    voxel = float((high - low).max()) / size
    border = np.ceil(TRUNCATION) + 1
    x, y, z = (np.ceil((high - low) / voxel) + 2 * border).astype(int).tolist()
    num = x * y * z
    require_memory(f"--mesh-size {size}", VOXEL_BYTES * num, f"a volume of {num:,} voxels")
    return low - border * voxel, voxel, (x, y, z)


def fuse(
    images: Sequence[DepthImage], corner: np.ndarray, voxel: float, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean distances (X, Y, Z) of voxels, colours (X, Y, Z, 3) of 8 bits, and if seen.

    Distances are signed, in truncations, positive outside; shape: X, Y, Z.
    """
    lane, t = dr.arange(mi.UInt32, int(np.prod(shape))), types_of(mi.Float)
    indices = lane // (shape[1] * shape[2]), lane // shape[2] % shape[1], lane % shape[2]
    sides = zip(indices, corner.tolist(), strict=True)
    columns = [dr.fma(mi.Float(i) + 0.5, voxel, dr.opaque(mi.Float, c)) for i, c in sides]
    centers = t.Array3f(columns)
    total, weight, colored = (dr.zeros(mi.Float, len(lane)) for _ in range(3))
    color, truncation = dr.zeros(t.Array3f, len(lane)), dr.opaque(mi.Float, TRUNCATION * voxel)
    dr.eval(centers)
    for image in images:
        view, rotation = image.view, image.view.viewmat[:3, :3]
        size = view.width, view.height
        camera = Camera.create(mi.Float, rotation, view.center, view.K, *size, near=0.0)
        position = camera.rotation @ (centers - camera.center)
        visible = position.z > 0
        position.z = dr.select(visible, position.z, 1)
        film = dr.floor(camera.lens.project_point(camera, position))
        visible &= (film.x >= 0) & (film.x < view.width) & (film.y >= 0) & (film.y < view.height)
        pixel = mi.UInt32(film.y) * view.width + mi.UInt32(film.x)
        depth = dr.gather(mi.Float, mi.Float(image.depth.ravel()), pixel, visible)
        distance = (depth - position.z) / truncation
        visible &= (distance > -1) & dr.isfinite(distance)
        near = visible & (distance < 1)
        shade = dr.gather(t.Array3f, mi.Float(image.colors.ravel()), pixel, near)
        total += dr.select(visible, dr.minimum(distance, 1), 0)
        weight += dr.select(visible, 1, 0)
        color += dr.select(near, shade, 0)
        colored += dr.select(near, 1, 0)
        dr.eval(total, weight, color, colored)
    mean, shown = total / dr.maximum(weight, 1), 255 * color / dr.maximum(colored, 1)
    colors = np.rint(shown.numpy().T).astype(np.uint8).reshape(*shape, 3)
    return mean.numpy().reshape(shape), colors, weight.numpy().reshape(shape) > 0
