"""Gaussians that are rotated as a whole: positions, rotations and harmonics. Host code."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from drgs.core.errors import UserError
from drgs.gaussians.sh_rotation import rotated

MAX_QUATERNION = 1e30
"""Components of larger ones might leave float32 when they are turned."""


def as_float32(name: str, values: np.ndarray) -> np.ndarray:
    """The numbers in single precision.

    Raises :class:`UserError` where finite ones are beyond it.
    """
    bad = np.argwhere(np.isfinite(values) & (np.abs(values) > np.finfo(np.float32).max))
    if len(bad):
        raise UserError(
            f"{name} of Gaussian {bad[0][0]} is {values[tuple(bad[0])]:g} once it is moved, and "
            "float32 ends at 3.4e38; crop or scale the scene"
        )
    return values.astype(np.float32)


def turned(
    means: np.ndarray,
    quats: np.ndarray,
    shN: np.ndarray,
    rotation: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, quaternions and harmonics after x' = R x; float64, of the same shapes.

    means: (N, 3); quats: (N, 4) wxyz, of any norm, which they keep up to 1e30; shN: (N, K - 1, 3)
    of degree 1 and above; rotation: R (3, 3), orthonormal, determinant 1.
    """
    quats = quats.astype(np.float64)
    sizes = np.abs(quats).max(axis=1, keepdims=True, initial=MAX_QUATERNION)
    return (
        means @ rotation.T,
        quats / (sizes / MAX_QUATERNION) @ left_product(rotation).T,
        rotated(shN.astype(np.float64), rotation),
    )


def left_product(rotation: np.ndarray) -> np.ndarray:
    """(4, 4): Hamilton's product with a rotation's quaternion from the left, of wxyz.

    rotation: (3, 3), orthonormal, determinant 1.
    """
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
