"""Each approximation's alternative against scalar loops, textbook formulas and limits."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from support.reference_loops import (
    UNCUT,
    assert_images_agree,
    naive_basis,
    naive_color,
    naive_image,
    naive_splat,
    only,
    scene_of,
    straight_camera,
)
from support.reference_scenes import (
    BACKGROUND,
    PARAMETERS,
    small_camera,
    small_scene,
)

from drgs.reference import rays
from drgs.reference import splatting as reference
from drgs.reference.rays import ImageModel
from drgs.reference.splatting import Gaussians

# The loop inverts covariances of condition 25 and takes differences of squared distances from the
# camera, up to 40^2: rho^2 is off by up to 1e-16 * 25 * 40^2 = 4e-12. Measured: 8e-14.
LOOP_ROUNDING = 1e-11


# ----------------------------------------------------------------------------------------------
# Small scenes
# ----------------------------------------------------------------------------------------------


def joined(first, second) -> Gaussians:
    fields = {
        name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in PARAMETERS
    }
    return Gaussians(**fields)


# ----------------------------------------------------------------------------------------------
# The whole image
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_degree", [None, 1])
def test_default_model_matches_the_reference(antialiased, sh_degree):
    gaussians, camera = small_scene()
    model = ImageModel(antialiased=antialiased, sh_degree=sh_degree)
    # Wide enough that the scene, which keeps 5e-4 clear of thresholds, has marked pixels.
    width = 0.01
    expected = reference.render(gaussians, camera, BACKGROUND, sh_degree, antialiased, width)
    rendered = rays.render(gaussians, camera, BACKGROUND, model, threshold_width=width)
    # Rounding only: C is inverted in another order of operations. Measured 1e-15.
    assert_images_agree(rendered, expected, atol=1e-13)
    np.testing.assert_array_equal(rendered.alpha, 1 - rendered.transmittance)
    assert expected.near_threshold.any() and not expected.near_threshold.all()
    np.testing.assert_array_equal(rendered.near_threshold, expected.near_threshold)


@pytest.mark.slow
@pytest.mark.parametrize(
    "model",
    [
        ImageModel("ewa", "pixel"),
        ImageModel("unscented", "center"),
        ImageModel("unscented", "pixel", antialiased=True),
        ImageModel("exact", "center", antialiased=True),
        ImageModel("exact", "pixel", low_pass=0.0),
        ImageModel("exact", "pixel", "pixel"),
        ImageModel("exact", "entry", "pixel", extent=3.0, low_pass=0.0),
        ImageModel("exact", "entry", extent=2.0),
        ImageModel("ewa", "center", "pixel", sh_degree=2),
    ],
    ids=lambda m: f"{m.projection}-{m.order}-{m.sh_direction}-{m.low_pass}-{m.antialiased}",
)
def test_image_equals_a_loop_over_pixels(model):
    gaussians, camera = small_scene()
    expected = naive_image(gaussians, camera, model)
    rendered = rays.render(gaussians, camera, BACKGROUND, model)
    assert_images_agree(rendered, expected, LOOP_ROUNDING)
    # The choice is seen: another model's image is not this one.
    assert (
        np.abs(rendered.image - reference.render(gaussians, camera, BACKGROUND).image).max() > 0.01
    )


@pytest.mark.slow
@pytest.mark.parametrize("projection", ["ewa", "unscented", "exact"])
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"alpha_max": 0.6},
        {"alpha_cut": 0.1},
        {"transmittance_stop": 0.2},
        {"extent": 1.2},
        {"low_pass": 0.0},
        {"low_pass": 2.0},
        {"antialiased": True},
        {"sh_degree": 0},
    ],
    ids=str,
)
def test_each_choice_changes_the_image_as_documented(projection, change):
    """And nothing else, as the loop has the same choices."""
    gaussians, camera = small_scene()
    uncut = replace(UNCUT, projection=projection)
    model = replace(uncut, **change)
    rendered = rays.render(gaussians, camera, BACKGROUND, model)
    assert_images_agree(rendered, naive_image(gaussians, camera, model), LOOP_ROUNDING)
    difference = np.abs(rendered.image - rays.render(gaussians, camera, BACKGROUND, uncut).image)
    assert (difference.max() > 1e-3) == bool(change)


@pytest.mark.parametrize("projection", ["ewa", "exact"])
def test_without_cuts_every_splat_is_composited(projection):
    """C = sum_i c_i alpha_i prod_{j < i} (1 - alpha_j), over all splats at all pixels."""
    gaussians, camera = small_scene()
    model = replace(UNCUT, projection=projection)
    rendered = rays.render(gaussians, camera, BACKGROUND, model)
    depths = (gaussians.means - camera.center) @ camera.rotation[2]
    order = [n for n in np.argsort(depths) if depths[n] >= camera.near]
    assert len(order) == 11
    splats = [naive_splat(gaussians, camera, n, model) for n in order]
    bases = [naive_basis(gaussians, camera, model, n=n) for n in order]
    colors = np.array([naive_color(gaussians, *pair) for pair in zip(order, bases, strict=True)])
    for row, column in np.ndindex(camera.height, camera.width):
        hits = [splat(np.array([column + 0.5, row + 0.5])) for splat in splats]
        alphas = np.array([hit[0] if hit else 0.0 for hit in hits])
        weights = [alphas[i] * np.prod(1 - alphas[:i]) for i in range(len(order))]
        expected = weights @ colors + np.prod(1 - alphas) * BACKGROUND
        np.testing.assert_allclose(rendered.image[row, column], expected, atol=LOOP_ROUNDING)


def test_opaque_splat_without_a_clamp_has_zero_transmittance():
    gaussians = replace(scene_of([[0, 0, 1]], np.log(0.1)), logit_opacities=[50.0])
    assert rays.render(gaussians, straight_camera(), model=UNCUT).transmittance[4, 4] == 0.0


# ----------------------------------------------------------------------------------------------
# Colour
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_color_of_a_pixel_uses_its_ray_direction(degree):
    """One splat over a wide film; some of its colours are clamped to zero."""
    gaussians, camera = small_scene()
    gaussians = replace(only(gaussians, [5]), shN=only(gaussians, [5]).shN * 4)
    model = replace(UNCUT, sh_direction="pixel", sh_degree=degree)
    rendered = rays.render(gaussians, camera, model=model)
    colors = np.zeros((20, 24, 3))
    for row, column in np.ndindex(20, 24):
        position = (column + 0.5, row + 0.5)
        basis = naive_basis(gaussians, camera, model, position)
        colors[row, column] = naive_color(gaussians, 0, basis)
    np.testing.assert_allclose(
        rendered.image, rendered.alpha[..., None] * colors, rtol=0, atol=1e-14
    )  # rounding
    if degree == 3:
        assert (colors == 0).any() and (colors > 0).any()


# ----------------------------------------------------------------------------------------------
# Regions and positions
# ----------------------------------------------------------------------------------------------


MODELS = [
    ImageModel(),
    ImageModel("unscented", "pixel", extent=3.0),
    ImageModel("exact", "entry", "pixel", extent=3.0),
]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.projection)
def test_region_is_the_crop_of_the_whole(model):
    gaussians, camera = small_scene()
    positions = rays.pixel_centers(camera) + 0.2
    whole = rays.render(gaussians, camera, BACKGROUND, model, positions=positions)
    regions = [
        (slice(3, 17), slice(5, 9)),
        (slice(None), slice(-4, None)),
        (slice(7, 8), slice(0, 1)),
        (slice(5, 5), slice(None)),
    ]
    for region in regions:
        part = rays.render(gaussians, camera, BACKGROUND, model, region, positions)
        for name in ("image", "alpha", "depth", "transmittance", "near_threshold"):
            # Products of other batches of rows may be rounded differently.
            np.testing.assert_allclose(
                getattr(part, name), getattr(whole, name)[region], rtol=0, atol=1e-14
            )


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.projection)
def test_image_does_not_depend_on_tiling(model, monkeypatch):
    gaussians, camera = small_scene()
    expected = rays.render(gaussians, camera, BACKGROUND, model)
    monkeypatch.setattr(rays, "MAX_PAIRS", 7)
    divided = rays.render(gaussians, camera, BACKGROUND, model)
    # Products of other batches of rows may be rounded differently.
    assert_images_agree(divided, expected, atol=1e-14)
    np.testing.assert_array_equal(divided.near_threshold, expected.near_threshold)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.projection)
def test_shifted_positions_are_a_shifted_principal_point(model):
    gaussians, camera = small_scene()
    gaussians = only(gaussians, np.arange(9))  # splat 9's slope is clamped, relative to the film
    shift = np.array([0.3, -5.7])
    positions = rays.pixel_centers(camera) + shift
    moved = replace(camera, cx=camera.cx - shift[0], cy=camera.cy - shift[1])
    shifted = rays.render(gaussians, camera, BACKGROUND, model, positions=positions)
    expected = rays.render(gaussians, moved, BACKGROUND, model)
    assert_images_agree(shifted, expected, atol=1e-12)  # rounding of positions of 20 px
    unmoved = rays.render(gaussians, camera, BACKGROUND, model)
    assert np.abs(unmoved.image - shifted.image).max() > 0.1


# ----------------------------------------------------------------------------------------------
# Degenerate and wrong input
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
@pytest.mark.parametrize("projection", ["ewa", "unscented", "exact"])
def test_culled_and_degenerate_gaussians_raise_no_warning_and_change_nothing(projection, low_pass):
    """Behind the camera, on its plane, transparent; and in front: points without extent."""
    gaussians, camera = small_scene()
    points = np.array([[0, 0, -1], [1e3, 0, 0], [0, 0, 0], [0.1, 0, 2], [0.1, 0, 2]])
    strange = Gaussians(
        means=points @ camera.rotation + camera.center,
        quats=np.zeros((5, 4)),
        log_scales=np.repeat([80.0, 1.0, -np.inf, 0.0, -np.inf], 3).reshape(5, 3),
        logit_opacities=[9.0, 9.0, 9.0, -1e3, 9.0 if low_pass == 0 else -1e3],
        sh0=np.ones((5, 1, 3)),
        shN=np.ones((5, 15, 3)),
    )
    model = ImageModel(projection, "pixel", low_pass=low_pass)
    with warnings.catch_warnings(), np.errstate(divide="raise", over="raise", invalid="raise"):
        warnings.simplefilter("error")
        rendered = rays.render(joined(gaussians, strange), camera, BACKGROUND, model)
    alone = rays.render(gaussians, camera, BACKGROUND, model)
    # Batched matrix products may round differently in batches of another size.
    assert_images_agree(rendered, alone, atol=1e-13)


def test_point_gaussian_renders_as_the_low_pass():
    """In every projection: a round splat of 0.3 px^2."""
    gaussians, camera = scene_of([[0, 0, 1.0]], -np.inf), straight_camera()
    squares = (np.arange(9) - 4.0) ** 2
    expected = 0.5 * np.exp(-(squares[:, None] + squares) / 0.6)
    for projection in ("ewa", "unscented", "exact"):
        rendered = rays.render(gaussians, camera, model=replace(UNCUT, projection=projection))
        np.testing.assert_allclose(rendered.alpha, expected, rtol=0, atol=1e-15)


def test_image_without_gaussians_is_background():
    camera = small_camera()
    empty = only(small_scene()[0], [])
    for model in MODELS:
        rendered = rays.render(empty, camera, BACKGROUND, model)
        np.testing.assert_array_equal(rendered.image, np.broadcast_to(BACKGROUND, (20, 24, 3)))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"projection": "affine"}, "projection"),
        ({"order": "depth"}, "order"),
        ({"sh_direction": "ray"}, "sh_direction"),
        ({"stop": "never"}, "stop"),
        ({"order": "entry", "extent": 3.0}, "order 'entry' needs projection 'exact'"),
        ({"order": "entry", "projection": "exact"}, "and a finite extent"),
        ({"step": 1e-4}, "a step needs order 'entry'"),
        ({"alpha_max": 1.5}, "alpha_max"),
        ({"alpha_cut": -0.1}, "alpha_cut"),
        ({"transmittance_stop": 1.0}, "transmittance_stop"),
        ({"step": -1.0}, "step"),
        ({"extent": 0.0}, "extent"),
        ({"low_pass": math.nan}, "low_pass"),
    ],
)
def test_unknown_choices_are_refused_by_name(fields, message):
    with pytest.raises(ValueError, match=message):
        ImageModel(**fields)
