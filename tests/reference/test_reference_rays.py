"""Each approximation's alternative against scalar loops, textbook formulas and limits."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from support.reference_loops import UNCUT, assert_images_agree, naive_image
from support.reference_scenes import BACKGROUND, only, small_scene, with_invisible

from drgs.reference import rays
from drgs.reference import splatting as reference
from drgs.reference.rays import ImageModel

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
    ImageModel("unscented"),
    ImageModel("unscented", "pixel", antialiased=True),
    ImageModel("exact", antialiased=True),
    ImageModel("exact", "pixel", low_pass=0.0),
    ImageModel("exact", "pixel", "pixel"),
    ImageModel("exact", "entry", "pixel", extent=3.0, low_pass=0.0),
    ImageModel("exact", "entry", stop="after", transmittance_stop=0.2, extent=2.0, step=0.3),
    ImageModel("ewa", "center", "pixel", sh_degree=2),
    *(
        replace(UNCUT, projection=projection, **change)
        for projection in ("ewa", "unscented", "exact")
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


def test_each_choice_changes_the_image():
    gaussians, camera = small_scene()
    images = {rays.render(gaussians, camera, model=model).image.tobytes() for model in MODELS}
    assert len(images) == len(MODELS)


PROJECTIONS = [
    ImageModel(),
    ImageModel("unscented", "pixel", extent=3.0),
    ImageModel("exact", "entry", "pixel", extent=3.0),
]


@pytest.mark.parametrize("model", PROJECTIONS, ids=lambda model: model.projection)
def test_regions_of_any_tiling_are_crops_of_the_whole(model, monkeypatch):
    gaussians, camera = small_scene()
    positions = rays.pixel_centers(camera) + 0.2
    whole = rays.render(gaussians, camera, BACKGROUND, model, positions=positions)
    monkeypatch.setattr(rays, "MAX_PAIRS", 7)
    for region in (np.s_[:, :], np.s_[3:17, 5:9], np.s_[:, -4:], np.s_[7:8, 0:1], np.s_[5:5, :]):
        part = rays.render(gaussians, camera, BACKGROUND, model, region, positions)
        for name, values in vars(whole).items():
            # Products of other batches of rows may be rounded differently.
            np.testing.assert_allclose(getattr(part, name), values[region], rtol=0, atol=1e-14)


@pytest.mark.parametrize("model", PROJECTIONS, ids=lambda model: model.projection)
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
