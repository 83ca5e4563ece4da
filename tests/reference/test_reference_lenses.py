"""Lenses of the float64 reference: where points lie, how large splats are."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.optimize import brentq
from support.reference_lenses import (
    FISHEYE,
    THIN_PRISM,
    camera_at_origin,
    gaussians_at,
    whitened_samples,
)
from support.reference_scenes import (
    small_camera,
    small_scene,
)

from drgs.reference import effects
from drgs.reference import splatting as reference
from drgs.reference.effects import Fisheye, OpenCV, Orthographic, Pinhole, ThinPrismFisheye

# Coefficients of sizes that cameras have, exact in binary.
BARREL = OpenCV(k1=-0.25, k2=0.0625, p1=0.0078125, p2=-0.015625, k3=0.03125)


RATIONAL = replace(BARREL, k4=0.125, k5=-0.0625, k6=0.015625)


PINCUSHION = OpenCV(k1=0.125, k2=0.03125)


LENSES = [Pinhole(), BARREL, RATIONAL, PINCUSHION, Fisheye(), FISHEYE, THIN_PRISM, Orthographic()]


every_lens = pytest.mark.parametrize("lens", LENSES, ids=str)


def points_within(lens, camera, count=200, seed=3) -> np.ndarray:
    """(count, 3) random points in camera axes that the lens sees, at distances 0.5 to 4."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(0, 2.7 if isinstance(lens, Fisheye) else 0.75, count)
    azimuths, distances = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.5, 4, count)
    sines = np.sin(angles)
    directions = [sines * np.cos(azimuths), sines * np.sin(azimuths), np.cos(angles)]
    points = distances[:, None] * np.stack(directions, axis=-1)
    assert lens.is_seen(camera, points).all()
    return points


# cv2.projectPoints and cv2.fisheye.projectPoints of opencv-python 5.0.0 and Camera.img_from_cam of
# pycolmap 4.2.1, of the points (0, 0, 1), (0.5, -0.25, 2), (-1.5, 1, 2), (0.75, 1.5, 1.25), with
# RATIONAL, FISHEYE and THIN_PRISM.
KNOWN_POINTS = np.array([[0, 0, 1], [0.5, -0.25, 2], [-1.5, 1, 2], [0.75, 1.5, 1.25]])


KNOWN_FILM = {
    RATIONAL: [
        [140.0, 95.0],
        [195.03270342494275, 72.26910075926278],
        [-6.302419057302984, 175.17032849804366],
        [249.3651258558761, 289.04958293579534],
    ],
    FISHEYE: [
        [140.0, 95.0],
        [195.9436003856843, 71.89286071026083],
        [1.4869510124012777, 171.282548717808],
        [233.83945348652193, 250.03909706468843],
    ],
    THIN_PRISM: [
        [140.0, 95.0],
        [195.39632835083586, 72.25674147998508],
        [-2.4925152592528548, 174.13980873487944],
        [230.88489054148343, 254.79208962844606],
    ],
}


@pytest.mark.parametrize("lens", KNOWN_FILM, ids=str)
def test_film_points_match_opencv_and_colmap(lens):
    actual = lens.film_points(camera_at_origin(), KNOWN_POINTS)
    np.testing.assert_allclose(actual, KNOWN_FILM[lens], rtol=1e-13)


def radial(lens, r) -> float:
    """R -> r q(r) of an OpenCV lens."""
    u = r * r
    numerator = 1 + lens.k1 * u + lens.k2 * u**2 + lens.k3 * u**3
    return r * numerator / (1 + lens.k4 * u + lens.k5 * u**2 + lens.k6 * u**3)


def test_valid_radius_of_one_coefficient_matches_the_closed_form():
    # d/dr (r + k1 r^3) = 1 + 3 k1 r^2; 1 + k4 r^2 has its zero before the derivative has one.
    assert OpenCV(k1=-0.3).valid_radius == pytest.approx(math.sqrt(1 / 0.9), rel=1e-12)
    assert OpenCV(k1=0.3).valid_radius == math.inf
    assert OpenCV(k4=-0.25).valid_radius == pytest.approx(2.0, rel=1e-12)
    # d/dr r / (1 + k4 r^2) vanishes where 1 = k4 r^2.
    assert OpenCV(k4=0.25).valid_radius == pytest.approx(2.0, rel=1e-12)


