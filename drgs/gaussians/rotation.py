"""Gaussians rotated as a whole: positions, quaternions and spherical harmonics. Host code.

The harmonics of one degree transform among themselves (Green 2003, "Spherical Harmonic Lighting:
The Gritty Details"). Their matrix is found by projection: it is determined by the functions' values
in enough directions, whatever their order and signs.
"""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np
from scipy.spatial.transform import Rotation

from drgs.core.errors import UserError
from drgs.core.types import Array3f
from drgs.gaussians.sh import num_coefficients, sh_basis

MAX_QUATERNION = 1e30  # components of larger ones might leave float32 when they are turned


def to_float32(name: str, values: np.ndarray) -> np.ndarray:
    """Return the numbers in single precision.

    Raises :class:`UserError` where finite ones are beyond it.
    """
    bad = np.argwhere(np.isfinite(values) & (np.abs(values) > np.finfo(np.float32).max))
    if len(bad):
        raise UserError(
            f"{name} of Gaussian {bad[0][0]} is {values[tuple(bad[0])]:g} once it is moved, and "
            "float32 ends at 3.4e38; crop or scale the scene"
        )
    return values.astype(np.float32)


def rotate_gaussians(
    means: np.ndarray, quats: np.ndarray, shN: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, quaternions and harmonics after x' = R x; float64, of the same shapes.

    means: (N, 3); quats: (N, 4) wxyz, of any norm, which they keep up to 1e30; shN: (N, K - 1, 3)
    of degree 1 and above; rotation: R (3, 3), orthonormal, determinant 1.
    """
    quats = quats.astype(np.float64)
    sizes = np.abs(quats).max(axis=1, keepdims=True, initial=MAX_QUATERNION)
    return (
        means @ rotation.T,
        quats / (sizes / MAX_QUATERNION) @ left_multiplication_matrix(rotation).T,
        rotate_sh(shN.astype(np.float64), rotation),
    )


def left_multiplication_matrix(rotation: np.ndarray) -> np.ndarray:
    """(4, 4): Hamilton's product with a rotation's quaternion from the left, of wxyz.

    rotation: (3, 3), orthonormal, determinant 1.
    """
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


NUM_DIRECTIONS = 64
"""Spread over the sphere, many more than the 7 functions of degree 3: the equations are then as
well conditioned as the functions are orthogonal."""


def sh_rotation_matrices(rotation: np.ndarray, degree: int) -> list[np.ndarray]:
    """Return for each degree l from 1 to ``degree`` the matrix D (2 l + 1, 2 l + 1) with c' = D c.

    rotation: R (3, 3), x' = R x. With c' for c, the function's value in a direction R d is what it
    was in d: sum_k Y_k(d') c'_k = sum_k Y_k(R^T d') c_k for all unit d'. float64.
    """
    return _project_values(_basis(_directions() @ rotation, degree), degree)


@cache
def sh_rotation_generators(degree: int) -> list[list[np.ndarray]]:
    """Return derivatives of :func:`sh_rotation_matrices` at the identity, about x, y and z.

    A rotation by the small vector w turns c into c + sum_a w_a G_a c: the function's value at d is
    then that at d - w x d, differentiated here by a complex step, exact for polynomials. float64.
    """
    directions, step = _directions(), 1e-20
    ahead = [directions - 1j * step * np.cross(axis, directions) for axis in np.eye(3)]
    return [_project_values(np.imag(_basis(points, degree)) / step, degree) for points in ahead]


def _project_values(values: np.ndarray, degree: int) -> list[np.ndarray]:
    """Matrices, by degree from 1 on, of functions with these values in :func:`_directions`."""
    basis = _basis(_directions(), degree)
    bands = [slice(num_coefficients(k - 1), num_coefficients(k)) for k in range(1, degree + 1)]
    return [np.linalg.lstsq(basis[:, b], values[:, b], rcond=None)[0] for b in bands]


def rotate_sh(coefficients: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return rotated coefficients (N, K - 1, 3) of degree 1 and above; K = (degree + 1)^2."""
    degree = round(np.sqrt(coefficients.shape[1] + 1)) - 1
    turned, start = [coefficients[:, :0]], 0
    for matrix in sh_rotation_matrices(rotation, degree):
        band = coefficients[:, start : start + len(matrix)]
        turned.append(np.einsum("kj,njc->nkc", matrix, band))
        start += len(matrix)
    return np.concatenate(turned, axis=1)


def _directions() -> np.ndarray:
    """(NUM_DIRECTIONS, 3) unit vectors: a Fibonacci lattice."""
    index = np.arange(NUM_DIRECTIONS)
    z = 1 - (2 * index + 1) / NUM_DIRECTIONS
    radius, angle = np.sqrt(1 - z * z), index * np.pi * (3 - np.sqrt(5))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """(N, (degree + 1)^2) values in unit directions (N, 3)."""
    x, y, z = directions.T
    # The formulas are the same for numpy arrays, also complex ones.
    direction = cast("Array3f", SimpleNamespace(x=x, y=y, z=z))
    columns = cast("list[np.ndarray]", sh_basis(direction, degree))
    return np.stack([np.broadcast_to(column, x.shape) for column in columns], axis=1)
