"""The Gaussians that a fit starts from: random points, or a point cloud."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from drgs.config.schema import FitConfig, InitConfig
from drgs.core.denormals import denormals_kept
from drgs.core.errors import UserError
from drgs.data.types import Dataset, Viewpoint
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.sh import C0
from drgs.io.ply import read_points

MIN_SQUARED_DISTANCE = 1e-7
"""World units^2: lower bound of a Gaussian's squared first scale (3DGS reference), for points
that coincide."""

NUM_NEIGHBOURS = 3

PARALLEL_AXES = 1e-3
"""Smallest eigenvalue of mean(I - d d^T), d the optical axes: about the mean squared sine of
their angle to a common direction. Below this (1.8 degrees) their nearest point is noise."""

KEEP_OUT = 0.25
"""Of the distance to what the cameras look at: no starting point is nearer to a camera."""

MAX_BATCHES = 200
"""Batches of points to draw: enough where half a percent of the box is in view."""


def initial_gaussians(config: FitConfig, dataset: Dataset) -> Gaussians:
    """Gaussians at iteration 0, numpy float32, with the SH degree of ``config.model``.

    Positions: ``init.point_cloud``; else uniform in [-h, h]^3 with ``init.half_extent``; else in
    the layout's own box; else in a box derived from the cameras (:func:`points_in_view`). The
    same seed gives the same points.
    """
    init = config.init
    colors = None
    if init.point_cloud is not None:
        means, colors = read_points(init.point_cloud)
        _check_count(init, len(means), config.densify.max_gaussians)
    else:
        rng = np.random.default_rng(config.seed)
        half_extent = init.half_extent or dataset.start_half_extent
        if half_extent is not None:
            means = rng.uniform(-half_extent, half_extent, (init.num_points, 3))
        else:
            means = points_in_view(dataset.train, init.num_points, rng)
    return gaussians_from_points(means, colors, init.opacity, config.model.sh_degree)


def gaussians_from_points(
    means: np.ndarray, colors: np.ndarray | None, opacity: float, sh_degree: int
) -> Gaussians:
    """Isotropic Gaussians at ``means`` (N, 3), N >= 4, as large as the gaps between them.

    The standard deviation is the root mean square distance to the 3 nearest other points, as in
    the 3DGS reference (``distCUDA2``). ``colors`` (N, 3) in display space 0..1; None: grey.
    Identity rotations; SH coefficients above degree 0 are zero.
    """
    num = len(means)
    means = np.ascontiguousarray(means, np.float32)
    colors = np.full((num, 3), 0.5) if colors is None else colors
    squared = np.maximum(mean_squared_neighbour_distance(means), MIN_SQUARED_DISTANCE)
    log_scales = np.repeat(0.5 * np.log(squared)[:, None], 3, axis=1)
    sh0 = (np.asarray(colors, np.float64) - 0.5) / C0
    return Gaussians(
        means=means,
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (num, 1)),
        log_scales=log_scales.astype(np.float32),
        logit_opacities=np.full(num, np.log(opacity / (1 - opacity)), np.float32),
        sh0=sh0.astype(np.float32)[:, None, :],
        shN=np.zeros((num, (sh_degree + 1) ** 2 - 1, 3), np.float32),
    )


def mean_squared_neighbour_distance(points: np.ndarray) -> np.ndarray:
    """(N,) float64: mean squared distance of each of (N, 3) points to the 3 nearest others."""
    # SciPy divides points by the number next to the least. If that is taken for zero, it divides
    # points with a coordinate of zero for ever, until the stack ends.
    with denormals_kept():
        distances, _ = cKDTree(points).query(points, k=NUM_NEIGHBOURS + 1)
    # The nearest is the point itself, or one at the same place: at distance 0 either way.
    return np.mean(distances[:, 1:] ** 2, axis=1)


def focus_of(views: Sequence[Viewpoint]) -> tuple[np.ndarray, float]:
    """What the cameras look at: (3,) the point nearest to all optical axes, and the distance.

    Minimises sum_i |(I - d_i d_i^T)(p - c_i)|^2 over p, with c_i the centres and d_i the axes;
    the distance is the median of |p - c_i|.

    Raises :class:`UserError` where the axes do not determine it or diverge.
    """
    centers = np.stack([view.center for view in views])
    axes = np.stack([view.camera_to_world[:3, 2] for view in views])
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = projectors.mean(axis=0)
    remedy = "set init.half_extent, or give a point cloud (init.point_cloud)"
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


def points_in_view(views: Sequence[Viewpoint], count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) float64: uniform in what is seen of a cube around the cameras' focus.

    The cube's half extent is the distance D to the focus: it holds what is looked at and as much
    again behind it. Points that no camera sees would never be moved or removed, and one close to
    a camera covers its picture, so only points are kept that lie in a picture and nowhere nearer
    than D / 4 to a camera.
    """
    focus, distance = focus_of(views)
    kept = np.empty((0, 3))
    for _ in range(MAX_BATCHES):
        points = rng.uniform(focus - distance, focus + distance, (count, 3))
        kept = np.concatenate([kept, points[_in_view(points, views, KEEP_OUT * distance)]])
        if len(kept) >= count:
            return kept[:count]
    raise UserError(
        "init.half_extent: no start box can be derived from the cameras, which see too little of "
        f"what is around {np.round(focus, 3).tolist()}; set it, or give init.point_cloud"
    )


def _in_view(points: np.ndarray, views: Sequence[Viewpoint], keep_out: float) -> np.ndarray:
    """(N,) bool: inside at least one picture, and at least ``keep_out`` from every camera."""
    seen = np.zeros(len(points), bool)
    clear = np.ones(len(points), bool)
    for view in views:
        offsets = points - view.center
        x, y, z = (offsets @ view.camera_to_world[:3, :3]).T
        clear &= np.einsum("ni,ni->n", offsets, offsets) >= keep_out**2
        # In pixels times z, so that nothing is divided by a depth near zero.
        u, v = view.fx * x + view.cx * z, view.fy * y + view.cy * z
        seen |= (z > 0) & (u >= 0) & (u <= view.width * z) & (v >= 0) & (v <= view.height * z)
    return seen & clear


def _check_count(init: InitConfig, num: int, max_gaussians: int) -> None:
    if num <= NUM_NEIGHBOURS:
        raise UserError(f"{init.point_cloud}: at least {NUM_NEIGHBOURS + 1} points, got {num}")
    if num > max_gaussians:
        raise UserError(
            f"{init.point_cloud}: must hold at most densify.max_gaussians ({max_gaussians}) "
            f"points, got {num}"
        )
