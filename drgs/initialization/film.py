"""Where points of the world are in a view's picture, in numpy: before there is anything to render.

For start points, of which a million are looked at in hundreds of pictures. No matrix products,
whose rounding depends on how many threads a library of linear algebra has.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from drgs.cameras.polynomials import polynomial
from drgs.datasets.types import Viewpoint

if TYPE_CHECKING:
    from drgs.cameras.fisheye import Fisheye
    from drgs.cameras.radial_tangential import RadialTangential
    from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye

Columns = Sequence[np.ndarray]
"""Of coordinates: x, y, z, each (N,)."""


def is_projectable(view: Viewpoint) -> bool:
    """Whether a point has one place in the picture: its camera stands still, its lens is known."""
    return view.motion is None and (view.lens is None or view.lens.kind in _PLACES)


def to_camera(view: Viewpoint, points: Columns, dtype: type = np.float64) -> list[np.ndarray]:
    """Points in the camera's axes (x right, y down, z forward), scene units.

    points: world, float64; dtype: of the result. It is enough to have offsets from the camera in
    single precision, wherever both are.
    """
    center, axes = view.center.tolist(), view.camera_to_world[:3, :3].T.tolist()
    offsets = [(p - c).astype(dtype, copy=False) for p, c in zip(points, center, strict=True)]
    return [a * offsets[0] + b * offsets[1] + c * offsets[2] for a, b, c in axes]


def to_film(view: Viewpoint, position: Columns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places u, v (N,) on the film, px, and depths (N,), scene units; 0: the lens does not see it.

    position: in the camera's axes. What is seen may lie off the film; places of what is not seen
    are finite and mean nothing. The equations, and what depth is, are those of ``drgs.cameras``.
    """
    place = _PLACES[None if view.lens is None else view.lens.kind]
    x, y, depth = place(view.lens, *position)
    fx, fy, cx, cy = map(float, (view.fx, view.fy, view.cx, view.cy))
    return fx * x + cx, fy * y + cy, depth


def _through_pinhole(_lens: None, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Columns:
    seen = z > 0
    inverse = 1 / np.where(seen, z, 1)
    return x * inverse, y * inverse, np.where(seen, z, 0)


def _through_opencv(lens: RadialTangential, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Columns:
    x, y, depth = _through_pinhole(None, x, y, z)
    seen = (depth > 0) & lens.is_within(x, y)
    return *lens.distort(np.where(seen, x, 0), np.where(seen, y, 0)), np.where(seen, depth, 0)


def _through_fisheye(lens: Fisheye, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Columns:
    return _by_angle(lens, lens.coefficients, (x, y, z))


def _through_thin_prism_fisheye(
    lens: ThinPrismFisheye, x: np.ndarray, y: np.ndarray, z: np.ndarray
) -> Columns:
    u, v, distance = _by_angle(lens, (), (x, y, z))
    return *lens.distort(u, v), distance


def _by_angle(lens: Fisheye, coefficients: Sequence[float], position: Columns) -> Columns:
    x, y, z = position
    radius = np.hypot(x, y)
    distance = np.hypot(radius, z)
    angle = np.arctan2(radius, z)
    distorted = angle * polynomial(coefficients, angle * angle)
    scale = distorted / np.where(radius > 0, radius, 1)  # times 0 on the axis
    seen = z > lens.min_cosine * distance
    return *(np.where(seen, scale * c, 0) for c in (x, y)), np.where(seen, distance, 0)


_PLACES = {
    None: _through_pinhole,
    "opencv": _through_opencv,
    "fisheye": _through_fisheye,
    "thin_prism_fisheye": _through_thin_prism_fisheye,
}
"""By kind of lens: the film's plane at distance 1 where a point is shown, and its depth."""
