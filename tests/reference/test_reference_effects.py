"""Lenses, defocus, moving cameras and smoothing against samples, limits and other programs.

The laws and the tests of cameras and effects compare splats, depths, directions, images of moving
cameras and sampling rates with those of the kernels.
"""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.optimize import brentq
from support import lenses, reference_effects
from support.lenses import (
    Fisheye,
    OpenCV,
    Orthographic,
    Pinhole,
    ThinPrismFisheye,
)
from support.reference_effects import ThinLens
from support.reference_lenses import FISHEYE, THIN_PRISM, camera_at_origin, gaussians_at
from support.reference_scenes import BACKGROUND, assert_images_agree, rotation_about, small_scene

from drgs.reference import splatting as reference
from drgs.reference.splatting import Camera

# ----------------------------------------------------------------------------------------------
# Lenses
# ----------------------------------------------------------------------------------------------

# Coefficients of sizes that cameras have, exact in binary.
BARREL = OpenCV(k1=-0.25, k2=0.0625, p1=0.0078125, p2=-0.015625, k3=0.03125)
RATIONAL = replace(BARREL, k4=0.125, k5=-0.0625, k6=0.015625)
PINCUSHION = OpenCV(k1=0.125, k2=0.03125)
LENSES = [Pinhole(), BARREL, RATIONAL, PINCUSHION, Fisheye(), FISHEYE, THIN_PRISM, Orthographic()]

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


def limit_of(lens) -> float:
    """The slope, or angle, up to which a lens is made."""
    return lens.valid_radius if isinstance(lens, OpenCV) else lens.valid_angle


def radial(lens, r):
    """The distorted slopes, or angles, of some from the axis, without tangential terms."""
    u = r * r
    numerator = 1 + lens.k1 * u + lens.k2 * u**2 + lens.k3 * u**3
    if isinstance(lens, Fisheye):
        return r * (numerator + lens.k4 * u**4)
    return r * numerator / (1 + lens.k4 * u + lens.k5 * u**2 + lens.k6 * u**3)


@pytest.mark.parametrize(
    ("lens", "limit"),
    [
        # d/dr (r + k1 r^3) = 1 + 3 k1 r^2; 1 + k4 r^2 has its zero before the derivative has one.
        (OpenCV(k1=-0.3), math.sqrt(1 / 0.9)),
        (OpenCV(k1=0.3), math.inf),
        (OpenCV(k4=-0.25), 2.0),
        # d/dr r / (1 + k4 r^2) vanishes where 1 = k4 r^2.
        (OpenCV(k4=0.25), 2.0),
        (Fisheye(), 0.95 * math.pi),
        (Fisheye(k1=0.1), 0.95 * math.pi),
        (Fisheye(k1=-0.3), math.sqrt(1 / 0.9)),
    ],
)
def test_limit_of_one_coefficient_matches_the_closed_form(lens, limit):
    assert limit_of(lens) == pytest.approx(limit, rel=1e-12)
    if isinstance(lens, Fisheye):
        angles = np.array([limit - 1e-9, limit + 1e-9, math.pi])
        points = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
        assert lens.is_seen(camera_at_origin(), points).tolist() == [True, False, False]


def test_valid_radius_of_a_touching_derivative_is_where_it_touches():
    # 1 + 3 k1 u + 5 k2 u^2 = (1 - u / c)^2: a double root, found to the square root of rounding,
    # and with an imaginary part of 1e-8 for some of these.
    for c in np.arange(0.3, 3.0, 0.1):
        lens = OpenCV(k1=-2 / (3 * c), k2=1 / (5 * c**2))
        assert lens.valid_radius == pytest.approx(math.sqrt(c), rel=1e-7)


