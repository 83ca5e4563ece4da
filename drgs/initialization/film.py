"""Projection of world points to a view's image: a million start points in hundreds of views.

Matrix products are not used: their rounding depends on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np

from drgs.cameras.camera import Camera
from drgs.core.arrays import from_host, types_of
from drgs.datasets.types import Viewpoint

Columns = Sequence[np.ndarray]  # coordinates x, y, z, each (N,)


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
        seen = z > 0
        inverse = 1 / np.where(seen, z, 1)
        u = float(view.fx) * (x * inverse) + float(view.cx)
        v = float(view.fy) * (y * inverse) + float(view.cy)
        return u, v, np.where(seen, z, 0)
    Float = {4: llvm.Float, 8: llvm.Float64}[position[0].itemsize]
    point = types_of(Float).Array3f(*(from_host(Float, column) for column in position))
    K = np.array([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]])
    nearest = float(np.finfo(position[0].dtype).tiny)
    size = view.width, view.height
    camera = Camera.create(Float, np.eye(3), np.zeros(3), K, *size, nearest)
    lens = view.lens.upload(Float)
    seen, point, depth = lens.visibility(camera, point)
    film, depth = lens.project_point(camera, point), dr.select(seen, depth, 0)
    dr.eval(film, depth)
    return film.x.numpy(), film.y.numpy(), depth.numpy()
