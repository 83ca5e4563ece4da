"""Some of the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from drgs.gaussians.parameters import Gaussians


def find_kept(
    gaussians: Gaussians[np.ndarray],
    box: Sequence[float] | None = None,
    min_opacity: float | None = None,
    max_scale: float | None = None,
) -> dict[str, np.ndarray]:
    """Return the mask (N,) of the Gaussians that each given criterion keeps.

    box: two opposite corners, world, of the means; max_scale: standard deviation, world units.
    """
    kept = {}
    if box is not None:
        corners = np.reshape(box, (2, 3))
        means = gaussians.means.astype(np.float64) + gaussians.origin
        inside = (means >= corners.min(axis=0)) & (means <= corners.max(axis=0))
        kept["box"] = inside.all(axis=1)
    if min_opacity is not None:
        kept["opacity"] = gaussians.opacities >= min_opacity
    if max_scale is not None:
        kept["size"] = gaussians.scales.max(axis=1) <= max_scale
    return kept


def take(gaussians: Gaussians[np.ndarray], rows: np.ndarray) -> Gaussians[np.ndarray]:
    """Return some of the Gaussians; rows: indices, or a mask (N,)."""
    values = {field.name: getattr(gaussians, field.name) for field in fields(gaussians)}
    arrays = {name: v[rows] for name, v in values.items() if isinstance(v, np.ndarray)}
    features = gaussians.features and {k: v[rows] for k, v in gaussians.features.items()}
    return replace(gaussians, **arrays, features=features)
