"""Projections of the float64 reference against densities along rays and textbook formulas."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from support.reference_loops import (
    UNCUT,
    camera_gaussian,
    is_usable,
    only,
    pixel_rays,
    rotated_splats,
    scene_of,
    straight_camera,
    textbook_unscented,
)
from support.reference_scenes import (
    BACKGROUND,
    rotation_about,
    small_scene,
)

from drgs.reference import rays
from drgs.reference.rays import ImageModel
from drgs.reference.splatting import Camera


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
def test_exact_falloff_is_the_largest_density_along_the_ray(low_pass):
    """Dense search of the 3D density on the ray's positive half, then refinement."""
    gaussians, camera = rotated_splats(), straight_camera()
    model = replace(UNCUT, projection="exact", order="pixel", low_pass=low_pass)
    directions = pixel_rays(camera)
    visible = 0
    for n in range(len(gaussians.means)):
        rendered = rays.render(only(gaussians, [n]), camera, model=model)
        mean, factor = camera_gaussian(gaussians, camera, n)
        widening = low_pass * mean[2] ** 2 / camera.fx**2 * np.diag([1, 1, 0])
        precision = np.linalg.inv(factor @ factor.T + widening)
        for row, column in [(0, 0), (2, 7), (4, 4), (7, 3)]:
            ray = directions[row, column]

            def rho_sq(t, ray=ray, mean=mean, precision=precision):
                return (t * ray - mean) @ precision @ (t * ray - mean)

            grid = mean[2] * np.geomspace(1e-3, 1e3, 400)
            best = int(np.argmin([rho_sq(t) for t in grid]))
            if best in (0, len(grid) - 1):
                continue
            # Any tolerance: a minimum is found to the square root of rounding.
            found = minimize_scalar(
                rho_sq, bounds=(grid[best - 1], grid[best + 1]), options={"xatol": 1e-12}
            )
            response = rendered.alpha[row, column] / 0.5
            # rho^2, of at most 1e4 here where the response is not zero, to 1e-16 times its
            # condition of 1e3; alpha is 1 - T, rounded at the size of 1.
            np.testing.assert_allclose(response, math.exp(-found.fun / 2), rtol=0, atol=1e-11)
            if response > 1e-3:
                visible += 1
                peak = rendered.depth[row, column] / rendered.alpha[row, column]
                # The minimiser is known to sqrt(1e-16) deviations along the ray, which are at
                # most a few times the depth; the depth carries 1e-16 / 1e-3 beside it.
                np.testing.assert_allclose(peak, found.x, rtol=1e-6)
    assert visible >= 10


def test_exact_flat_disc_is_evaluated_at_the_plane_intersection():
    """Thickness zero, and in-plane deviations of 0.2 and 0.1, seen at up to 60 degrees."""
    camera = straight_camera()
    for tilt in (0.0, 0.5, 1.0):
        turn = rotation_about([1, 0.4, 0], tilt)
        half = tilt / 2
        axis = np.array([1, 0.4, 0]) / np.linalg.norm([1, 0.4, 0])
        gaussians = scene_of(
            [[0.02, -0.03, 1]],
            [np.log(0.2), np.log(0.1), -np.inf],
            quats=[[math.cos(half), *(math.sin(half) * axis)]],
        )
        mean, normal = gaussians.means[0], turn[:, 2]
        directions = pixel_rays(camera)
        t = normal @ mean / (directions @ normal)
        in_plane = (t[..., None] * directions - mean) @ turn[:, :2] / [0.2, 0.1]
        response = np.exp(-np.sum(in_plane**2, axis=-1) / 2)
        model = replace(UNCUT, projection="exact", order="pixel", low_pass=0.0)
        with warnings.catch_warnings(), np.errstate(divide="raise", over="raise", invalid="raise"):
            warnings.simplefilter("error")
            rendered = rays.render(gaussians, camera, model=model)
        # alpha is 1 - T, rounded at the size of 1; the rest is rounding of numbers of that size.
        np.testing.assert_allclose(rendered.alpha, 0.5 * response, rtol=0, atol=1e-14)
        np.testing.assert_allclose(rendered.depth, 0.5 * response * t, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("slope", "sizes", "order"),
    [
        ((0.0, 0.0), (1.0, 1.0, 1.0), 2),
        ((0.5, -0.3), (1.0, 1.0, 1.0), 1),
        ((0.0, 0.0), (1.0, 0.5, 0.25), 1),
    ],
    ids=["round on axis", "round off axis", "tilted"],
)
def test_exact_tends_to_ewa_as_splats_shrink(slope, sizes, order):
    """rho^2 = rho_ewa^2 / D with D = 1 - 2 kappa . e + O(angle^2), and kappa = O(angle).

    kappa, the covariance of depth with the place on the film, vanishes for a round splat on the
    axis. The image stays 2 px wide while the splat's angle shrinks: a long lens.
    """

    def error(angle):
        focal, size = 2.0 / angle, 15
        center = size / 2
        camera = Camera(
            np.eye(3), np.zeros(3), focal, focal,
            center - focal * slope[0], center - focal * slope[1], size, size,
        )  # fmt: skip
        gaussians = scene_of(
            [[*slope, 1.0]], np.log(angle * np.array(sizes)), quats=[[0.9, 0.3, 0.5, 0.2]]
        )
        model = replace(UNCUT, low_pass=0.0)
        exact, ewa = (
            rays.render(gaussians, camera, model=replace(model, projection=name)).alpha
            for name in ("exact", "ewa")
        )
        return np.abs(exact - ewa).max()

    ratio = error(2e-3) / error(1e-3)
    # The next order adds about the angle times rho^2, some 1e-3 times 10.
    assert ratio == pytest.approx(2**order, rel=0.02)
    assert error(1e-3) < 1e-3


