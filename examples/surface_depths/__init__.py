"""A dataset reader that adds depths of training views from a mesh or points, through any lens.

In a configuration, ``data.type: surface_depths`` reads the folder as drgs would, and the section
names the file: ``surface_depths: {surface: mesh.ply}``, in the world of the cameras.

A mesh has a depth wherever the ray through a pixel's centre meets it, from either side. A point
cloud has depths at the pixels of the points that no others hide, and none between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import Field
from scipy.spatial import KDTree

from drgs.cameras.camera import Camera
from drgs.cameras.lens import PINHOLE
from drgs.cameras.viewpoints import Viewpoint
from drgs.cli.execution import select_variant
from drgs.config.section import Section
from drgs.core.environment import VARIANTS, denormals_kept
from drgs.core.errors import UserError, reason_of_mitsuba
from drgs.datasets.film import is_projectable, shown_points
from drgs.datasets.folders import find_reader
from drgs.datasets.images import unread_image
from drgs.datasets.reader import READERS, DatasetReader
from drgs.datasets.types import Dataset, View, ViewFilter, all_views
from drgs.io.ply import read_points

NUM_NEIGHBOURS = 3

PIXEL_WIDTH = 4.0  # of the points' z-buffer, in their distances: with 1.5, 10 % are seen in gaps

KEY = "surface_depths.surface"


class SurfaceDepthsSection(Section):
    """The section ``surface_depths``."""

    surface: str = Field("", description="PLY file of a mesh of triangles, or of points.")


@READERS.register("surface_depths", section=SurfaceDepthsSection)
class SurfaceDepths(DatasetReader):
    """Reads a dataset of another layout, with the depth of a surface."""

    def __init__(self, section: SurfaceDepthsSection) -> None:
        self.path = Path(section.surface).expanduser()

    def load(self, config, keeps=all_views):
        """Return the views with the depths of the surface."""
        reader = find_reader(config.model_copy(update={"type": "auto"}), {})[1]
        return with_depths_from(self.path, reader.load(config, keeps), keeps)


def with_depths_from(path: Path, dataset: Dataset, keeps: ViewFilter) -> Dataset:
    """Return the dataset with other depths of its training views; none where a camera moves.

    path: a PLY file, world; with faces, a mesh of triangles; keeps: accepts, by name, the views
    whose depths are computed.

    Raises :class:`UserError` for a file that cannot be used, or that no camera sees.
    """
    points, _ = read_points(path)
    points -= dataset.origin
    faces = _read_faces(path, len(points))
    kind = "mesh" if len(faces) else "points"
    depth_of = _mesh_depths(points, faces) if len(faces) else _point_depths(path, points)

    def with_depth(view: View) -> View:
        depth, files = None, {name: file for name, file in view.files.items() if name != "depth"}
        if is_projectable(view):
            shape, files = (view.height, view.width), {**files, "depth": path}
            depth = depth_of(view) if keeps(view.name) else unread_image(shape, path)
        return replace(view, depth=depth, files=files)

    train = tuple(map(with_depth, dataset.train))
    kept = [view.depth for view in train if keeps(view.name)]
    seeing = [depth for depth in kept if depth is not None and np.any(depth)]
    if kept and not seeing:
        raise UserError(
            f"{KEY}: {path}: no training camera that stands still sees the {kind}; expected the "
            "coordinates of the cameras"
        )
    note = f"; depth of {len(seeing)} of {len(kept)} training views from the {kind} of {path.name}"
    return replace(dataset, train=train, description=dataset.description + note)


def _read_faces(path: Path, num_vertices: int) -> np.ndarray:
    """Return the corners (3 * F,) of the triangles of a file; none of a point cloud."""
    if mi.variant() is None:
        select_variant(VARIANTS[0])
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # no warning of integer colours, which are not used
    try:
        read = mi.load_dict({"type": "ply", "filename": str(path), "face_normals": True})
    except RuntimeError as error:
        reason = reason_of_mitsuba(error)
        raise UserError(f"{KEY}: {path}: must be triangles, and complete: {reason}") from None
    finally:
        mi.set_log_level(level)
    faces = np.array(mi.traverse(read)["faces"])
    if faces.max(initial=0) >= num_vertices:
        raise UserError(
            f"{KEY}: {path}: faces must name vertices 0 to {num_vertices - 1}, got {faces.max()}"
        )
    return faces


def _mesh_depths(vertices: np.ndarray, faces: np.ndarray) -> Callable[[Viewpoint], np.ndarray]:
    mesh = mi.Mesh("mesh", len(vertices), len(faces) // 3)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces
    parameters.update()
    return partial(_mesh_depth, mi.load_dict({"type": "scene", "mesh": mesh}))


def _mesh_depth(scene: mi.Scene, view: Viewpoint) -> np.ndarray:
    """Return the depth (H, W) float32 of the first surface at each pixel's centre; 0: none."""
    size, rotation = (view.width, view.height), view.viewmat[:3, :3]
    lens = view.lens or PINHOLE
    camera = Camera.create(mi.Float, rotation, view.center, view.K, *size, 0.0, lens)
    pixel = dr.arange(mi.UInt32, view.width * view.height)
    x, y = mi.Float(pixel % view.width) + 0.5, mi.Float(pixel // view.width) + 0.5
    origin, direction, is_ray = camera.look_through(x, y)
    to_world = camera.rotation.T
    ray = mi.Ray3f(mi.Point3f(camera.center + to_world @ origin), mi.Vector3f(to_world @ direction))
    hit = scene.ray_intersect_preliminary(ray)
    met = hit.is_valid() & is_ray
    shown, _, depth = camera.lens.visibility(camera, origin + dr.select(met, hit.t, 1) * direction)
    return dr.select(met & shown, depth, 0).numpy().reshape(view.height, view.width)


def _point_depths(path: Path, points: np.ndarray) -> Callable[[Viewpoint], np.ndarray]:
    if len(points) <= NUM_NEIGHBOURS:
        raise UserError(f"{KEY}: {path}: at least {NUM_NEIGHBOURS + 1} points, got {len(points)}")
    with denormals_kept():
        distances, _ = KDTree(points).query(points, k=NUM_NEIGHBOURS + 1)
    columns = [np.ascontiguousarray(column) for column in points.T]
    return partial(_point_depth, columns, distances[:, 1:].mean(axis=1))


def _point_depth(columns: list[np.ndarray], spacing: np.ndarray, view: Viewpoint) -> np.ndarray:
    """Return the depth (H, W) float32 of the nearest shown point on each pixel; 0: none."""
    _, pixels, depths = shown_points(view, columns, spacing, PIXEL_WIDTH)
    nearest = np.full((view.height, view.width), np.inf, np.float32)
    np.minimum.at(nearest, pixels, depths.astype(np.float32))
    return np.where(np.isfinite(nearest), nearest, 0)
