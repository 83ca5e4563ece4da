"""Gaussians that are rotated as a whole: positions, rotations and harmonics. Host code."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from drgs.gaussians.sh_rotation import rotated


def turned(
    means: np.ndarray,
    quats: np.ndarray,
    shN: np.ndarray,
    rotation: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, quaternions and harmonics after x' = R x; float64, of the same shapes.

    means: (N, 3); quats: (N, 4) wxyz, of any norm, which they keep; shN: (N, K - 1, 3) of degree 1
    and above; rotation: R (3, 3), orthonormal, determinant 1.
    """
    wxyz = np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
    return (
        means @ rotation.T,
        _product(wxyz, quats.astype(np.float64)),
        rotated(shN.astype(np.float64), rotation),
    )


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton's product of a quaternion (4,) and quaternions (N, 4), wxyz: first b, then a."""
    w, x, y, z = a
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return b @ left.T