def test_sigma_points_are_the_scaled_unscented_transform():
    """Or, where a point is near the camera or the slope is clamped, the affine approximation."""
    gaussians, camera = small_scene()
    gaussians.log_scales[:3, 2] += 2.0
    splats = rays._splats(gaussians, camera, ImageModel("unscented", alpha_cut=0.0))
    affine = rays._splats(gaussians, camera, ImageModel("ewa", alpha_cut=0.0))
    focal, principal = [camera.fx, camera.fy], [camera.cx, camera.cy]
    kinds = []
    for i, n in enumerate(n for n in range(12) if n != 10):
        mean, factor = camera_gaussian(gaussians, camera, n)

        def pinhole(point):
            return focal * point[:2] / point[2] + principal

        kinds.append("near" if not is_usable(mean, factor) else "clamped" if n == 9 else "usable")
        if kinds[-1] == "usable":
            center, covariance = textbook_unscented(mean, factor, pinhole, alpha=1, beta=2, kappa=0)
            covariance = covariance + 0.3 * np.eye(2)
        else:
            center, covariance = affine.means2d[i], affine.cov2d[i]
        np.testing.assert_allclose(splats.means2d[i], center, rtol=1e-12)
        # Rounding of sums of squares of up to 1e2 px.
        np.testing.assert_allclose(splats.cov2d[i], covariance, rtol=1e-11, atol=1e-11)
    assert set(kinds) == {"near", "clamped", "usable"}


def test_textbook_transform_is_exact_for_affine_functions():
    """Whatever alpha, beta and kappa: what the test above compares with is a transform."""
    rng = np.random.default_rng(2)
    mean, factor, matrix = rng.normal(0, 1, 3), rng.normal(0, 1, (3, 3)), rng.normal(0, 1, (2, 3))
    for alpha, beta, kappa in [(1, 2, 0), (0.1, 2, 0), (0.5, 0, 1)]:
        center, covariance = textbook_unscented(
            mean, factor, lambda x: matrix @ x + [3, 4], alpha, beta, kappa
        )
        # The weights are up to 1 / alpha^2 and cancel.
        np.testing.assert_allclose(center, matrix @ mean + [3, 4], rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            covariance, matrix @ factor @ factor.T @ matrix.T, rtol=0, atol=1e-12
        )


def test_unscented_transform_tends_to_ewa_far_away():
    """The pinhole's second derivatives act on the mean, and twice or with the third on C."""
    gaussians, camera = rotated_splats(), straight_camera()

    def errors(factor):
        """Return errors of the mean in deviations, and of C relative to it, worst over the
        splats."""
        far = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
        small = replace(gaussians, log_scales=gaussians.log_scales - np.log(factor))
        # A film on which no slope is clamped; no wider, or differences of places would be rounded.
        wide = replace(far, width=10**5, height=10**5, cx=far.cx + 5e4, cy=far.cy + 5e4)
        ours = rays._splats(small, wide, ImageModel("unscented", low_pass=0.0, alpha_cut=0.0))
        ewa = rays._splats(small, wide, ImageModel("ewa", low_pass=0.0, alpha_cut=0.0))
        moved = ours.means2d - ewa.means2d
        deviations = np.sqrt(np.trace(ewa.cov2d, axis1=1, axis2=2))
        mean_error = np.linalg.norm(moved, axis=1) / deviations
        cov_error = np.linalg.norm(ours.cov2d - ewa.cov2d, axis=(1, 2)) / deviations**2
        return mean_error.max(), cov_error.max()

    coarse, fine = errors(100.0), errors(200.0)
    # The next even order is smaller by the square of the angle, which is at most 1 / 100.
    assert coarse[0] / fine[0] == pytest.approx(2, rel=1e-2)
    assert coarse[1] / fine[1] == pytest.approx(4, rel=1e-2)
    assert fine[0] < 0.01 and fine[1] < 1e-3


def test_boxes_contain_every_pixel_a_splat_reaches(monkeypatch):
    """Splats of all shapes, close to the camera and across it; jittered positions."""
    rng = np.random.default_rng(1)
    camera = straight_camera(size=24, focal=15.0)
    gaussians = scene_of(
        rng.uniform([-1, -1, 0.02], [1, 1, 2.0], (300, 3)),
        rng.normal(np.log(0.05), 1.0, (300, 3)),
        quats=rng.normal(0, 1, (300, 4)),
        opacity=rng.uniform(0.005, 0.6, 300),
        colors=rng.uniform(0, 1, (300, 3)),
    )
    x, y = np.meshgrid(np.arange(24) + 0.5, np.arange(24) + 0.5)
    positions = np.stack([x, y], axis=-1) + rng.uniform(-0.5, 0.5, (24, 24, 2))
    for projection in ("ewa", "unscented", "exact"):
        for extent in (math.inf, 2.0):
            model = ImageModel(projection, extent=extent, transmittance_stop=0.0)
            args = (gaussians, camera, BACKGROUND, model, None, positions)
            boxed = rays.render(*args)
            with monkeypatch.context() as everywhere:
                everywhere.setattr(
                    rays,
                    "_film_bounds",
                    lambda splats, *_: (
                        np.full(splats.means2d.shape, -np.inf),
                        np.full(splats.means2d.shape, np.inf),
                    ),
                )
                unboxed = rays.render(*args)
            for name in ("image", "transmittance", "near_threshold"):
                np.testing.assert_array_equal(getattr(boxed, name), getattr(unboxed, name))
