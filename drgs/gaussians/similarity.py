"""Gaussians rotated, scaled and moved as a whole, without a change of their appearance.

Host code.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drgs.core.errors import PluginError
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.rotation import rotate_gaussians, to_float32

ROTATION_TOLERANCE = 1e-4
"""Limit of A^T A / s^2 - I: numbers written with five digits are a rotation, a shear by a pixel in
ten thousand is one. What is left is then taken off: the nearest rotation is used."""


@dataclass(frozen=True)
class Similarity:
    """x' = scale * rotation x + translation."""

    scale: float
    rotation: np.ndarray  # (3, 3), orthonormal, determinant 1
    translation: np.ndarray  # (3,)

    @staticmethod
    def from_matrix(matrix: np.ndarray, name: str) -> Similarity:
        """Return that of a matrix (4, 4). Raises PluginError that begins with ``name``."""
        matrix = np.asarray(matrix, np.float64)
        linear = matrix[:3, :3]
        is_affine = np.isfinite(matrix).all() and (matrix[3] == [0, 0, 0, 1]).all()
        if is_affine and (determinant := np.linalg.det(linear)) > 0:
            scale = np.cbrt(determinant)
            if np.abs(linear.T @ linear / scale**2 - np.eye(3)).max() <= ROTATION_TOLERANCE:
                left, _, right = np.linalg.svd(linear)
                return Similarity(float(scale), left @ right, matrix[:3, 3])
        rows = "; ".join(" ".join(f"{number:g}" for number in row) for row in matrix)
        raise PluginError(
            f"{name} must be made of rotations, translations and scales that are the same along "
            f"all axes and positive, got the matrix [{rows}]"
        )

    @property
    def is_identity(self) -> bool:
        """True where it moves nothing."""
        unmoved = not self.translation.any() and (self.rotation == np.eye(3)).all()
        return self.scale == 1 and bool(unmoved)

    def of_gaussians(self, gaussians: Gaussians[np.ndarray]) -> Gaussians[np.ndarray]:
        """Return Gaussians (numpy) moved, float32.

        Their origin is rotated and scaled, and the translation is added to the means.
        """
        g = gaussians
        means, quats, shN = rotate_gaussians(g.means, g.quats, g.shN, self.rotation)
        g = replace(
            g,
            means=self.scale * means + self.translation,
            quats=quats,
            log_scales=g.log_scales + np.log(self.scale),
            shN=shN,
            origin=tuple((self.scale * (self.rotation @ g.origin)).tolist()),
        )
        if g.smoothing is not None:
            g = replace(g, smoothing=(g.smoothing * self.scale).astype(np.float32))
        names = ("means", "quats", "log_scales", "shN")
        return replace(g, **{name: to_float32(name, getattr(g, name)) for name in names})


def shortest_rotation(direction: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Return the rotation R (3, 3) with R direction = towards, both (3,) of length 1.

    Two reflections (Householder), by the plane between both and by ``direction``'s own. Opposite
    ones: about the axis that is nearest to perpendicular, x before y before z.
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
