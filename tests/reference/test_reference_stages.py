"""Stages of the float64 reference: harmonics, rotations, covariances; degenerate input."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from support.reference_scenes import (
    BACKGROUND,
    PARAMETERS,
    cotangents,
    legendre_sh_basis,
    needle,
    small_camera,
    small_scene,
)

from drgs.reference import splatting as reference
from drgs.reference.splatting import Camera, Gaussians

# ----------------------------------------------------------------------------------------------
# Stages
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_basis_equals_legendre_functions(degree):
    directions = np.random.default_rng(0).normal(0, 1, (20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = [legendre_sh_basis(direction, degree) for direction in directions]
    np.testing.assert_allclose(reference.sh_basis(directions, degree), expected, atol=1e-14)


def test_sh_basis_is_orthonormal():
    """Exact quadrature: products have degree 6; 4 Gauss nodes in z and 7 azimuths suffice."""
    nodes, node_weights = np.polynomial.legendre.leggauss(4)
    azimuths = 2 * np.pi * np.arange(7) / 7
    z, azimuth = (a.ravel() for a in np.meshgrid(nodes, azimuths, indexing="ij"))
    sine = np.sqrt(1 - z**2)
    directions = np.column_stack([sine * np.cos(azimuth), sine * np.sin(azimuth), z])
    weights = np.repeat(node_weights, 7) * 2 * np.pi / 7
    basis = reference.sh_basis(directions, 3)
    np.testing.assert_allclose(basis.T @ (weights[:, None] * basis), np.eye(16), atol=1e-14)


def test_rotation_matrices_are_rotations_whatever_the_norm():
    rng = np.random.default_rng(1)
    quats = rng.normal(0, 1, (50, 4))
    rotations = reference.quat_to_rotation(quats)
    products = rotations @ np.swapaxes(rotations, 1, 2)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (50, 1, 1)), atol=1e-15 * 4)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-14)
    scaled = quats * rng.uniform(1e-6, 1e6, (50, 1))
    np.testing.assert_allclose(reference.quat_to_rotation(scaled), rotations, atol=1e-14)
    quarter_turn_about_z = reference.quat_to_rotation(np.array([[1.0, 0, 0, 1]]))[0]
    np.testing.assert_allclose(quarter_turn_about_z @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def test_zero_quaternion_is_the_identity_and_has_no_gradient():
    np.testing.assert_array_equal(reference.quat_to_rotation(np.zeros((1, 4)))[0], np.eye(3))
    gaussians, camera = small_scene()
    quats = gaussians.quats.copy()
    quats[0] = 0
    changed = Gaussians(**{**vars(gaussians), "quats": quats})
    gradients = reference.render_gradients(changed, camera, BACKGROUND, **cotangents())
    assert not gradients["quats"][0].any() and gradients["quats"][1].any()
    assert all(np.isfinite(gradient).all() for gradient in gradients.values())


def test_covariance_has_the_squared_scales_as_eigenvalues():
    gaussians, _ = small_scene()
    eigenvalues = np.linalg.eigvalsh(reference.covariances(gaussians.quats, gaussians.log_scales))
    expected = np.sort(np.exp(2 * gaussians.log_scales), axis=1)
    np.testing.assert_allclose(eigenvalues, expected, rtol=1e-12)


def test_projected_covariance_matches_a_numeric_jacobian():
    gaussians, camera = small_scene()
    splats = reference.project(gaussians, camera)
    sigma = reference.covariances(gaussians.quats, gaussians.log_scales)

    def film_position(point):
        x, y, z = camera.rotation @ (point - camera.center)
        return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])

    for n in range(9):
        mean = gaussians.means[n]
        np.testing.assert_allclose(film_position(mean), splats.means2d[n], rtol=1e-14)
        jacobian = np.column_stack(
            [
                (film_position(mean + step) - film_position(mean - step)) / 2e-5
                for step in 1e-5 * np.eye(3)
            ]
        )
        expected = jacobian @ sigma[n] @ jacobian.T + 0.3 * np.eye(2)
        # Central differences with a step of 1e-5: third derivatives over 6 times 1e-10.
        np.testing.assert_allclose(splats.cov2d[n], expected, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(splats.conics[n] @ splats.cov2d[n], np.eye(2), atol=1e-13)


def test_needle_keeps_its_determinant():
    """cov2d = l^2 v v^T + 0.3 I, v at 45 degrees; entries of 1e14 would cancel to 1e-2."""
    gaussians, camera = needle(np.log([1e7, 1e-7, 1e-7]))
    conic = reference.project(gaussians, camera).conics[0]
    half, det = 0.5e14, 0.3 * (1e14 + 0.3) + 1.0
    np.testing.assert_allclose(conic, np.array([[half, -half], [-half, half]]) / det, rtol=1e-13)
    opacity = reference.project(gaussians, camera, antialiased=True).opacities[0]
    assert opacity == pytest.approx(1 / (1 + math.exp(-3)) * math.sqrt(1 / det), rel=1e-9)


def test_lone_splat_smaller_than_a_pixel_keeps_its_energy_when_antialiased():
    """Compensated, a splat's integral o 2 pi sqrt(det cov2d) is that without the low-pass."""
    gaussians, camera = needle(np.log([0.02, 0.03, 1e-3]))
    splats = reference.project(gaussians, camera, antialiased=True)
    energy = splats.opacities[0] * math.sqrt(np.linalg.det(splats.cov2d[0]))
    assert energy == pytest.approx(1 / (1 + math.exp(-3)) * 0.02 * 0.03, rel=1e-12)