@pytest.mark.parametrize(
    "lens",
    [
        Fisheye(0.05, -0.04, 0.01, -0.002),
        *(
            OpenCV(*np.random.default_rng(seed).normal(0, [0.3, 0.1, 0.03, 0.3, 0.1, 0.03]))
            for seed in range(8)
        ),
    ],
    ids=str,
)
def test_limit_is_where_the_distorted_radius_first_turns(lens):
    radii = np.linspace(0, 5, 1_000_001)
    turns = np.flatnonzero(np.diff(radial(lens, radii)) <= 0)  # a pole jumps from +inf to -inf
    if len(turns):
        assert abs(limit_of(lens) - radii[turns[0]]) <= 2 * radii[1]
    else:
        assert limit_of(lens) > 5


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
    ended, parts, azimuths = 0, np.linspace(0.01, 0.999, 20), np.linspace(0, 2 * np.pi, 720)
    directions = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=-1)
    tilt = ("p1", "p2", "sx1", "sy1")
    for seed in range(40):
        lens = kind(*np.random.default_rng(seed).normal(0, sizes))
        plain = replace(lens, **{name: 0.0 for name in tilt if hasattr(lens, name)})
        ended += limit_of(lens) < 0.99 * limit_of(plain)
        if seed % 2 == 0:
            lens = kind(**{name: getattr(lens, name) for name in tilt if hasattr(lens, name)})
        limit = min(limit_of(lens), 10.0)
        places, h = limit * parts[:, None, None] * directions, 1e-6 * limit
        columns = [
            (lens.distort(places + step) - lens.distort(places - step)) / h
            for step in h * np.eye(2) / 2
        ]
        quotients = np.stack(columns, axis=-1)
        symmetric = (quotients + np.swapaxes(quotients, -1, -2)) / 2
        found = np.linalg.eigvalsh(symmetric)[..., 0].min(axis=1)
        least = lens.least_eigenvalue(limit * parts)
        # Rounding of quotients, over h; half a degree between directions.
        assert (found > least - 1e-9).all() and (least > 0).all(), lens
        assert seed % 2 or np.abs(found - least).max() < 1e-4, lens
    assert ended > 20


def test_a_singular_splat_is_not_visible():
    gaussians = gaussians_at([0, 0, 1], [1e-200, 1e-200, 0.1])
    splats = lenses.project(gaussians, camera_at_origin(), Orthographic(), low_pass=0.0)
    assert not splats.visible.any() and np.isfinite(splats.conics).all()


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_invisible_splats_have_finite_values(lens):
    means = np.array([[0, 0, 0], [0, 0, -1], [1, 2, 0], [3, 0, 0.011], [0, 0, 2.0], [1e3, 0, 1]])
    with np.errstate(all="raise"):
        splats = lenses.project(gaussians_at(means), camera_at_origin(), lens)
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


# ----------------------------------------------------------------------------------------------
# Images
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lens", "antialiased", "degree"), [(Pinhole(), False, None), (OpenCV(), True, 1)]
)
def test_pinhole_image_matches_the_reference(lens, antialiased, degree):
    """Splat 9's slopes are clamped in J, 10 is behind the camera, 11 is too faint."""
    gaussians, camera = small_scene()
    expected = reference.render(gaussians, camera, BACKGROUND, degree, antialiased)
    actual = lenses.render(gaussians, camera, lens, BACKGROUND, antialiased, degree=degree)
    # J by differences: 1e-13 of itself. Measured: 3e-14.
    assert_images_agree(actual, expected, 1e-10)
    np.testing.assert_array_equal(actual.near_threshold, expected.near_threshold)