def test_valid_radius_of_a_touching_derivative_is_where_it_touches():
    # 1 + 3 k1 u + 5 k2 u^2 = (1 - u / c)^2: a double root, found to the square root of rounding,
    # and with an imaginary part of 1e-8 for some of these.
    for c in np.arange(0.3, 3.0, 0.1):
        lens = OpenCV(k1=-2 / (3 * c), k2=1 / (5 * c**2))
        assert lens.valid_radius == pytest.approx(math.sqrt(c), rel=1e-7)


@pytest.mark.parametrize("seed", range(8))
def test_valid_radius_is_where_the_distorted_radius_first_turns(seed):
    rng = np.random.default_rng(seed)
    lens = OpenCV(*rng.normal(0, [0.3, 0.1, 0.03, 0.3, 0.1, 0.03]))
    radii = np.linspace(0, 5, 500_001)
    values = radial(lens, radii)
    turns = np.flatnonzero(np.diff(values) <= 0)  # a pole jumps down from +inf to -inf
    first = radii[turns[0]] if len(turns) else math.inf
    assert first < 5 or len(turns) == 0
    if first < math.inf:
        assert abs(lens.valid_radius - first) <= 2 * radii[1]
    else:
        assert lens.valid_radius > 5


TILTED = ThinPrismFisheye(-0.1, p1=0.06, p2=-0.08, sx1=0.1, sy1=0.05)


def limit_of(lens) -> float:
    """The largest slope, or angle, that a lens is made for, at most 10."""
    return min(lens.valid_radius if isinstance(lens, OpenCV) else lens.valid_angle, 10.0)


def places_within(lens, parts, count) -> np.ndarray:
    """(parts, count, 2) slopes or angles in all directions, at parts of the limit."""
    azimuths, radii = np.meshgrid(np.linspace(0, 2 * np.pi, count), limit_of(lens) * parts)
    return radii[..., None] * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=-1)


TANGENTIAL = OpenCV(k1=-0.3, p1=0.18, p2=-0.24)


@pytest.mark.parametrize("lens", [BARREL, RATIONAL, TANGENTIAL, TILTED, THIN_PRISM], ids=str)
def test_distortion_is_inverted_within_the_limit(lens):
    places = places_within(lens, np.array([0.1, 0.5, 0.9, 0.999]), 40).reshape(-1, 2)
    # Next to a fold the inverse is steeper than the distortion by a factor of 1000.
    np.testing.assert_allclose(lens.undistort(lens.distort(places)), places, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "sizes"),
    [
        (OpenCV, [0.3, 0.1, 0.03, 0.3, 0.1, 0.03, 0.1, 0.1]),
        (ThinPrismFisheye, [0.1, 0.05, 0.02, 0.01, 0.1, 0.1, 0.1, 0.1]),
    ],
)
def test_lenses_have_no_fold_within_their_limit(kind, sizes):
    """The symmetric parts of difference quotients, in a disc of each of 40 lenses, are positive.

    No direction has a smaller eigenvalue than ``least_eigenvalue`` has; where there are no radial
    terms, one has it.
    """
    ended, parts = 0, np.linspace(0.01, 0.999, 20)
    tilt = ("p1", "p2", "sx1", "sy1")
    for seed in range(40):
        lens = kind(*np.random.default_rng(seed).normal(0, sizes))
        plain = replace(lens, **{name: 0.0 for name in tilt if hasattr(lens, name)})
        ended += limit_of(lens) < 0.99 * limit_of(plain)
        if seed % 2 == 0:
            lens = kind(**{name: getattr(lens, name) for name in tilt if hasattr(lens, name)})
        places, h = places_within(lens, parts, 720), 1e-6 * limit_of(lens)
        columns = [
            (lens.distort(places + step) - lens.distort(places - step)) / h
            for step in h * np.eye(2) / 2
        ]
        quotients = np.stack(columns, axis=-1)
        symmetric = (quotients + np.swapaxes(quotients, -1, -2)) / 2
        found = np.linalg.eigvalsh(symmetric)[..., 0].min(axis=1)
        least = lens.least_eigenvalue(limit_of(lens) * parts)
        # Rounding of quotients, over h; half a degree between directions.
        assert (found > least - 1e-9).all() and (least > 0).all(), lens
        assert seed % 2 or np.abs(found - least).max() < 1e-4, lens
    assert ended > 20


