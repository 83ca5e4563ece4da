"""Approximations against scalar loops and textbook formulas; orders; pixels near a decision.

The laws compare unscented splats, and peaks behind the camera, with the kernels.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.reference_lenses import gaussians_at
from support.reference_scenes import (
    BACKGROUND,
    MARKED_DISTANCES,
    assert_images_agree,
    legendre_sh_basis,
    only,
    rotation_about,
    small_scene,
    with_invisible,
)
from support.studies import reference_rays as rays

from drgs.reference import splatting as reference

ImageModel = rays.ImageModel

UNCUT = ImageModel(alpha_max=1.0, alpha_cut=0.0, transmittance_stop=0.0)
"""No decisions: every splat touches every pixel."""

# ----------------------------------------------------------------------------------------------
# Scalar loops and textbook formulas
# ----------------------------------------------------------------------------------------------


def camera_gaussian(gaussians, camera, n) -> tuple[np.ndarray, np.ndarray]:
    """(mean (3,), factor V (3, 3)) in camera axes, the covariance being V V^T."""
    w, *axis = gaussians.quats[n]
    angle = 2 * math.atan2(np.linalg.norm(axis), w)
    turn = rotation_about(axis, angle) if np.any(axis) else np.eye(3)
    factor = camera.rotation @ turn @ np.diag(np.exp(gaussians.log_scales[n]))
    return camera.rotation @ (gaussians.means[n] - camera.center), factor


def naive_film(mean, factor, camera, model):
    """(mean2d, C without low-pass, k, w) of one Gaussian in camera axes."""
    x, y, z = mean
    focal = np.array([camera.fx, camera.fy])
    slope = np.array([x / z, y / z])
    half = np.array([camera.width, camera.height]) / focal / 2
    low = -np.array([camera.cx, camera.cy]) / focal
    clamped = np.clip(slope, low - 0.3 * half, low + 2.3 * half)
    at = slope if model.projection == "exact" else clamped
    linear = np.column_stack([np.diag(focal), -focal * at]) / z
    sigma = factor @ factor.T
    mean2d = focal * slope + [camera.cx, camera.cy]
    return mean2d, linear @ sigma @ linear.T, linear @ sigma[:, 2] / z, sigma[2, 2] / z**2


def naive_splat(gaussians, camera, n, model):
    """A function of the pixel's (x, y): (alpha, sort key, depth), or None where it does not exist.

    None itself if the splat is culled.
    """
    mean, factor = camera_gaussian(gaussians, camera, n)
    z = mean[2]
    if z < camera.near:
        return None
    mean2d, projected, k, w = naive_film(mean, factor, camera, model)
    cov = projected + model.low_pass * np.eye(2)
    opacity = 1 / (1 + math.exp(-gaussians.logit_opacities[n]))
    if model.antialiased:
        opacity *= math.sqrt(np.linalg.det(projected) / np.linalg.det(cov))
    if opacity <= model.alpha_cut:
        return None
    conic = np.linalg.inv(cov)
    widening = model.low_pass * z**2 * np.diag([1 / camera.fx**2, 1 / camera.fy**2, 0])
    precision = np.linalg.inv(factor @ factor.T + widening)

    def along_ray(position):
        """(rho^2, t, entry) from rho^2(t) = A t^2 - 2 B t + C."""
        ray = np.array(
            [(position[0] - camera.cx) / camera.fx, (position[1] - camera.cy) / camera.fy, 1.0]
        )
        A, B, C = ray @ precision @ ray, ray @ precision @ mean, mean @ precision @ mean
        entry = None
        if math.isfinite(model.extent):
            roots = np.roots([A, -2 * B, C - model.extent**2])
            entry = min(roots.real)
        return C - B**2 / A, B / A, entry

    def on_film(position):
        d = position - mean2d
        rho_sq = d @ conic @ d
        a = 1 - k @ conic @ d
        h = max(0, w - k @ conic @ k)
        return rho_sq, z * a / (a**2 + h * rho_sq), None

    def at(position):
        rho_sq, t, entry = (along_ray if model.projection == "exact" else on_film)(position)
        raw = opacity * math.exp(-rho_sq / 2)
        if raw < model.alpha_cut or rho_sq > model.extent**2:
            return None
        if (model.order != "center" or model.projection == "exact") and t <= 0:
            return None
        if model.order == "entry" and entry <= 0:
            return None
        key = {"center": z, "pixel": t, "entry": entry}[model.order]
        return min(raw, model.alpha_max), key, z if model.order == "center" else t

    return at


def naive_color(gaussians, camera, model, n, position) -> np.ndarray:
    """(3,) the colour of Gaussian n in the direction of its mean, or of a pixel's ray."""
    direction = gaussians.means[n] - camera.center
    if model.sh_direction == "pixel":
        ray = [(position[0] - camera.cx) / camera.fx, (position[1] - camera.cy) / camera.fy, 1]
        direction = camera.rotation.T @ ray
    degree = gaussians.sh_degree if model.sh_degree is None else model.sh_degree
    basis = legendre_sh_basis(tuple(direction / np.linalg.norm(direction)), degree)
    coefficients = np.concatenate([gaussians.sh0[n], gaussians.shN[n]])[: len(basis)]
    return np.maximum(basis @ coefficients + 0.5, 0)