# ----------------------------------------------------------------------------------------------
# Degenerate input
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("antialiased", [False, True])
def test_culled_and_degenerate_gaussians_raise_no_warning_and_change_nothing(antialiased):
    """At and behind the camera's centre, on its plane, flat, huge, tiny and transparent ones."""
    gaussians, camera = small_scene()
    strange_points = np.array(
        [[0, 0, 0], [0, 0, -1], [1e3, 0, 0], [0, 1e30, -1e30], [0, 0, 0.0099], [0.1, 0, 2]]
    )
    m = len(strange_points)
    log_scales = np.tile(np.log([0.1, 0.1, 0.1]), (m, 1))
    log_scales[1] = 80.0
    log_scales[2] = -np.inf
    logit_opacities = np.full(m, 1e3)
    logit_opacities[5] = -1e3
    strange = {
        "means": strange_points @ camera.rotation + camera.center,
        "quats": np.zeros((m, 4)),
        "log_scales": log_scales,
        "logit_opacities": logit_opacities,
        "sh0": np.ones((m, 1, 3)),
        "shN": np.ones((m, 15, 3)),
    }
    both = Gaussians(
        **{name: np.concatenate([getattr(gaussians, name), strange[name]]) for name in PARAMETERS}
    )
    with warnings.catch_warnings(), np.errstate(divide="raise", over="raise", invalid="raise"):
        warnings.simplefilter("error")
        rendered = reference.render(both, camera, BACKGROUND, antialiased=antialiased)
        gradients = reference.render_gradients(
            both, camera, BACKGROUND, **cotangents(), antialiased=antialiased
        )
    alone = reference.render(gaussians, camera, BACKGROUND, antialiased=antialiased)
    np.testing.assert_array_equal(rendered.image, alone.image)
    alone = reference.render_gradients(
        gaussians, camera, BACKGROUND, **cotangents(), antialiased=antialiased
    )
    for name in (*PARAMETERS, "means2d"):
        # Batched matrix products may round differently in batches of another size.
        np.testing.assert_allclose(gradients[name][:12], alone[name], rtol=1e-12, atol=1e-12)
        assert not gradients[name][12:].any(), name


def test_image_without_gaussians_is_background():
    camera = small_camera()
    empty = Gaussians(
        np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 1, 3)),
        np.zeros((0, 15, 3)),
    )  # fmt: skip
    rendered = reference.render(empty, camera, BACKGROUND)
    np.testing.assert_array_equal(rendered.image, np.broadcast_to(BACKGROUND, (20, 24, 3)))
    gradients = reference.render_gradients(empty, camera, BACKGROUND, **cotangents())
    assert gradients["shN"].shape == (0, 15, 3)
    np.testing.assert_allclose(
        gradients["background"], cotangents()["d_image"].sum(axis=(0, 1)), rtol=1e-12
    )


def test_wrong_shapes_and_degrees_are_refused_by_name():
    gaussians, camera = small_scene()
    with pytest.raises(ValueError, match="quats must have shape"):
        Gaussians(**{**vars(gaussians), "quats": gaussians.quats[:5]})
    with pytest.raises(ValueError, match="shN must have shape"):
        Gaussians(**{**vars(gaussians), "shN": gaussians.shN[:, :7]})
    with pytest.raises(ValueError, match="center must have shape"):
        Camera(**{**vars(camera), "center": np.zeros(4)})
    with pytest.raises(ValueError, match="near must be > 0"):
        Camera(**{**vars(camera), "near": 0.0})
    with pytest.raises(ValueError, match="degree must be 0 to 3, got 4"):
        reference.render(gaussians, camera, sh_degree=4)