@pytest.mark.parametrize("degrees", [1e-6, 30, 90, 120, 170])
def test_plain_fisheye_is_proportional_to_the_angle(degrees):
    camera, theta = camera_at_origin(fy=230.0), math.radians(degrees)
    point = 3.0 * np.array([[math.sin(theta) * 0.6, math.sin(theta) * -0.8, math.cos(theta)]])
    assert Fisheye().is_seen(camera, point).all()
    expected = 230 * theta * np.array([[0.6, -0.8]]) + [140, 95]
    np.testing.assert_allclose(Fisheye().film_points(camera, point), expected, rtol=1e-13)


def test_fisheye_is_valid_up_to_its_first_turn_or_almost_all_around():
    assert Fisheye().valid_angle == 0.95 * math.pi
    assert Fisheye(k1=0.1).valid_angle == 0.95 * math.pi
    # d/dtheta (theta + k1 theta^3) = 1 + 3 k1 theta^2
    assert Fisheye(k1=-0.3).valid_angle == pytest.approx(math.sqrt(1 / 0.9), rel=1e-12)
    theta = np.linspace(0, np.pi, 1_000_001)
    lens = Fisheye(0.05, -0.04, 0.01, -0.002)
    powers = theta ** np.array([[1], [3], [5], [7], [9]])
    turn = theta[np.argmax(np.diff(np.array([1, lens.k1, lens.k2, lens.k3, lens.k4]) @ powers) < 0)]
    assert 0 < turn < 2.5 and abs(lens.valid_angle - turn) < 1e-5

    camera = camera_at_origin()
    for lens, limit in [(Fisheye(), 0.95 * math.pi), (Fisheye(k1=-0.3), math.sqrt(1 / 0.9))]:
        angles = np.array([limit - 1e-9, limit + 1e-9, math.pi])
        points = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
        np.testing.assert_array_equal(lens.is_seen(camera, points), [True, False, False])


def test_depth_is_distance_for_a_fisheye_and_z_otherwise():
    camera = camera_at_origin(near=0.5)
    points = np.array([[0.6, 0, 0.1], [0.3, 0, 0.1], [0.0, 0.4, 0.5], [0.7, 0, -0.1], [0, 0, 0]])
    assert list(Fisheye().is_seen(camera, points)) == [True, False, True, True, False]
    np.testing.assert_allclose(Fisheye().depths(camera, points)[2], math.sqrt(0.41), rtol=1e-15)
    for lens in (Pinhole(), OpenCV(), Orthographic()):
        assert list(lens.is_seen(camera, points)) == [False, False, True, False, False]
        np.testing.assert_array_equal(lens.depths(camera, points), points[:, 2])


@pytest.mark.parametrize("lens", [FISHEYE, Orthographic()], ids=str)
def test_view_directions_end_at_the_means_unless_rays_are_parallel(lens):
    gaussians, camera = small_scene()
    directions = lens.view_directions(camera, gaussians.means)
    for mean, direction in zip(gaussians.means, directions, strict=True):
        expected = mean - camera.center
        if isinstance(lens, Orthographic):
            expected = np.linalg.inv(camera.rotation) @ [0, 0, 1]
        np.testing.assert_allclose(direction, expected / np.linalg.norm(expected), atol=1e-14)


