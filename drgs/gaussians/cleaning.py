"""Which Gaussians of a model are kept, and how the model lies: before it goes to other programs.

Host code.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.similarity import Similarity


@dataclass(frozen=True)
class Selection:
    """What Gaussians are kept for; None: for whatever it is."""

    box: tuple[float, ...] | None = None  # two opposite corners, world: means within are kept
    min_opacity: float | None = None
    max_scale: float | None = None  # world units: of the largest standard deviation

    def kept_by(self, gaussians: Gaussians) -> dict[str, np.ndarray]:
        """By what is chosen, which Gaussians (N,) it keeps; gaussians: numpy."""
        kept = {}
        if self.box is not None:
            corners = np.reshape(self.box, (2, 3))
            means = gaussians.means.astype(np.float64) + gaussians.origin
            inside = (means >= corners.min(axis=0)) & (means <= corners.max(axis=0))
            kept["box"] = inside.all(axis=1)
        if self.min_opacity is not None:
            kept["opacity"] = gaussians.opacities >= self.min_opacity
        if self.max_scale is not None:
            kept["size"] = gaussians.scales.max(axis=1) <= self.max_scale
        return kept


def taken(gaussians: Gaussians, rows: np.ndarray) -> Gaussians:
    """Some of them, in another order perhaps; numpy. rows: indices, or (N,) of truth values."""
    arrays = {
        field.name: getattr(gaussians, field.name)[rows]
        for field in fields(gaussians)
        if isinstance(getattr(gaussians, field.name), np.ndarray)
    }
    features = gaussians.features and {k: v[rows] for k, v in gaussians.features.items()}
    return replace(gaussians, **arrays, features=features)


def turned_towards(gaussians: Gaussians, direction: np.ndarray, towards: np.ndarray) -> Gaussians:
    """The model turned, the shortest way, so that ``direction`` becomes ``towards``; numpy.

    direction, towards: (3,) world, of length 1. Opposite ones: about the axis that is nearest to
    perpendicular, x before y before z.
    """
    rotation = shortest_rotation(direction, towards)
    return Similarity(1.0, rotation, np.zeros(3)).of_gaussians(gaussians)


def shortest_rotation(direction: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """(3, 3) rotation R with R direction = towards: see :func:`turned_towards`.

    Two reflections (Householder), by the plane between both and by ``direction``'s own.
    """
    between = direction + towards
    if np.linalg.norm(between) < 1e-6:  # opposite: half a turn about what is perpendicular
        axis = np.eye(3)[np.argmin(np.round(np.abs(direction), 6))]
        axis = axis - (axis @ direction) * direction
        axis = axis / np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    between = between / np.linalg.norm(between)
    half_turn = 2 * np.outer(between, between) - np.eye(3)
    return half_turn @ (2 * np.outer(direction, direction) - np.eye(3))
