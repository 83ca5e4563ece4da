"""Orders of the float64 reference, and pixels that are near a decision."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.reference_loops import (
    UNCUT,
    assert_images_agree,
    camera_gaussian,
    naive_image,
    only,
    pixel_rays,
    rotated_splats,
    scene_of,
    straight_camera,
)
from support.reference_scenes import (
    BACKGROUND,
    rotation_about,
    small_scene,
)

from drgs.reference import rays
from drgs.reference import splatting as reference
from drgs.reference.rays import ImageModel

# ----------------------------------------------------------------------------------------------
# Order
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
def test_peak_depth_on_the_film_matches_the_ray(low_pass):
    """t = m_z a / D from C, k and w of the film, against Br . Bm / |Br|^2 in three dimensions."""
    gaussians, camera = rotated_splats(), straight_camera()
    exact = ImageModel("exact", "pixel", low_pass=low_pass, alpha_cut=0.0)
    # rotated_splats lie within 1.3 times the film: EWA's slope is not clamped.
    splats = rays._splats(gaussians, camera, exact)
    assert len(splats.depths) == 8
    i, offsets = np.repeat(np.arange(8), 20), np.random.default_rng(0).normal(0, 3, (160, 2))
    in_space = rays._exact_peaks(splats, i, offsets, exact)
    on_film = rays._affine_peaks(splats, i, offsets, replace(exact, projection="ewa"))
    ahead = in_space.ahead > 0
    assert ahead.sum() > 20
    np.testing.assert_array_equal(on_film.ahead > 0, ahead)
    # h = w - |kappa|^2 cancels to the square of the splats' ratio of axes, 1e-3. Measured: 2e-15.
    np.testing.assert_allclose(on_film.depths[ahead], in_space.depths[ahead], rtol=1e-13)
    np.testing.assert_allclose(
        in_space.rho_sq[ahead],
        (on_film.rho_sq * on_film.depths / splats.depths[i] / on_film.ahead)[ahead],
        rtol=1e-13,
    )


@pytest.mark.parametrize("projection", ["ewa", "exact"])
def test_pixel_order_of_two_discs_changes_where_their_planes_cross(projection):
    """A flat disc's peak is where the ray meets its plane, for EWA too: h = 0, t = m_z / a."""
    camera = straight_camera(size=21, focal=20.0)
    turns = [(0.2, [0.3, 1, 0], 0.7), (-0.2, [0.1, 1, 0], -0.6)]
    axes = [np.array(axis) / np.linalg.norm(axis) for _, axis, _ in turns]
    quats = [
        [math.cos(angle / 2), *(math.sin(angle / 2) * axis)]
        for (_, _, angle), axis in zip(turns, axes, strict=True)
    ]
    gaussians = scene_of(
        [[0.03, 0.0, 2.0], [-0.02, 0.01, 2.1]],
        [np.log(0.4), np.log(0.5), -np.inf],
        quats=quats,
        opacity=0.8,
        colors=[[1, 0, 0], [0, 1, 0]],
    )
    model = replace(UNCUT, projection=projection, order="pixel", low_pass=0.0)
    planes = []
    for n, (_, _, angle) in enumerate(turns):
        normal = rotation_about(axes[n], angle)[:, 2]
        planes.append(normal @ gaussians.means[n] / (pixel_rays(camera) @ normal))
    first_in_front = planes[0] < planes[1]
    assert 50 < first_in_front.sum() < 21 * 21 - 50

    alphas = [rays.render(only(gaussians, [n]), camera, model=model).alpha for n in (0, 1)]
    red = np.where(first_in_front, 1.0, 1 - alphas[1]) * alphas[0]
    green = np.where(first_in_front, 1 - alphas[0], 1.0) * alphas[1]
    rendered = rays.render(gaussians, camera, model=model)
    # alpha is 1 - T, rounded at the size of 1.
    np.testing.assert_allclose(rendered.image[..., 0], red, rtol=0, atol=1e-14)
    np.testing.assert_allclose(rendered.image[..., 1], green, rtol=0, atol=1e-14)
    by_center = rays.render(gaussians, camera, model=replace(model, order="center"))
    np.testing.assert_allclose(by_center.image[..., 0], alphas[0], rtol=0, atol=1e-14)


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
def test_entry_point_is_on_the_ellipsoid(low_pass):
    gaussians, camera = rotated_splats(), straight_camera()
    model = ImageModel("exact", "entry", extent=1.7, low_pass=low_pass, alpha_cut=0.0)
    splats = rays._splats(gaussians, camera, model)
    i = np.repeat(np.arange(8), 20)
    offsets = np.random.default_rng(0).normal(0, 1, (160, 2)) * 0.5
    peaks = rays._exact_peaks(splats, i, offsets, model)
    inside = peaks.rho_sq < 1.7**2
    assert inside.sum() > 40
    for j in np.flatnonzero(inside):
        mean, factor = camera_gaussian(gaussians, camera, i[j])
        widening = low_pass * mean[2] ** 2 / camera.fx**2 * np.diag([1, 1, 0])
        precision = np.linalg.inv(factor @ factor.T + widening)
        ray = np.array([*(mean[:2] / mean[2] + offsets[j] / camera.fx), 1.0])
        offset = peaks.keys[j] * ray - mean
        # The condition of the covariance, up to 1e3, and 1e2 deviations to the camera.
        assert offset @ precision @ offset == pytest.approx(1.7**2, rel=1e-9)
        assert offset @ precision @ ray < 0, "this is where the ray leaves"