def naive_image(gaussians, camera, model) -> SimpleNamespace:
    shape = camera.height, camera.width
    image, depth, transmittance = np.zeros((*shape, 3)), np.zeros(shape), np.ones(shape)
    splats = [naive_splat(gaussians, camera, n, model) for n in range(len(gaussians.means))]
    for pixel in np.ndindex(shape):
        position = np.array([pixel[1] + 0.5, pixel[0] + 0.5])
        hits = [(splat(position), n) for n, splat in enumerate(splats) if splat]
        hits = sorted((hit[1], n, hit[0], hit[2]) for hit, n in hits if hit)
        left, last = 1.0, -math.inf
        slope = (position - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        for key, n, alpha, z in hits:
            if (key - last) * math.hypot(*slope, 1) < model.step:
                continue
            last = key
            behind = left * (1 - alpha)
            if (behind if model.stop == "before" else left) < model.transmittance_stop:
                break
            image[pixel] += left * alpha * naive_color(gaussians, camera, model, n, position)
            depth[pixel] += left * alpha * z
            left = behind
        image[pixel] += left * BACKGROUND
        transmittance[pixel] = left
    return SimpleNamespace(image=image, depth=depth, transmittance=transmittance)


# The loop inverts covariances of condition 25 and takes differences of squared distances from the
# camera, up to 40^2: rho^2 is off by up to 1e-16 * 25 * 40^2 = 4e-12. Measured: 8e-14.
LOOP_ROUNDING = 1e-11


@pytest.mark.parametrize(("antialiased", "sh_degree"), [(False, None), (True, 1)])
def test_default_model_matches_the_reference_and_a_loop(antialiased, sh_degree):
    gaussians, camera = small_scene()
    model = ImageModel(antialiased=antialiased, sh_degree=sh_degree)
    # Wide enough that the scene, which keeps 5e-4 clear of thresholds, has marked pixels.
    width = 0.01
    expected = reference.render(gaussians, camera, BACKGROUND, sh_degree, antialiased, width)
    rendered = rays.render(gaussians, camera, BACKGROUND, model, threshold_width=width)
    # Rounding only: C is inverted in another order of operations. Measured 1e-15.
    assert_images_agree(rendered, expected, atol=1e-13)
    # Both are float64; the loop's determinants and inverses lose a digit or two.
    assert_images_agree(expected, naive_image(gaussians, camera, model), 1e-12)
    np.testing.assert_array_equal(rendered.alpha, 1 - rendered.transmittance)
    assert expected.near_threshold.any() and not expected.near_threshold.all()
    np.testing.assert_array_equal(rendered.near_threshold, expected.near_threshold)


MODELS = [
    ImageModel("ewa", "pixel"),
    ImageModel("exact", antialiased=True),
    ImageModel("exact", "pixel", low_pass=0.0),
    ImageModel("exact", "pixel", "pixel"),
    ImageModel("exact", "entry", "pixel", extent=3.0, low_pass=0.0),
    ImageModel("exact", "entry", stop="after", transmittance_stop=0.2, extent=2.0, step=0.3),
    ImageModel("ewa", "center", "pixel", sh_degree=2),
    *(
        replace(UNCUT, projection=projection, **change)
        for projection in ("ewa", "exact")
        for change in (
            {},
            {"alpha_max": 0.6},
            {"alpha_cut": 0.1},
            {"transmittance_stop": 0.2},
            {"extent": 1.2},
            {"low_pass": 2.0},
            {"sh_degree": 0},
        )
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS, ids=str)
def test_image_equals_a_loop_over_pixels(model):
    gaussians, camera = small_scene()
    expected = naive_image(gaussians, camera, model)
    rendered = rays.render(gaussians, camera, BACKGROUND, model)
    assert_images_agree(rendered, expected, LOOP_ROUNDING)


PROJECTIONS = [
    ImageModel(),
    ImageModel("unscented", "pixel", extent=3.0),
    ImageModel("exact", "entry", "pixel", extent=3.0),
]


@pytest.mark.parametrize("model", PROJECTIONS, ids=lambda model: model.projection)
def test_regions_of_any_tiling_are_crops_of_the_whole(model, monkeypatch):
    gaussians, camera = small_scene()
    positions = reference.pixel_centers(camera.width, camera.height) + 0.2
    whole = rays.render(gaussians, camera, BACKGROUND, model, positions=positions)
    monkeypatch.setattr(rays, "MAX_PAIRS", 7)
    for region in (np.s_[:, :], np.s_[3:17, 5:9], np.s_[:, -4:], np.s_[7:8, 0:1], np.s_[5:5, :]):
        part = rays.render(gaussians, camera, BACKGROUND, model, region, positions)
        for name in ("image", "alpha", "depth", "transmittance", "near_threshold"):
            # Products of other batches of rows may be rounded differently.
            crop = getattr(whole, name)[region]
            np.testing.assert_allclose(getattr(part, name), crop, rtol=0, atol=1e-14)


@pytest.mark.parametrize("model", PROJECTIONS, ids=lambda model: model.projection)
def test_shifted_positions_are_a_shifted_principal_point(model):
    gaussians, camera = small_scene()
    gaussians = only(gaussians, np.arange(9))  # splat 9's slope is clamped, relative to the film
    shift = np.array([0.3, -5.7])
    positions = reference.pixel_centers(camera.width, camera.height) + shift
    moved = replace(camera, cx=camera.cx - shift[0], cy=camera.cy - shift[1])
    shifted = rays.render(gaussians, camera, BACKGROUND, model, positions=positions)
    expected = rays.render(gaussians, moved, BACKGROUND, model)
    assert_images_agree(shifted, expected, atol=1e-12)  # rounding of positions of 20 px
    unmoved = rays.render(gaussians, camera, BACKGROUND, model)
    assert np.abs(unmoved.image - shifted.image).max() > 0.1


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
@pytest.mark.parametrize("projection", ["ewa", "unscented", "exact"])
def test_culled_and_degenerate_gaussians_raise_no_warning_and_change_nothing(projection, low_pass):
    gaussians, camera = small_scene()
    both = with_invisible(gaussians, camera, point_logit=9.0 if low_pass == 0 else -1e3)
    model = ImageModel(projection, "pixel", low_pass=low_pass)
    with warnings.catch_warnings(), np.errstate(divide="raise", over="raise", invalid="raise"):
        warnings.simplefilter("error")
        rendered = rays.render(both, camera, BACKGROUND, model)
    alone = rays.render(gaussians, camera, BACKGROUND, model)
    # Batched matrix products may round differently in batches of another size.
    assert_images_agree(rendered, alone, atol=1e-13)


def test_image_without_gaussians_is_background():
    gaussians, camera = small_scene()
    for model in PROJECTIONS:
        rendered = rays.render(only(gaussians, []), camera, BACKGROUND, model)
        np.testing.assert_array_equal(rendered.image, np.broadcast_to(BACKGROUND, (20, 24, 3)))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"projection": "affine"}, "projection"),
        ({"order": "entry", "extent": 3.0}, "order 'entry' needs projection 'exact'"),
        ({"order": "entry", "projection": "exact"}, "and a finite extent"),
        ({"step": 1e-4}, "a step needs order 'entry'"),
        ({"low_pass": math.nan}, "low_pass"),
    ],
)
def test_unknown_choices_are_refused_by_name(fields, message):
    with pytest.raises(ValueError, match=message):
        ImageModel(**fields)


