"""Lenses with each approximation, against samples, layers and differences."""

from dataclasses import replace

import numpy as np
import pytest
from support import lenses
from support.cases import reference_camera, with_lens
from support.helpers import FLOAT64, device_gaussians, rows
from support.lens_scenes import (
    FOCAL,
    FORMS,
    IMAGE,
    LENSES,
    camera_behind,
    covariances,
    every_lens,
    gaussians_at_points,
    lens_camera,
    planes_of,
    points_at,
    splats_of,
)
from support.lenses import Orthographic
from support.reference_lenses import gaussians_at, whitened_samples

from drgs.accuracy.pipeline import pipeline_of
from drgs.accuracy.unscented import unscented_shape
from drgs.config.approximations import Approximations
from drgs.reference import splatting as reference
from drgs.splatting import rendering


def unscented_scene(name, size) -> tuple[reference.Gaussians, reference.Camera]:
    """20 Gaussians on the film of up to ``size`` of their distance; none nearer than 0.5."""
    lens, camera = LENSES[name], camera_behind(LENSES[name], seed=1)
    rng = np.random.default_rng(2)
    film = rng.uniform(0.2, 0.8, (20, 2)) * [camera.width, camera.height]
    points = points_at(lens, camera, film, rng.uniform(1, 3, 20))
    distances = np.linalg.norm(points, axis=1)[:, None]
    gaussians = gaussians_at(
        points @ camera.rotation + camera.center, size * distances * rng.uniform(0.3, 1, (20, 3))
    )
    return replace(gaussians, quats=rng.normal(0, 1, (20, 4))), camera


@every_lens
def test_unscented_splats_have_the_mean_and_covariance_of_projected_samples(name):
    gaussians, camera = unscented_scene(name, size=0.03)
    lens = LENSES[name]
    turns = reference.quat_to_rotation(gaussians.quats)
    samples = whitened_samples(4000)
    samples = np.concatenate([samples, -samples])
    means, covs = [], []
    for mean, turn, log_scale in zip(gaussians.means, turns, gaussians.log_scales, strict=True):
        world = mean + samples * np.exp(log_scale) @ turn.T
        film = lens.film_points(camera, (world - camera.center) @ camera.rotation.T)
        means.append(film.mean(axis=0))
        covs.append(np.cov(film.T, bias=True))
    splats = splats_of(gaussians, camera, lens, FLOAT64, unscented_shape, low_pass=0.0)
    assert np.array(splats.visible).all()
    variances = np.trace(covs, axis1=1, axis2=2)
    mean_errors = np.abs(rows(splats.means2d) - means).max(axis=1) / np.sqrt(variances)
    # Third powers of the size times fourth derivatives of the lens, of some 10. Measured: 3.4e-5;
    # the affine approximation's are 0.01 to 0.02.
    assert mean_errors.max() < 6e-5
    # Squares of the size times these. Measured: 0.0019; the affine approximation's are 0.0029.
    errors = np.abs(covariances(splats) - covs).max(axis=(1, 2)) / variances
    assert errors.max() < 0.004


def direction_of_pixels(lens, camera) -> np.ndarray:
    """(H W, 3), unit, world: of the rays of pixel centres, by the reference; NaN: nothing."""
    y, x = np.mgrid[: camera.height, : camera.width].reshape(2, -1) + 0.5
    points = points_at(lens, camera, np.column_stack([x, y]), np.ones(x.size))
    if isinstance(lens, Orthographic):
        points = np.tile([0, 0, 1.0], (x.size, 1))
    world = points @ camera.rotation
    return world / np.linalg.norm(world, axis=1, keepdims=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMS)
