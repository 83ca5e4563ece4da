"""Spherical harmonics and their rotation, against the float64 reference and Legendre functions.

Colours and their gradients are those of images: see the laws, and ``tests/splatting``.
"""

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.helpers import both_precisions, rows, single
from support.reference_scenes import legendre_sh_basis

from drgs.gaussians import sh
from drgs.gaussians.rotation import rotate_sh, sh_rotation_generators, sh_rotation_matrices
from drgs.reference import splatting as reference


@both_precisions
@pytest.mark.parametrize("degree", range(4))
def test_basis_equals_the_reference_and_legendre_functions(precision, degree):
    vectors = np.random.default_rng(0).normal(0, 1, (64, 3))
    vectors[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    points = single(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
    basis = sh.sh_basis(precision.vectors(points), degree)
    ones = dr.ones(precision.Float, len(points))
    actual = np.stack([rows(value * ones) for value in basis], axis=-1)
    expected = reference.sh_basis(points, degree)
    # The largest basis function is a sum of up to four products of up to four factors of size one:
    # a dozen roundings. Measured: below 3 units of the format's epsilon.
    tolerance = 16 * float(np.finfo(precision.dtype).eps)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance)
    # Angles assume an exact unit vector: normalise again, which moves the basis by 1e-7 times
    # its degree and a factor below 3.
    units = points / np.linalg.norm(points, axis=1, keepdims=True)
    legendre = np.array([legendre_sh_basis(tuple(unit), degree) for unit in units])
    np.testing.assert_allclose(actual, legendre, rtol=0, atol=tolerance + 1e-6)


@both_precisions
def test_nan_stays_nan(precision):
    coefficient = precision.Array3f([np.nan, 0.0, 0.0])
    color = rows(sh.sh_color([coefficient], precision.Array3f(0, 0, 1), 0))
    assert np.isnan(color[0, 0]) and np.isfinite(color[0, 1:]).all()


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("rotation", Rotation.random(4, random_state=3).as_matrix())
def test_rotated_sh_equals_sh_of_inversely_rotated_directions(rotation, degree):
    rng = np.random.default_rng(2)
    before = rng.normal(0, 1, (5, (degree + 1) ** 2, 3))
    after = np.concatenate([before[:, :1], rotate_sh(before[:, 1:], rotation)], axis=1)
    d = rng.normal(0, 1, (200, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    # d @ R is R^T d for the rows d.
    expected = np.einsum("dk,nkc->ndc", reference.sh_basis(d @ rotation, degree), before)
    actual = np.einsum("dk,nkc->ndc", reference.sh_basis(d, degree), after)
    # 16 values of a basis of at most 1.5 with 1e-16 of rounding, through a least-squares problem
    # of a condition number below 2: some 1e-14.
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-13)


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
