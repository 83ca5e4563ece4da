"""The point that the cameras look at, from which start boxes, orbits and near planes follow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drgs.core.errors import UserError
from drgs.datasets.types import Viewpoint

PARALLEL_AXES = 1e-3
"""Smallest eigenvalue of mean(I - d d^T), d the optical axes: about the mean squared sine of
their angle to a common direction. Below this (1.8 degrees) their nearest point is noise."""


def focus_of(views: Sequence[Viewpoint]) -> tuple[np.ndarray, float]:
    """Return the point (3,) nearest to all optical axes, and its distance from the cameras.

    Minimises sum_i |(I - d_i d_i^T)(p - c_i)|^2 over p, with c_i the centres and d_i the axes;
    the distance is the median of |p - c_i|.

    Raises :class:`UserError` where the axes do not determine it or diverge.
    """
    centers = np.stack([view.center for view in views])
    axes = np.stack([view.camera_to_world[:3, 2] for view in views])
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = projectors.mean(axis=0)
    remedy = "set init.half_extent, or give a point cloud (init.point_cloud)"
    if len(views) == 1:
        raise UserError(
            "init.half_extent: no start box can be derived from one training camera, which does "
            f"not tell how far away it looks; train on more views, or {remedy}"
        )
    if np.linalg.eigvalsh(normal)[0] < PARALLEL_AXES:
        raise UserError(
            "init.half_extent: no start box can be derived from the cameras, whose optical axes "
            f"are parallel; {remedy}"
        )
    focus = np.linalg.solve(normal, np.einsum("nij,nj->i", projectors, centers) / len(views))
    depths = np.einsum("ni,ni->n", focus - centers, axes)
    if np.median(depths) <= 1e-6 * np.abs(centers - focus).max():
        raise UserError(
            "init.half_extent: no start box can be derived from the cameras, which look away from "
            f"each other; {remedy}"
        )
    return focus, float(np.median(np.linalg.norm(focus - centers, axis=1)))
