"""Defocus, moving cameras, smoothing and images through lenses against samples and limits.

The laws and the tests of effects compare images of moving cameras and rates with the kernels'.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.reference_lenses import camera_at_origin, gaussians_at
from support.reference_scenes import (
    BACKGROUND,
    assert_images_agree,
    rotation_about,
    small_camera,
    small_scene,
)

from drgs.reference import effects
from drgs.reference import splatting as reference
from drgs.reference.effects import OpenCV, Orthographic, Pinhole, ThinLens
from drgs.reference.splatting import Camera


@pytest.mark.parametrize(
    ("lens", "antialiased", "degree"), [(Pinhole(), False, None), (OpenCV(), True, 1)]
)
def test_pinhole_image_matches_the_reference(lens, antialiased, degree):
    """Splat 9's slopes are clamped in J, 10 is behind the camera, 11 is too faint."""
    gaussians, camera = small_scene()
    expected = reference.render(gaussians, camera, BACKGROUND, degree, antialiased)
    actual = effects.render(gaussians, camera, lens, BACKGROUND, antialiased, degree=degree)
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
        reference.project(gaussians, c) for c in effects.lens_cameras(camera, defocus, 1000)
    ]
    means2d = np.array([s.means2d[0] for s in lens_splats])
    cov2d = np.mean([s.cov2d[0] for s in lens_splats], axis=0) + np.cov(means2d.T, bias=True)
    splats = effects.project(gaussians, camera, defocus=defocus)
    # The sunflower's moments are a disc's to about 1e-3, and J differs between the pinholes by
    # the aperture's angle squared, 0.01 at depth 1. Measured: 1e-3.
    np.testing.assert_allclose(means2d.mean(axis=0), splats.means2d[0], atol=2e-2)
    np.testing.assert_allclose(splats.cov2d[0], cov2d, rtol=0, atol=2e-3 * cov2d.max())
    assert (depth == 2.0) == np.allclose(splats.cov2d, effects.project(gaussians, camera).cov2d)


def test_defocus_needs_a_lens_with_a_centre():
    gaussians, camera = small_scene()
    with pytest.raises(ValueError, match="defocus needs a lens whose rays meet"):
        effects.project(gaussians, camera, Orthographic(), defocus=ThinLens(0.1, 2.0))
    for wrong in [(-0.1, 2.0), (0.1, 0.0), (math.nan, 1.0), (0.1, math.inf)]:
        with pytest.raises(ValueError, match="aperture_radius must be >= 0, focus_distance > 0"):
            ThinLens(*wrong)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.4, -2.0, 3.1, math.pi, 1.5 * math.pi])
@pytest.mark.parametrize("t", [0.0, 0.25, 1.0])
def test_pose_rotates_by_a_fraction_of_the_angle(angle, t):
    """On the shortest arc; half a turn may go either way."""
    axis, start = [0.3, -1.0, 0.5], rotation_about([1.0, 0.2, 0.1], 1.3)
    open = start, np.array([1.0, -2.0, 1e6])
    close = rotation_about(axis, angle) @ start, np.array([3.0, -2.0, -1e6])
    rotation, center = effects.interpolate_pose(open, close, t)
    arcs = [angle - 2 * math.pi] if angle > math.pi else [angle]
    arcs += [-angle] * (angle == math.pi)
    ways = [rotation_about(axis, t * arc) @ start for arc in arcs]
    assert min(np.abs(rotation - way).max() for way in ways) < 1e-14
    np.testing.assert_allclose(center, [1 + 2 * t, -2, 1e6 - 2e6 * t], rtol=1e-15)


def test_cameras_must_differ_in_their_poses_only():
    camera = small_camera()
    with pytest.raises(ValueError, match=r"fx must be the same .* got 23.0 and 24.0"):
        effects.camera_at(camera, replace(camera, fx=24.0), 0.5)


def test_a_pixel_is_marked_if_it_is_near_a_threshold_at_any_time():
    camera = Camera(np.eye(3), np.zeros(3), 8.0, 8.0, 4.5, 4.5, 9, 9)
    close = replace(camera, center=np.array([0.5, 0.0, 0.0]))
    # At time 1/4 it is at the centre of pixel [4, 4], at 3/4 of [4, 2]; there alpha is its opacity.
    gaussians = gaussians_at([0.125, 0, 1.0], 0.1, opacity=reference.ALPHA_MAX)
    marked = effects.render_motion_blur(gaussians, camera, close, 2).near_threshold
    expected = np.zeros((9, 9), dtype=bool)
    expected[4, [2, 4]] = True
    np.testing.assert_array_equal(marked, expected)


def test_smoothing_is_a_convolution():
    """On one axis: a sampled Gaussian convolved with one of variance 0.2 / rate^2."""
    scale, rate, opacity = 0.03, 12.0, 0.7
    scales, opacities = effects.smoothing_filter(
        np.log([[scale, 1e6, 1e6]]), np.array([math.log(0.7 / 0.3)]), np.array([rate])
    )
    x = np.linspace(-1, 1, 4001)
    signal = opacity * np.exp(-0.5 * (x / scale) ** 2)
    kernel = np.exp(-0.5 * x**2 / (0.2 / rate**2))
    convolved = np.convolve(signal, kernel / kernel.sum(), mode="same")
    smoothed = opacities[0] * np.exp(-0.5 * (x / scales[0, 0]) ** 2)
    # Sums of smooth functions are integrals to far below rounding; the far axes change by 1e-17.
    np.testing.assert_allclose(smoothed, convolved, atol=1e-12)


def test_sampling_rates_without_visible_means_are_an_error():
    behind = np.array([[0, 0, -1.0]])
    with pytest.raises(ValueError, match="none of 1 cameras sees any of the 1 means"):
        effects.sampling_rates(behind, [camera_at_origin()])
    assert effects.sampling_rates(np.zeros((0, 3)), [camera_at_origin()]).shape == (0,)