def test_colours_use_the_directions_of_pixel_rays(name):
    """One reference image for each pixel, of that pixel."""
    lens, options = LENSES[name], {"approximations": {"sh_direction": "pixel"}, "count": 20}
    focal = FOCAL.get(type(lens), 26.0) * 12 / 37
    case = with_lens(name, width=12, height=9, focal=focal, **options)
    gaussians, camera = reference.Gaussians(**case.values), reference_camera(case)
    color = case.planes(case.values)[1:4].T
    splats = lenses.project(gaussians, camera, lens)
    expected = np.zeros((case.height * case.width, 3))
    directions_of = direction_of_pixels(lens, camera)
    coefficients = np.concatenate([gaussians.sh0, gaussians.shN], axis=1)
    for pixel, direction in enumerate(directions_of):
        colors = 0.5 + reference.sh_basis(direction[None], 1)[0] @ coefficients
        offset = np.array([pixel % case.width, pixel // case.width])
        moved = replace(splats, means2d=splats.means2d - offset)
        image = reference.composite(moved, np.maximum(colors, 0), (0, 0, 0), 1, 1).image
        expected[pixel] = image[0, 0]
    shown = ~np.isnan(directions_of).any(axis=1)
    assert shown.mean() > 0.7 and np.isfinite(color).all()
    tolerance = IMAGE[FLOAT64] * np.abs(expected[shown]).max()
    np.testing.assert_allclose(color[shown], expected[shown], rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    "name", [name for name, lens in LENSES.items() if not isinstance(lens, Orthographic)]
)
def test_pixel_order_equals_center_order_for_separate_layers(name):
    """Flat splats in layers far apart, so that no pixel's order is another one."""
    lens, camera, rng = LENSES[name], camera_behind(LENSES[name]), np.random.default_rng(1)
    film = rng.uniform(0.2, 0.8, (12, 2)) * [camera.width, camera.height]
    points = points_at(lens, camera, film, np.linspace(1, 8, 12))
    points = points[~np.isnan(points).any(axis=1)]
    sizes, logits = np.full((len(points), 3), 0.9), np.full(len(points), 0.5)
    gaussians = gaussians_at_points(lens, rng, camera, points, sizes, logits, degree=1)
    gaussians = replace(gaussians, log_scales=gaussians.log_scales - 0.5)
    device = device_gaussians(gaussians, FLOAT64)
    device_camera = lens_camera(camera, lens, FLOAT64)
    plain, ordered = (
        planes_of(rendering.render(device, device_camera, pipeline_of(approximations, 1)))
        for approximations in (Approximations(), Approximations(order="pixel", order_window=2))
    )
    assert plain[0].min() < 0.5 and len(points) > 8
    np.testing.assert_allclose(ordered, plain, rtol=0, atol=1e-13)


def composited_along_parallel_rays(gaussians, camera, low_pass=0.3) -> tuple[np.ndarray, int]:
    """(4, H W): transmittance and colour; each pixel's splats by the depths of their peaks. And how
    many of these would show, but are behind the camera.

    The density of a Gaussian along a line is that of another one, whose mean the precision has.
    """
    focal = np.array([camera.fx, camera.fy])
    axes = camera.rotation @ reference.quat_to_rotation(gaussians.quats)
    axes = axes * np.exp(gaussians.log_scales)[:, None, :]
    widened = axes @ np.swapaxes(axes, 1, 2) + low_pass * np.diag([*focal**-2.0, 0])
    precision = np.linalg.inv(widened)
    means = (gaussians.means - camera.center) @ camera.rotation.T
    colors = np.maximum(gaussians.sh0[:, 0] * reference.C_00 + 0.5, 0)
    planes, behind = [], 0
    for y, x in np.ndindex(camera.height, camera.width):
        point = (np.array([x, y]) + 0.5 - [camera.cx, camera.cy]) / focal
        beside = point - means[:, :2]
        along = -np.einsum("nk,nk->n", precision[:, 2, :2], beside) / precision[:, 2, 2]
        offsets = np.column_stack([beside, along])
        distances = np.einsum("ni,nij,nj->n", offsets, precision, offsets)
        alphas = np.minimum(
            reference.sigmoid(gaussians.logit_opacities) * np.exp(-distances / 2),
            reference.ALPHA_MAX,
        )
        depths = means[:, 2] + along
        shown = (alphas >= reference.ALPHA_CUT) & (depths > 0)
        behind += np.sum((alphas >= reference.ALPHA_CUT) & (depths <= 0))
        T, color = 1.0, np.zeros(3)
        for n in np.flatnonzero(shown)[np.argsort(depths[shown])]:
            color, T = color + T * alphas[n] * colors[n], T * (1 - alphas[n])
        planes.append([T, *color])
    return np.transpose(planes), behind


@pytest.mark.parametrize("projection", ["ewa", "unscented"])
def test_pixel_order_along_parallel_rays_matches_the_reference(projection):
    """Needles and discs in all directions that cross: some peaks are behind the camera."""
    lens, rng = LENSES["orthographic"], np.random.default_rng(0)
    camera = camera_behind(lens, width=19, height=14)
    film = rng.uniform(0.3, 0.7, (12, 2)) * [camera.width, camera.height]
    points = points_at(lens, camera, film, rng.uniform(0.3, 0.6, 12))
    sizes, logits = rng.uniform(0.3, 4.0, (12, 3)), rng.uniform(-1.5, 0.5, 12)
    gaussians = gaussians_at_points(lens, rng, camera, points, sizes, logits, degree=0)
    device, device_camera = device_gaussians(gaussians, FLOAT64), lens_camera(camera, lens, FLOAT64)
    window = Approximations(projection=projection, order="pixel", order_window=12)
    ordered, plain = (
        planes_of(rendering.render(device, device_camera, pipeline_of(approximations, 0)))
        for approximations in (window, Approximations(projection=projection))
    )
    expected, behind = composited_along_parallel_rays(gaussians, camera)
    assert behind > 20
    # A dozen products and sums in double precision.
    np.testing.assert_allclose(ordered, expected, rtol=0, atol=1e-12)
    assert np.abs(plain - expected).max() > 0.05
