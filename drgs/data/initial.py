"""The Gaussians that a fit starts from: random points, or a point cloud."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from drgs.config.schema import FitConfig, InitConfig
from drgs.core.denormals import denormals_kept
from drgs.core.errors import UserError
from drgs.data.start_box import (
    LEAST_LOOKING,
    box_to_start_in,
    num_looking,
    points_in_view,
    where_they_look,
)
from drgs.data.types import Dataset, Viewpoint
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.sh import C0
from drgs.io.ply import read_points

MIN_SQUARED_DISTANCE = 1e-7
"""World units^2: lower bound of a Gaussian's squared first scale (3DGS reference), for points
that coincide."""

NUM_NEIGHBOURS = 3


def initial_gaussians(config: FitConfig, dataset: Dataset) -> Gaussians:
    """Gaussians at iteration 0, numpy float32, with the SH degree of ``config.model``.

    Positions: ``init.point_cloud``; else uniform in [-h, h]^3 with ``init.half_extent``; else the
    point cloud that the dataset names; else in a box derived from the layout and the cameras
    (``drgs.data.start_box``). The same seed gives the same points.

    Raises :class:`UserError` for points that the cameras do not see.
    """
    init = config.init
    cloud, colors = point_cloud_of(init, dataset), None
    if cloud is not None:
        means, colors = read_points(cloud)
        if colors is not None and not np.any(colors):
            colors = None  # all black: what is written where no colours were found out
        _check_cloud(cloud, means, config.densify.max_gaussians, dataset.train)
    else:
        rng = np.random.default_rng(config.seed)
        box = box_to_start_in(init, dataset)
        if box is not None:
            means = box.points(init.num_points, rng)
        else:
            means = points_in_view(dataset.train, init.num_points, rng)
    return gaussians_from_points(means, colors, init.opacity, config.model.sh_degree)


def point_cloud_of(init: InitConfig, dataset: Dataset) -> Path | None:
    """The file that a fit starts from; None: random points."""
    if init.point_cloud is not None or init.half_extent is not None:
        return init.point_cloud
    return dataset.point_cloud


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


def _check_cloud(
    file: Path, points: np.ndarray, max_gaussians: int, views: Sequence[Viewpoint]
) -> None:
    """Refuse a cloud (N, 3) of too few or too many points, or that is not what is photographed."""
    num = len(points)
    if num <= NUM_NEIGHBOURS:
        raise UserError(f"{file}: at least {NUM_NEIGHBOURS + 1} points, got {num}")
    if num > max_gaussians:
        raise UserError(
            f"{file}: must hold at most densify.max_gaussians ({max_gaussians}) points, got {num}"
        )
    looking = num_looking(points, views)
    if looking < LEAST_LOOKING * len(views):
        raise UserError(
            f"{file}: must hold what the cameras look at{where_they_look(views)}, in their frame "
            f"of reference, but only {looking} of {len(views)} have any of its {num:,} points in "
            "the middle of their pictures; give another init.point_cloud, or start from random "
            "points (init.point_cloud=null, data.ignore_points=true)"
        )