def test_entry_order_puts_a_large_splat_before_a_nearer_small_one():
    camera = straight_camera()
    gaussians = scene_of(
        [[0, 0, 2.0], [0, 0, 3.0]],
        np.log([[0.1, 0.1, 0.1], [0.6, 0.6, 0.6]]),
        colors=[[1, 0, 0], [0, 1, 0]],
    )
    orders = {"center": [0.5, 0.25, 0], "pixel": [0.5, 0.25, 0], "entry": [0.25, 0.5, 0]}
    for order, color in orders.items():
        # Enters at 2 - 0.3 = 1.7 and 3 - 1.8 = 1.2.
        model = ImageModel("exact", order, extent=3.0, low_pass=0.0)
        rendered = rays.render(gaussians, camera, model=model)
        np.testing.assert_allclose(rendered.image[4, 4], color, rtol=0, atol=1e-15)
        # The depths are of the peaks, whatever the order is by.
        expected = color[0] * 2 + color[1] * 3
        np.testing.assert_allclose(rendered.depth[4, 4], expected, rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.0, 0.3])
@pytest.mark.parametrize("stop", ["before", "after"])
def test_ray_skips_splats_entered_within_a_step(step, stop):
    """And a pixel may end behind the splat that is too much. Against the loop over pixels."""
    gaussians, camera = small_scene()
    model = ImageModel(
        "exact", "entry", stop=stop, transmittance_stop=0.2, extent=2.0, step=step, low_pass=0.0
    )
    rendered = rays.render(gaussians, camera, BACKGROUND, model)
    assert_images_agree(rendered, naive_image(gaussians, camera, model), atol=1e-12)
    plain = replace(model, stop="before", step=0.0)
    same = np.array_equal(rays.render(gaussians, camera, BACKGROUND, plain).image, rendered.image)
    assert same == (step == 0 and stop == "before")


def test_splat_around_the_camera_is_invisible_in_entry_order():
    gaussians, camera = scene_of([[0, 0, 1.0]], np.log(0.4)), straight_camera()
    for extent, exists in [(2.4, True), (2.6, False)]:
        model = ImageModel("exact", "entry", extent=extent, low_pass=0.0)
        rendered = rays.render(gaussians, camera, model=model)
        assert rendered.alpha[4, 4] == (0.5 if exists else 0.0)
        assert (
            rays.render(gaussians, camera, model=replace(model, order="pixel")).alpha[4, 4] == 0.5
        )


def test_splats_with_their_peak_behind_the_camera_are_invisible():
    """A needle whose line passes the camera: rays to one side meet it in front, others behind."""
    camera = straight_camera(size=9, focal=4.0)
    angle = math.radians(80)
    gaussians = scene_of(
        [[0.0, 0.0, 0.5]],
        np.log([2.0, 0.05, 0.05]),
        quats=[[math.cos(angle / 2), 0, math.sin(angle / 2), 0]],
    )
    mean, factor = camera_gaussian(gaussians, camera, 0)
    precision = np.linalg.inv(factor @ factor.T)
    behind = pixel_rays(camera)[4] @ precision @ mean <= 0
    assert 1 <= behind.sum() <= 5
    for projection, order in [("exact", "center"), ("exact", "pixel"), ("ewa", "pixel")]:
        model = replace(UNCUT, projection=projection, order=order, low_pass=0.0)
        alpha = rays.render(gaussians, camera, model=model).alpha[4]
        assert not alpha[behind].any() and alpha[~behind].all(), (projection, order)
    # EWA does not need depths when sorted by center.
    model = replace(UNCUT, low_pass=0.0)
    assert rays.render(gaussians, camera, model=model).alpha[4].all()


