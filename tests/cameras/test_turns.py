"""Turns about an axis, and the rotations that they are."""

from __future__ import annotations

import drjit as dr
import numpy as np
from scipy.spatial.transform import Rotation
from support.helpers import FLOAT32, FLOAT64, both_precisions, rows, single

from drgs.cameras.motion import MIN_TURN_RAD, rotation_matrix, rotation_vector
from drgs.core.arrays import types_of


def matrices(values, precision) -> object:
    """Matrix3f of (N, 3, 3)."""
    values = np.asarray(values)
    return types_of(precision.Float).Matrix3f(
        [[precision.array(values[:, i, j]) for j in range(3)] for i in range(3)]
    )


def turns() -> np.ndarray:
    """(N, 3), radians: every size from nothing to almost half a turn, about every axis."""
    rng = np.random.default_rng(0)
    angles = np.concatenate([[0], 10.0 ** np.arange(-20, 0.4, 0.1), np.linspace(1, 3.1, 50)])
    at = MIN_TURN_RAD * (1 + np.array([-1e-2, -1e-6, 1e-6, 1e-2]))
    angles = np.concatenate([angles, at])
    axes = rng.normal(size=(len(angles), 3))
    axes[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    axes[-20:-14] = axes[:6]
    return single(angles[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True))


@both_precisions
def test_rotation_vector_gives_rotation_about_its_axis_by_its_length(precision):
    actual = np.moveaxis(np.array(rotation_matrix(precision.vectors(turns()))), -1, 0)
    expected = Rotation.from_rotvec(turns()).as_matrix()
    # Some roundings of numbers of size one. Measured: 4e-16 and 2e-7.
    tolerance = {FLOAT64: 2e-15, FLOAT32: 1e-6}[precision]
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance)


@both_precisions
def test_rotation_vector_inverts_rotation_matrix(precision):
    rotations = Rotation.from_rotvec(turns()).as_matrix()
    actual = rows(rotation_vector(matrices(rotations, precision)))
    angles = np.linalg.norm(turns(), axis=1)
    # The entries' roundings; next to half a turn, over the sine that tells the axis. Below
    # SLOWEST the angle is its sine: off by SLOWEST^3 / 6.
    tolerance = {FLOAT64: 1e-14, FLOAT32: 1e-6}[precision] / np.sin(np.clip(angles, 0.5, 3.1))
    errors = np.abs(actual - turns()).max(axis=1)
    assert (errors <= tolerance + (angles < 2 * MIN_TURN_RAD) * 2e-13).all()


def test_derivatives_at_zero_rotation_match_small_rotations():
    """(a_x)' = e_x: nothing is divided by an angle of zero."""
    turn = FLOAT64.vectors(np.zeros((1, 3)))
    dr.enable_grad(turn)
    matrix = rotation_matrix(turn)
    dr.backward(matrix[2, 1] + 10 * matrix[0, 2] + 100 * matrix[1, 0] + 1000 * matrix[0, 0])
    assert rows(dr.grad(turn)).tolist() == [[1, 10, 100]]
    rotation = matrices(np.eye(3)[None], FLOAT64)
    dr.enable_grad(rotation)
    dr.backward(rotation_vector(rotation).y)
    gradient = np.array(dr.grad(rotation))[..., 0]
    np.testing.assert_allclose(gradient, [[0, 0, 0.5], [0, 0, 0], [-0.5, 0, 0]], atol=1e-15)
