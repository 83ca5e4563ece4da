"""Colours of points from the images that show them.

An image shows a point if no other point is clearly nearer to its camera in a z-buffer whose pixels
are as wide as the points are apart. On a surface that turns away from the camera, points hide each
other, so that images count that look onto it. The middle half of a point's colours is averaged: the
rest may be highlights or occluders.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from drgs.core.environment import denormals_kept
from drgs.datasets.film import is_projectable, shown_points
from drgs.datasets.types import View

MAX_VIEWS, MIN_VIEWS = 60, 8
"""Number of views whose images are read: a third of them see most points."""

MAX_BYTES = 1 << 27  # memory for colours: of a million points, fewer views are read

MIN_ALPHA = 0.5  # less opaque pixels mostly show the background

POINTS_PER_SORT = 1 << 13


def colors_from_images(
    points: np.ndarray,
    spacing: np.ndarray,
    views: Sequence[View],
    background: tuple[float, float, float],
) -> np.ndarray | None:
    """Return colours (N, 3) float32, display space 0..1; None: no image shows any of the points.

    points: (N, 3) world; spacing: (N,) scene units, of each to its neighbours; background: of
    the composited images, display space. A point that no image shows gets the colour of the nearest
    point that is shown.
    """
    views = [view for view in views if is_projectable(view)]
    most = max(MIN_VIEWS, min(MAX_VIEWS, MAX_BYTES // (12 * len(points))))
    views = views[:: -(-len(views) // most) or 1]
    samples = np.full((len(views), len(points), 3), np.inf, np.float32)
    columns = [np.ascontiguousarray(c, np.float64) for c in np.asarray(points).T]
    for view, sample in zip(views, samples, strict=True):
        rows, colors = _find_shown_points(view, columns, spacing, background)
        sample[rows] = colors
    colors = np.concatenate(
        [
            _middle_mean(samples[:, k : k + POINTS_PER_SORT])
            for k in range(0, len(points), POINTS_PER_SORT)
        ]
    )
    unseen = np.isnan(colors[:, 0])
    if unseen.all():
        return None
    if unseen.any():
        with denormals_kept():
            _, nearest = KDTree(points[~unseen]).query(points[unseen])
        colors[unseen] = colors[~unseen][nearest]
    return colors


def _find_shown_points(
    view: View,
    columns: Sequence[np.ndarray],
    spacing: np.ndarray,
    background: tuple[float, float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Return indices of points that the image shows, and their colours (M, 3) float32, 0..1."""
    rows, at, _ = shown_points(view, columns, spacing)
    if not len(rows):
        return rows, np.empty((0, 3), np.float32)
    colors, opaque = np.asarray(view.image)[at], np.ones(len(rows), bool)
    if view.alpha is not None:
        alpha = np.asarray(view.alpha)[at][:, None]
        opaque = alpha[:, 0] >= MIN_ALPHA
        behind = (1 - alpha) * np.asarray(background, np.float32)
        colors = (colors - behind) / np.maximum(alpha, MIN_ALPHA)
    if view.mask is not None:
        opaque &= np.asarray(view.mask)[at] > 0
    return rows[opaque], np.clip(colors[opaque], 0, 1)


def _middle_mean(samples: np.ndarray) -> np.ndarray:
    """Return means (N, 3) of the middle half of (V, N, 3), channel by channel; NaN: there are none.

    inf: not a sample. Of n, floor(n / 4) are left out at either end.
    """
    ordered, count = np.sort(samples, axis=0), np.isfinite(samples[:, :, 0]).sum(axis=0)
    rank, left_out = np.arange(len(samples))[:, None], count // 4
    kept = (rank >= left_out) & (rank < count - left_out)
    total = np.where(kept[:, :, None], ordered, 0).sum(axis=0, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        return (total / kept.sum(axis=0)[:, None]).astype(np.float32)
