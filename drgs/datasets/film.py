"""Projection of world points to a view's image: a million points in hundreds of views.

Matrix products are not used: their rounding depends on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np

from drgs.cameras.camera import Camera
from drgs.cameras.viewpoints import Viewpoint
from drgs.core.arrays import from_host, types_of

Columns = Sequence[np.ndarray]  # coordinates x, y, z, each (N,)

PIXEL_WIDTH, MAX_BEHIND = 1.5, 1.5
"""Width of a pixel of the z-buffer, and largest distance behind its depth of shown points, in
distances of the points. In smaller pixels, points are seen through gaps of a surface."""


def is_projectable(view: Viewpoint) -> bool:
    """Return whether a point has one place in the image: the camera does not move."""
    return view.motion is None


def to_camera(view: Viewpoint, points: Columns, dtype: type = np.float64) -> list[np.ndarray]:
    """Return float64 world points in the camera's axes (x right, y down, z forward)."""
    center, axes = view.center.tolist(), view.camera_to_world[:3, :3].T.tolist()
    # Single precision is enough for offsets from a camera, wherever both are.
    offsets = [(p - c).astype(dtype, copy=False) for p, c in zip(points, center, strict=True)]
    return [a * offsets[0] + b * offsets[1] + c * offsets[2] for a, b, c in axes]


def to_film(view: Viewpoint, position: Columns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places u, v (N,) on the film, px, also beside it, and depths (N,), scene units.

    position: in the camera's axes. Where the lens does not see a point, the depth is 0 and the
    place is finite without a meaning.
    """
    if view.lens is None:
        x, y, z = position
        visible = z > 0
        inverse = 1 / np.where(visible, z, 1)
        u = float(view.fx) * (x * inverse) + float(view.cx)
        v = float(view.fy) * (y * inverse) + float(view.cy)
        return u, v, np.where(visible, z, 0)
    Float = {4: llvm.Float, 8: llvm.Float64}[position[0].itemsize]
    point = types_of(Float).Array3f(*(from_host(Float, column) for column in position))
    nearest = float(np.finfo(position[0].dtype).tiny)
    size = view.width, view.height
    camera = Camera.create(Float, np.eye(3), np.zeros(3), view.K, *size, nearest)
    lens = view.lens.upload(Float)
    visible, point, depth = lens.visibility(camera, point)
    film, depth = lens.project_point(camera, point), dr.select(visible, depth, 0)
    dr.eval(film, depth)
    return film.x.numpy(), film.y.numpy(), depth.numpy()


def shown_points(
    view: Viewpoint, points: Columns, spacing: np.ndarray, pixel_width: float = PIXEL_WIDTH
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return the points in the image that no clearly nearer point hides.

    points: world; spacing: (N,) scene units, of each to its neighbours. Returned are their indices
    (M,), the rows and columns of their pixels, and their depths (M,), scene units. pixel_width: of
    the z-buffer, in ``spacing``. On a surface that turns away from the camera, points hide each
    other.
    """
    u, v, depth = to_film(view, to_camera(view, points))
    on_film = (depth > 0) & (u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)
    indices = np.flatnonzero(on_film)
    u, v, depth, spacing = (values[indices] for values in (u, v, depth, spacing))
    if len(indices):
        pixel = max(1.0, pixel_width * view.fx * float(np.median(spacing / depth)))
        cell = np.floor(v / pixel).astype(np.int64) * (int(view.width / pixel) + 1)
        cell += np.floor(u / pixel).astype(np.int64)
        nearest = np.full(cell.max() + 1, np.inf)
        np.minimum.at(nearest, cell, depth)
        shown = depth <= nearest[cell] + MAX_BEHIND * spacing
        indices, u, v, depth = (values[shown] for values in (indices, u, v, depth))
    return indices, (v.astype(np.int64), u.astype(np.int64)), depth