# ----------------------------------------------------------------------------------------------
# Orders, and pixels that are near a decision
# ----------------------------------------------------------------------------------------------


def straight_camera(focal=20.0) -> reference.Camera:
    """9 x 9 px, at the origin."""
    return reference.Camera(np.eye(3), np.zeros(3), focal, focal, 4.5, 4.5, 9, 9)


def test_splat_around_the_camera_is_invisible_in_entry_order():
    gaussians, camera = gaussians_at([0, 0, 1.0], 0.4), straight_camera()
    for extent, exists in [(2.4, True), (2.6, False)]:
        for order, alpha in [("entry", 0.5 * exists), ("pixel", 0.5)]:
            model = ImageModel("exact", order, extent=extent, low_pass=0.0)
            assert rays.render(gaussians, camera, model=model).alpha[4, 4] == alpha


def test_ties_are_composited_by_index():
    gaussians = gaussians_at(np.tile([0, 0, 2.0], (3, 1)), colors=np.eye(3))
    for model in (
        ImageModel("ewa", "pixel"),
        ImageModel("exact", "pixel"),
        ImageModel("exact", "entry", extent=3.0),
    ):
        rendered = rays.render(gaussians, straight_camera(), model=model)
        # The middle of the film is the middle of a pixel: G = 1.
        np.testing.assert_allclose(rendered.image[4, 4], [0.5, 0.25, 0.125], rtol=0, atol=1e-15)


