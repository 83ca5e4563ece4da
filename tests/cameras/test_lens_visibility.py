"""The region that a lens sees, rays within it, and images of hard scenes."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support import lenses
from support.cases import edges_behind, large_behind, reference_camera, with_lens
from support.helpers import FLOAT32, FLOAT64, both_precisions, rows, single
from support.lens_scenes import (
    IMAGE,
    LENSES,
    camera_behind,
    covariances,
    every_lens,
    kernel_lens,
    lens_camera,
    points_at,
    splats_of,
)
from support.lenses import Fisheye, OpenCV, ThinPrismFisheye
from support.reference_lenses import camera_at_origin, gaussians_at

from drgs.cameras import distortion, fisheye
from drgs.cameras.fisheye import Fisheye as CameraFisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye as CameraThinPrismFisheye
from drgs.reference import splatting as reference

# ----------------------------------------------------------------------------------------------
# Visibility
# ----------------------------------------------------------------------------------------------


# Positions up to thousands of px, and covariances: J by differences, 1e-13; and float32.
SPLATS = {FLOAT64: 1e-11, FLOAT32: 1e-5}


@both_precisions
@pytest.mark.parametrize("name", ["plain fisheye", "fisheye", "thin prism"])
def test_fisheye_sees_from_the_axis_to_behind_the_camera(precision, name):
    """On the axis, at angles from 1e-12 up, where the series end (17.5 degrees), beside, behind."""
    lens, camera = LENSES[name], camera_at_origin()
    at = np.arctan(np.sqrt(fisheye.NEAR_AXIS)) + np.array([-1e-3, -1e-6, 1e-6, 1e-3])
    angles = np.concatenate(
        [[0], 10.0 ** np.arange(-12, 0), at, np.linspace(0.05, 0.99, 30) * lens.valid_angle]
    )
    azimuths = np.linspace(0, 6, len(angles))
    sines = np.sin(angles)
    points = np.stack([sines * np.cos(azimuths), sines * np.sin(azimuths), np.cos(angles)], -1)
    distances = np.random.default_rng(0).uniform(0.5, 3, len(angles))
    points = single(points * distances[:, None])
    assert (points[:, 2] < -0.5).sum() >= 3 or lens.valid_angle < 2
    quats = np.random.default_rng(1).normal(size=(len(points), 4))
    gaussians = replace(gaussians_at(points, [[0.1, 0.2, 0.05]]), quats=single(quats))
    gaussians = replace(gaussians, log_scales=single(gaussians.log_scales))
    expected = lenses.project(gaussians, camera, lens)
    splats = splats_of(gaussians, camera, lens, precision)
    assert np.array(splats.visible).all() and expected.visible.all()
    tolerance = SPLATS[precision]
    np.testing.assert_allclose(rows(splats.means2d), expected.means2d, atol=tolerance * 1000)
    np.testing.assert_allclose(rows(splats.depths), expected.depths, rtol=tolerance)
    size = np.abs(expected.cov2d).max(axis=(1, 2), keepdims=True)
    errors = np.abs(covariances(splats) - expected.cov2d) / size
    assert errors.max() < tolerance, np.argmax(errors.max(axis=(1, 2)))


@pytest.mark.parametrize("lens", [RadialTangential, CameraFisheye, CameraThinPrismFisheye])
@pytest.mark.parametrize("tiny", [5e-324, 1e-31])
def test_negligible_coefficients_are_zero(lens, tiny):
    assert lens.from_coefficients(
        **dict.fromkeys(lens.coefficient_names(), tiny)
    ) == lens.from_coefficients(**dict.fromkeys(lens.coefficient_names(), 0.0))


def folded_points(lens) -> np.ndarray:
    """Points in front of the lens that it would fold back to the middle of the image.

    In the direction (3, -4), in which the tangential terms of "tangential" fold first.
    """
    if isinstance(lens, Fisheye):
        angles = np.linspace(1.001, 1.3, 20) * lens.valid_angle
        return 2 * np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    radii = np.linspace(1.001, 1.6, 20) * lens.valid_radius
    return 2 * np.column_stack([0.6 * radii, -0.8 * radii, np.ones(20)])


FOLDING = {
    "barrel": OpenCV(k1=-0.3125),
    "tangential": OpenCV(p1=0.25, p2=-0.1875),
    "barrel, tangential": OpenCV(k1=-0.3125, p1=0.0078125, p2=-0.015625),
    "rational": OpenCV(k4=0.25),
    "pole": OpenCV(k4=-0.25),
    "fox": LENSES["fox"],
    "fisheye": Fisheye(-0.125),
    "thin prism": ThinPrismFisheye(p2=-0.125, sx1=-0.0625),
}


@both_precisions
@pytest.mark.parametrize("lens", FOLDING.values(), ids=FOLDING)
def test_points_beyond_the_lens_model_do_not_fold_back(precision, lens):
    camera = camera_at_origin(fx=60.0, fy=60.0)
    points = folded_points(lens)
    film = lens.film_points(camera, points)
    inside = ((film > 0) & (film < [camera.width, camera.height])).all(axis=1)
    assert inside.sum() >= 3
    splats = splats_of(gaussians_at(points), camera, lens, precision)
    assert not np.array(splats.visible).any()
    for name in ("means2d", "conic_factor", "depths", "variances"):
        assert np.isfinite(rows(getattr(splats, name))).all()
    # Points within the limit are visible, up to single precision.
    limit = 1 - 1e-5
    within = limit * points[0] * [1 / 1.001, 1 / 1.001, 1 / limit]
    if isinstance(lens, Fisheye):
        angle = limit * lens.valid_angle
        within = np.array([np.sin(angle), 0, np.cos(angle)])
    splats = splats_of(gaussians_at(within), camera, lens, precision)
    assert np.array(splats.visible).all()


@both_precisions
@every_lens
def test_mean_on_the_near_plane_is_visible_and_one_before_it_is_not(precision, name):
    camera = camera_at_origin(near=0.5)
    depths = np.array([0.5, 0.5 * (1 - 1e-6), 0.0, -0.5])
    points = np.column_stack([np.zeros((4, 2)), depths])
    splats = splats_of(gaussians_at(points), camera, LENSES[name], precision)
    # Only a panorama shows what is behind.
    expected = [True, False, False, name == "panorama"]
    np.testing.assert_array_equal(np.array(splats.visible), expected)


def with_border_at(part) -> tuple[lenses.Lens, reference.Camera]:
    """Half a side is a part of the largest distorted radius; the corners are sqrt(2) as far."""
    lens = OpenCV(k1=-0.3125)
    half = part * (2 / 3) * lens.valid_radius
    return lens, camera_at_origin(
        fx=100 / half, fy=100 / half, cx=100, cy=100, width=200, height=200
    )


BORDERS = {
    **{
        name: (lens, camera_behind(lens))
        for name, lens in LENSES.items()
        if isinstance(lens, OpenCV)
    },
    **{f"border at {part}": with_border_at(part) for part in (0.3, 0.69, 0.7, 0.71, 0.81, 1.5)},
}


@both_precisions
@pytest.mark.parametrize("name", BORDERS)
def test_slope_bounds_match_the_reference(precision, name):
    """A lens that does not cover the whole border has none."""
    lens, camera = BORDERS[name]
    expected = lens.slope_bounds(camera)
    if name.startswith("border"):
        assert (expected is None) == (float(name.split()[-1]) > np.sqrt(0.5))
    if expected is None:
        expected = [[-distortion.UNBOUNDED_SLOPE] * 2, [distortion.UNBOUNDED_SLOPE] * 2]
    actual = lens_camera(camera, lens, precision).lens.on_film
    # Near the fold the inverse is steep: a rounding of the radius, over sqrt(1 - part^2).
    tolerance = {FLOAT64: 1e-9, FLOAT32: 1e-4}[precision]
    np.testing.assert_allclose([rows(b)[0] for b in actual], expected, rtol=tolerance)


def test_crop_window_has_the_slope_bounds_of_the_whole_film():
    lens, camera = LENSES["rational"], camera_at_origin()
    whole = lens_camera(camera, lens, FLOAT64)
    shift = FLOAT64.Array2f(37.0, 21.0)
    window = replace(
        whole,
        principal=whole.principal - shift,
        film_start=whole.film_start - shift,
        film_end=whole.film_end - shift,
        width=50,
        height=40,
    ).with_lens(kernel_lens(lens))
    for a, b in zip(window.lens.on_film, whole.lens.on_film, strict=True):
        np.testing.assert_allclose(rows(a), rows(b), rtol=1e-13)


# ----------------------------------------------------------------------------------------------
# Rays
# ----------------------------------------------------------------------------------------------


def rays_of(camera, lens, film, precision) -> np.ndarray:
    """Directions (N, 3), camera axes, unit, of points of the film (N, 2), px."""
    x, y = (precision.array(column) for column in np.asarray(film).T)
    device = lens_camera(camera, lens, precision)
    rays = rows(device.lens.ray(device, x, y))
    rays = np.broadcast_to(rays, (len(film), 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize(
    ("kind", "sizes"),
    [
        (OpenCV, [0.3, 0.1, 0.03, 0.3, 0.1, 0.03, 0.01, 0.01]),
        (Fisheye, [0.1, 0.05, 0.02, 0.01]),
        (ThinPrismFisheye, [0.1, 0.05, 0.02, 0.01, 0.01, 0.01, 0.01, 0.01]),
    ],
)
def test_rays_of_extreme_lenses_are_found_and_finite(precision, kind, sizes):
    """Coefficients as large as they come, films far beyond what some of the lenses show.

    An unguarded Newton's method from the place on the film misses some and ends in NaN.
    """
    shown = 0
    for seed in range(15):
        rng = np.random.default_rng(seed)
        lens = kind(*map(float, single(rng.normal(0, sizes))))
        focal = rng.choice([8.0, 15.0, 30.0])
        camera = camera_at_origin(fx=focal, fy=focal, cx=18.5, cy=14.5, width=37, height=29)
        film = single(rng.uniform(0, 1, (200, 2)) * [37, 29])
        rays = rays_of(camera, lens, film, precision)
        assert np.isfinite(rays).all()
        points = points_at(lens, camera, film, np.ones(200))
        found = ~np.isnan(points).any(axis=1)
        # Not those next to a fold, where a small step on the film is a large one outside.
        nearby = [points_at(lens, camera, film + step, np.ones(200)) for step in np.eye(2) / 100]
        found &= np.all([np.linalg.norm(p - points, axis=1) < 0.1 for p in nearby], axis=0)
        expected = points[found] / np.linalg.norm(points[found], axis=1, keepdims=True)
        tolerance = {FLOAT64: 1e-9, FLOAT32: 2e-5}[precision]
        np.testing.assert_allclose(rays[found], expected, rtol=0, atol=tolerance, err_msg=str(lens))
        shown += found.sum()
    assert shown > 1500


# ----------------------------------------------------------------------------------------------
# Images
# ----------------------------------------------------------------------------------------------


@both_precisions
@every_lens
@pytest.mark.parametrize(("scene", "count"), [(edges_behind, 60), (large_behind, 30)])
def test_image_equals_the_reference(precision, name, scene, count):
    """The reference evaluates every splat at every pixel."""
    lens = LENSES[name]
    case = with_lens(name, scene=partial(scene, lens), count=count)
    expected, marked = case.reference_image
    found = case.planes(case.values, precision.Float)
    for plane, values in zip(found, expected, strict=True):
        tolerance = IMAGE[precision] * np.abs(values).max()
        np.testing.assert_allclose(plane[~marked], values[~marked], rtol=0, atol=tolerance)
    splats = lenses.project(reference.Gaussians(**case.values), reference_camera(case), lens)
    x, y = splats.means2d[splats.visible].T
    beside = (x < 0) | (y < 0) | (x > case.width) | (y > case.height)
    assert (beside.sum() >= 5 or name == "panorama") and (expected[0] < 0.5).mean() > 0.2
    assert marked.mean() < 0.01