@pytest.mark.parametrize("depth", [1.0, 2.0, 5.0])
def test_defocused_moments_match_many_pinholes(depth):
    """Law of total variance: mean of the covariances plus the covariance of the means."""
    camera, defocus = camera_at_origin(), ThinLens(0.1, 2.0)
    camera = replace(camera, rotation=rotation_about([1, 2, 3], 0.5), center=np.array([5, 6, -7.0]))
    mean = camera.rotation.T @ [0.1, -0.2, depth] + camera.center
    gaussians = gaussians_at(mean, [[0.02, 0.03, 0.01]], quats=[0.3, 0.8, -0.5, 0.1])
    lens_splats = [
        reference.project(gaussians, c)
        for c in reference_effects.lens_cameras(camera, defocus, 1000)
    ]
    means2d = np.array([s.means2d[0] for s in lens_splats])
    cov2d = np.mean([s.cov2d[0] for s in lens_splats], axis=0) + np.cov(means2d.T, bias=True)
    splats = reference_effects.project_defocused(gaussians, camera, defocus)
    # The sunflower's moments are a disc's to about 1e-3, and J differs between the pinholes by
    # the aperture's angle squared, 0.01 at depth 1. Measured: 1e-3.
    np.testing.assert_allclose(means2d.mean(axis=0), splats.means2d[0], atol=2e-2)
    np.testing.assert_allclose(splats.cov2d[0], cov2d, rtol=0, atol=2e-3 * cov2d.max())
    assert (depth == 2.0) == np.allclose(splats.cov2d, lenses.project(gaussians, camera).cov2d)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.4, -2.0, 3.1, math.pi, 1.5 * math.pi])
@pytest.mark.parametrize("t", [0.0, 0.25, 1.0])
def test_pose_rotates_by_a_fraction_of_the_angle(angle, t):
    """On the shortest arc; half a turn may go either way."""
    axis, start = [0.3, -1.0, 0.5], rotation_about([1.0, 0.2, 0.1], 1.3)
    open = start, np.array([1.0, -2.0, 1e6])
    close = rotation_about(axis, angle) @ start, np.array([3.0, -2.0, -1e6])
    rotation, center = reference_effects.interpolate_pose(open, close, t)
    arcs = [angle - 2 * math.pi] if angle > math.pi else [angle]
    arcs += [-angle] * (angle == math.pi)
    ways = [rotation_about(axis, t * arc) @ start for arc in arcs]
    assert min(np.abs(rotation - way).max() for way in ways) < 1e-14
    np.testing.assert_allclose(center, [1 + 2 * t, -2, 1e6 - 2e6 * t], rtol=1e-15)


def test_a_pixel_is_marked_if_it_is_near_a_threshold_at_any_time():
    camera = Camera(np.eye(3), np.zeros(3), 8.0, 8.0, 4.5, 4.5, 9, 9)
    close = replace(camera, center=np.array([0.5, 0.0, 0.0]))
    # At time 1/4 it is at the centre of pixel [4, 4], at 3/4 of [4, 2]; there alpha is its opacity.
    gaussians = gaussians_at([0.125, 0, 1.0], 0.1, opacity=reference.ALPHA_MAX)
    marked = reference_effects.render_motion_blur(gaussians, camera, close, 2).near_threshold
    expected = np.zeros((9, 9), dtype=bool)
    expected[4, [2, 4]] = True
    np.testing.assert_array_equal(marked, expected)


def test_smoothing_is_a_convolution():
    """On one axis: a sampled Gaussian convolved with one of variance 0.2 / rate^2."""
    scale, rate, opacity = 0.03, 12.0, 0.7
    scales, opacities = reference_effects.smoothing_filter(
        np.log([[scale, 1e6, 1e6]]), np.array([math.log(0.7 / 0.3)]), np.array([rate])
    )
    x = np.linspace(-1, 1, 4001)
    signal = opacity * np.exp(-0.5 * (x / scale) ** 2)
    kernel = np.exp(-0.5 * x**2 / (0.2 / rate**2))
    convolved = np.convolve(signal, kernel / kernel.sum(), mode="same")
    smoothed = opacities[0] * np.exp(-0.5 * (x / scales[0, 0]) ** 2)
    # Sums of smooth functions are integrals to far below rounding; the far axes change by 1e-17.
    np.testing.assert_allclose(smoothed, convolved, atol=1e-12)