@pytest.mark.parametrize(("relative", "is_marked"), MARKED_DISTANCES)
def test_pixels_near_a_decision_are_marked(relative, is_marked):
    camera = straight_camera(focal=10.0)

    # At (1, 0) px from the mean of a splat of 1 px^2: rho = 1.
    one = gaussians_at([0, 0, 1.0])
    model = ImageModel(extent=math.sqrt(1 / (1 + relative)), low_pass=0.0)
    cut = rays.render(one, camera, model=model)
    assert (cut.alpha[4, 5] > 0) == (relative < 0) and not cut.near_threshold[4, 4]

    two = gaussians_at([[0, 0, 2.0], [0, 0, 2.0 * (1 + relative)]])
    ordered, by_center = (
        rays.render(two, camera, model=ImageModel("exact", order)) for order in ("pixel", "center")
    )
    assert not by_center.near_threshold[4, 4]

    around = gaussians_at([0, 0, 1.0], 0.5 * (1 + relative))
    model = ImageModel("exact", "entry", extent=2.0, low_pass=0.0)
    entered = rays.render(around, camera, model=model)
    assert (entered.alpha[4, 4] > 0) == (relative < 0)

    marks = [cut.near_threshold[4, 5], ordered.near_threshold[4, 4], entered.near_threshold[4, 4]]
    assert marks == [is_marked] * 3


def test_ambiguous_order_is_found_among_all_splats():
    gaussians = gaussians_at([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 2.0 + 1e-7]])
    camera, model = straight_camera(), ImageModel("exact", "pixel")
    assert rays.render(gaussians, camera, model=model).near_threshold[4, 4]
    apart = replace(gaussians, means=[[0, 0, 2.0], [0, 0, 2.5], [0, 0, 3.0]])
    assert not rays.render(apart, camera, model=model).near_threshold[4, 4]


def test_splats_behind_the_stop_mark_no_pixels():
    """Two clamped splats finish the pixel; a third, of alpha 0.99, is before or behind them."""
    for third, marked in [(1.0, True), (4.0, False)]:
        opacities = np.array([0.9999, 0.9999, reference.ALPHA_MAX])
        gaussians = gaussians_at([[0, 0, 2.0], [0, 0, 3.0], [0, 0, third]], opacity=opacities)
        rendered = rays.render(gaussians, straight_camera(), model=ImageModel("exact", "pixel"))
        assert rendered.transmittance[4, 4] == 1 - reference.ALPHA_MAX
        assert rendered.near_threshold[4, 4] == marked, third


def test_disabled_cuts_mark_no_pixels():
    """An alpha that underflows to 0 is not near a cut of 0, nor T = 0 near a stop of 0."""
    gaussians = replace(gaussians_at([0, 0, 1], 1e-3), logit_opacities=[2.0])
    rendered = rays.render(gaussians, straight_camera(), model=replace(UNCUT, low_pass=0.0))
    assert rendered.alpha[0, 0] == 0 and not rendered.near_threshold.any()
