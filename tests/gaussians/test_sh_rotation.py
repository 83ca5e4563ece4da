"""Rotated spherical harmonics, against the reference's basis in rotated directions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drgs.gaussians.rotation import (
    rotate_sh,
    sh_rotation_generators,
    sh_rotation_matrices,
)
from drgs.reference import splatting as reference

# Values of a basis of at most 1.5 with 1e-16 of rounding, through a least-squares problem of a
# condition number below 2: some 1e-15.
ROUNDING = 1e-13

ROTATIONS = Rotation.random(4, random_state=3).as_matrix()


def directions(count=200):
    vectors = np.random.default_rng(1).normal(0, 1, (count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("rotation", ROTATIONS)
def test_rotated_sh_equals_sh_of_inversely_rotated_directions(rotation, degree):
    rng = np.random.default_rng(2)
    sh0, shN = rng.normal(0, 1, (5, 1, 3)), rng.normal(0, 1, (5, (degree + 1) ** 2 - 1, 3))
    d = directions()
    # d @ R is R^T d for the rows d.
    before = np.concatenate([sh0, shN], axis=1)
    expected = np.einsum("dk,nkc->ndc", reference.sh_basis(d @ rotation, degree), before)
    after = np.concatenate([sh0, rotate_sh(shN, rotation)], axis=1)
    actual = np.einsum("dk,nkc->ndc", reference.sh_basis(d, degree), after)
    np.testing.assert_allclose(actual, expected, atol=ROUNDING * 16)
    if degree > 0:
        unturned = np.einsum("dk,nkc->ndc", reference.sh_basis(d, degree), before)
        assert np.abs(unturned - expected).max() > 0.1


def test_matrices_are_orthogonal_and_compose_like_rotations():
    a, b = ROTATIONS[:2]
    for of_a, of_b, of_both in zip(
        *(sh_rotation_matrices(r, 3) for r in (a, b, a @ b)), strict=True
    ):
        np.testing.assert_allclose(of_a @ of_a.T, np.eye(len(of_a)), atol=ROUNDING)
        np.testing.assert_allclose(of_a @ of_b, of_both, atol=ROUNDING)


def test_one_matrix_per_degree():
    assert [m.shape for m in sh_rotation_matrices(ROTATIONS[0], 3)] == [(3, 3), (5, 5), (7, 7)]
    assert sh_rotation_matrices(ROTATIONS[0], 0) == []
    for matrix in sh_rotation_matrices(np.eye(3), 3):
        np.testing.assert_allclose(matrix, np.eye(len(matrix)), atol=ROUNDING)


@pytest.mark.parametrize("axis", range(3))
def test_generators_are_the_derivatives_of_matrices(axis):
    """Central differences: third derivatives are at most 27, l^3."""
    step = 1e-4
    ends = [
        sh_rotation_matrices(Rotation.from_rotvec(sign * step * np.eye(3)[axis]).as_matrix(), 3)
        for sign in (1, -1)
    ]
    for generator, ahead, behind in zip(sh_rotation_generators(3)[axis], *ends, strict=True):
        np.testing.assert_allclose(generator, (ahead - behind) / (2 * step), atol=27 * step**2)
        np.testing.assert_allclose(generator, -generator.T, atol=ROUNDING)
        assert np.abs(generator).max() > 0.9