def test_ties_are_composited_by_index():
    colors = np.eye(3)
    gaussians = scene_of(np.tile([0, 0, 2.0], (3, 1)), np.log(0.1), colors=colors)
    for model in (
        ImageModel("ewa", "pixel"),
        ImageModel("exact", "pixel"),
        ImageModel("exact", "entry", extent=3.0),
    ):
        rendered = rays.render(gaussians, straight_camera(), model=model)
        # The middle of the film is the middle of a pixel: G = 1.
        np.testing.assert_allclose(rendered.image[4, 4], [0.5, 0.25, 0.125], rtol=0, atol=1e-15)


# ----------------------------------------------------------------------------------------------
# Near a threshold
# ----------------------------------------------------------------------------------------------


MARKED_DISTANCES = [(-2e-6, False), (-5e-7, True), (5e-7, True), (2e-6, False)]
"""(relative distance, whether a width of 1e-6 marks it)"""


def test_pixels_near_the_extent_are_marked():
    """At (1, 0) px from the mean of a splat of 1 px^2: rho = 1."""
    gaussians, camera = scene_of([[0, 0, 1.0]], np.log(0.1)), straight_camera(focal=10.0)
    for relative, marked in MARKED_DISTANCES:
        model = ImageModel(extent=math.sqrt(1 / (1 + relative)), low_pass=0.0)
        rendered = rays.render(gaussians, camera, model=model)
        assert rendered.near_threshold[4, 5] == marked, relative
        assert (rendered.alpha[4, 5] > 0) == (relative < 0)
        assert not rendered.near_threshold[4, 4]


def test_pixels_with_ambiguous_order_are_marked():
    camera = straight_camera()
    for relative, marked in MARKED_DISTANCES:
        gaussians = scene_of([[0, 0, 2.0], [0, 0, 2.0 * (1 + relative)]], np.log(0.1))
        for order in ("center", "pixel"):
            model = ImageModel("exact", order)
            near = rays.render(gaussians, camera, model=model).near_threshold[4, 4]
            assert near == (marked and order == "pixel"), (relative, order)


def test_ambiguous_order_is_found_among_all_splats():
    gaussians = scene_of([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 2.0 + 1e-7]], np.log(0.1))
    camera, model = straight_camera(), ImageModel("exact", "pixel")
    assert rays.render(gaussians, camera, model=model).near_threshold[4, 4]
    apart = replace(gaussians, means=[[0, 0, 2.0], [0, 0, 2.5], [0, 0, 3.0]])
    assert not rays.render(apart, camera, model=model).near_threshold[4, 4]


def test_splats_behind_the_stop_mark_no_pixels():
    """Two clamped splats finish the pixel; a third, of alpha 0.99, is before or behind them."""
    for third, marked in [(1.0, True), (4.0, False)]:
        gaussians = scene_of(
            [[0, 0, 2.0], [0, 0, 3.0], [0, 0, third]],
            np.log(0.1),
            opacity=np.array([0.9999, 0.9999, reference.ALPHA_MAX]),
        )
        rendered = rays.render(gaussians, straight_camera(), model=ImageModel("exact", "pixel"))
        assert rendered.transmittance[4, 4] == 1 - reference.ALPHA_MAX
        assert rendered.near_threshold[4, 4] == marked, third


def test_pixels_whose_ray_enters_a_splat_near_the_camera_are_marked():
    camera = straight_camera()
    for relative, marked in MARKED_DISTANCES:
        gaussians = scene_of([[0, 0, 1.0]], np.log(0.5 * (1 + relative)))
        model = ImageModel("exact", "entry", extent=2.0, low_pass=0.0)
        rendered = rays.render(gaussians, camera, model=model)
        assert rendered.near_threshold[4, 4] == marked, relative
        assert (rendered.alpha[4, 4] > 0) == (relative < 0)


def test_disabled_cuts_mark_no_pixels():
    """An alpha that underflows to 0 is not near a cut of 0, nor T = 0 near a stop of 0."""
    gaussians = replace(scene_of([[0, 0, 1]], np.log(1e-3)), logit_opacities=[2.0])
    rendered = rays.render(gaussians, straight_camera(), model=replace(UNCUT, low_pass=0.0))
    assert rendered.alpha[0, 0] == 0 and not rendered.near_threshold.any()
