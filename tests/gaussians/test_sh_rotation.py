"""Rotated spherical harmonics, against the reference's basis in rotated directions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drgs.gaussians.rotation import rotate_sh, sh_rotation_generators, sh_rotation_matrices
from drgs.reference import splatting as reference

# Values of a basis of at most 1.5 with 1e-16 of rounding, through a least-squares problem of a
# condition number below 2: some 1e-15.
ROUNDING = 1e-13

ROTATIONS = Rotation.random(4, random_state=3).as_matrix()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("rotation", ROTATIONS)
def test_rotated_sh_equals_sh_of_inversely_rotated_directions(rotation, degree):
    rng = np.random.default_rng(2)
    sh0, shN = rng.normal(0, 1, (5, 1, 3)), rng.normal(0, 1, (5, (degree + 1) ** 2 - 1, 3))
    d = rng.normal(0, 1, (200, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    before = np.concatenate([sh0, shN], axis=1)
    after = np.concatenate([sh0, rotate_sh(shN, rotation)], axis=1)
    # d @ R is R^T d for the rows d.
    expected = np.einsum("dk,nkc->ndc", reference.sh_basis(d @ rotation, degree), before)
    basis = reference.sh_basis(d, degree)
    np.testing.assert_allclose(np.einsum("dk,nkc->ndc", basis, after), expected, atol=16 * ROUNDING)
    if degree > 0:
        assert np.abs(np.einsum("dk,nkc->ndc", basis, before) - expected).max() > 0.1


def test_matrices_are_orthogonal_and_compose_like_rotations():
    a, b = ROTATIONS[:2]
    matrices = (sh_rotation_matrices(r, 3) for r in (a, b, a @ b))
    for degree, (of_a, of_b, of_both) in enumerate(zip(*matrices, strict=True), 1):
        np.testing.assert_allclose(of_a @ of_a.T, np.eye(2 * degree + 1), atol=ROUNDING)
        np.testing.assert_allclose(of_a @ of_b, of_both, atol=ROUNDING)
    assert sh_rotation_matrices(a, 0) == []


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
        assert np.abs(generator).max() > 0.9