@pytest.mark.parametrize(("lens", "antialiased"), [(Pinhole(), True), (OpenCV(), False)])
def test_pinhole_splats_match_the_reference(lens, antialiased):
    """Row 9's slopes are clamped in J, row 10 is behind the camera, row 11 is too faint."""
    gaussians, camera = small_scene()
    expected = reference.project(gaussians, camera, antialiased)
    actual = effects.project(gaussians, camera, lens, antialiased)
    np.testing.assert_array_equal(actual.visible, expected.visible)
    assert list(np.flatnonzero(~actual.visible)) == [10, 11]
    for field in ("means2d", "cov2d", "conics", "opacities"):
        # J by differences is off by 1e-13 of itself. Measured: 1e-13.
        np.testing.assert_allclose(
            getattr(actual, field)[:10], getattr(expected, field)[:10], rtol=1e-10, atol=1e-11
        )
    np.testing.assert_allclose(actual.depths, expected.depths, atol=1e-14)


@every_lens
def test_covariances_match_projected_samples(lens):
    """A Gaussian of 1e-5 of its distance leaves samples whose covariance is J's sandwich."""
    camera = replace(small_camera(), width=400, height=400, cx=210.0, cy=190.0, fx=220.0, fy=260.0)
    points = points_within(lens, camera, count=8)
    rng = np.random.default_rng(1)
    scales = 1e-5 * np.linalg.norm(points, axis=1)[:, None] * rng.uniform(0.3, 1.0, (8, 3))
    gaussians = gaussians_at(points @ camera.rotation + camera.center, scales)
    gaussians = replace(gaussians, quats=rng.normal(0, 1, (8, 4)))
    splats = effects.project(gaussians, camera, lens, low_pass=0.0)
    assert splats.visible.all()

    turns = reference.quat_to_rotation(gaussians.quats)
    for n in range(8):
        offsets = whitened_samples(5000) * scales[n] @ turns[n].T
        world = gaussians.means[n] + offsets
        film = lens.film_points(camera, (world - camera.center) @ camera.rotation.T)
        # The Gaussian is 1e-5 of its distance, and so is the quadratic part of the linear one,
        # times the samples' third moments, 0.03. Measured: 1.1e-6.
        expected = np.cov(film.T, bias=True)
        np.testing.assert_allclose(
            splats.cov2d[n], expected, rtol=0, atol=1e-5 * np.abs(expected).max()
        )
        np.testing.assert_allclose(splats.conics[n] @ splats.cov2d[n], np.eye(2), atol=1e-8)


def test_a_singular_splat_is_not_visible():
    gaussians = gaussians_at([0, 0, 1], [1e-200, 1e-200, 0.1])
    splats = effects.project(gaussians, camera_at_origin(), Orthographic(), low_pass=0.0)
    assert not splats.visible.any() and np.isfinite(splats.conics).all()


@every_lens
def test_invisible_splats_have_finite_values(lens):
    means = np.array([[0, 0, 0], [0, 0, -1], [1, 2, 0], [3, 0, 0.011], [0, 0, 2.0], [1e3, 0, 1]])
    gaussians, camera = gaussians_at(means), camera_at_origin()
    with np.errstate(all="raise"):
        splats = effects.project(gaussians, camera, lens, defocus=None)
    for field in fields(splats):
        assert np.isfinite(getattr(splats, field.name)).all(), field.name
    assert splats.visible[4] and not splats.visible[0]


@pytest.mark.parametrize("lens", [OpenCV(k1=-0.1), PINCUSHION], ids=str)
def test_slope_bounds_are_at_corners_or_on_the_axes_of_the_film(lens):
    """A barrel's corners are pulled in most; a pincushion's edges bulge outward between them."""
    camera = camera_at_origin(cx=130.0, cy=105.0)
    border = np.array([[0, 0], [260, 210], [0, 105], [260, 105], [130, 0], [130, 210]])
    slopes = []
    for x, y in (border - [130, 105]) / [230, 190]:
        distorted = math.hypot(x, y)
        radius = brentq(lambda r, t=distorted: radial(lens, r) - t, 0, min(lens.valid_radius, 2))
        slopes.append([x * radius / distorted, y * radius / distorted])
    lower, upper = lens.slope_bounds(camera)
    np.testing.assert_allclose(lower, np.min(slopes, axis=0), rtol=1e-10)
    np.testing.assert_allclose(upper, np.max(slopes, axis=0), rtol=1e-10)
