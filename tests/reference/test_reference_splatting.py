"""The float64 reference of splatting: central differences, decisions, hard input."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from support.helpers import assert_arrays_agree
from support.reference_scenes import (
    BACKGROUND,
    MARKED_DISTANCES,
    PARAMETERS,
    cotangents,
    needle,
    numeric_gradients,
    only,
    small_scene,
    with_invisible,
)

from drgs.reference import splatting as reference
from drgs.reference.splatting import Gaussians

# The difference quotient is off by STEP^2 / 6 times the third derivative, which at 100 per world
# unit is 2e-9 of the derivative, and by rounding, 1e-16 / STEP = 1e-10 a pixel. Measured:
# below 1e-8 of the largest gradient of an array.
TOLERANCE = 1e-7


@pytest.mark.slow
@pytest.mark.parametrize(("antialiased", "sh_degree"), [(True, 3), (False, 1)])
def test_gradients_equal_central_differences(antialiased, sh_degree):
    gaussians, camera = small_scene()
    clear = reference.render(gaussians, camera, antialiased=antialiased, threshold_width=5e-4)
    assert not clear.near_threshold.any()

    def outputs(background, **fields):
        rendered = reference.render(Gaussians(**fields), camera, background, sh_degree, antialiased)
        return rendered.image, rendered.alpha, rendered.depth

    weights = cotangents()
    parameters = {name: getattr(gaussians, name) for name in PARAMETERS}
    parameters["background"] = BACKGROUND
    expected = numeric_gradients(outputs, list(weights.values()), parameters)
    actual = reference.render_gradients(
        gaussians, camera, BACKGROUND, **weights, sh_degree=sh_degree, antialiased=antialiased
    )
    assert_arrays_agree({name: actual[name] for name in expected}, expected, TOLERANCE)
    for name in (*PARAMETERS, "means2d"):
        assert not actual[name][10:].any(), f"{name}: culled rows must get zero"
    assert not actual["shN"][:, (sh_degree + 1) ** 2 - 1 :].any()


def composite(opacities, depths, offset=0.0, colors=None) -> reference.RenderedImage:
    """Splats of 1 px^2, stacked on the middle pixel of a 9 x 9 film; white by default."""
    n = len(opacities)
    splats = reference.Projection(
        means2d=np.tile([4.5 - offset, 4.5], (n, 1)),
        cov2d=np.tile(np.eye(2), (n, 1, 1)),
        conics=np.tile(np.eye(2), (n, 1, 1)),
        depths=np.array(depths),
        opacities=np.array(opacities),
        visible=np.ones(n, dtype=bool),
    )
    colors = np.ones((n, 3)) if colors is None else colors
    return reference.composite(splats, colors, np.zeros(3), 9, 9)


def test_a_hundred_ties_are_composited_by_index():
    """Enough of them that a sort which is not stable would reorder them."""
    opacities, depths = np.linspace(0.01, 0.06, 100), np.tile([2.0, 1.0], 50)
    order = [*range(1, 100, 2), *range(0, 100, 2)]
    transmittances = np.cumprod([1.0, *(1 - opacities[order])])[:-1]
    rendered = composite(opacities, depths, colors=np.arange(100.0)[:, None] * np.ones(3))
    expected = np.sum(transmittances * opacities[order] * order)
    np.testing.assert_allclose(rendered.image[4, 4], expected, rtol=1e-13)


def test_second_clamped_splat_stops_the_pixel_as_in_single_precision():
    one = np.float32(1)
    behind = one * (one - np.float32(0.99)) * (one - np.float32(0.99))
    assert behind < np.float32(1e-4) and 0.01 * 0.01 >= 1e-4
    rendered = composite([0.999, 0.999], [1.0, 2.0])
    assert rendered.transmittance[4, 4] == 1 - float(np.float32(0.99))
    assert not rendered.near_threshold[4, 4]


@pytest.mark.parametrize(("relative", "is_marked"), MARKED_DISTANCES)
def test_pixels_near_a_threshold_are_marked(relative, is_marked):
    # At 1/255 the splat's centre is half a pixel away: the opacity itself is above the cut.
    cut = composite([(1 + relative) / 255 * math.exp(0.125)], [1.0], offset=0.5)
    clamp = composite([0.99 * (1 + relative)], [1.0])
    stop = composite([0.95, 0.95, 1 - 1e-4 * (1 + relative) / 0.05**2], [1.0, 2.0, 3.0])
    for rendered in (cut, clamp, stop):
        assert rendered.near_threshold[4, 4] == is_marked
    assert (stop.transmittance[4, 4] < 2e-4) == (relative > 0)


def test_zero_quaternion_is_the_identity_and_has_no_gradient():
    np.testing.assert_array_equal(reference.quat_to_rotation(np.zeros((1, 4)))[0], np.eye(3))
    gaussians, camera = small_scene()
    quats = gaussians.quats.copy()
    quats[0] = 0
    changed = Gaussians(**{**vars(gaussians), "quats": quats})
    gradients = reference.render_gradients(changed, camera, BACKGROUND, **cotangents())
    assert not gradients["quats"][0].any() and gradients["quats"][1].any()
    assert all(np.isfinite(gradient).all() for gradient in gradients.values())


def test_needle_keeps_its_determinant():
    """cov2d = l^2 v v^T + 0.3 I, v at 45 degrees; entries of 1e14 would cancel to 1e-2."""
    gaussians, camera = needle(np.log([1e7, 1e-7, 1e-7]))
    conic = reference.project(gaussians, camera).conics[0]
    half, det = 0.5e14, 0.3 * (1e14 + 0.3) + 1.0
    np.testing.assert_allclose(conic, np.array([[half, -half], [-half, half]]) / det, rtol=1e-13)
    opacity = reference.project(gaussians, camera, antialiased=True).opacities[0]
    assert opacity == pytest.approx(1 / (1 + math.exp(-3)) * math.sqrt(1 / det), rel=1e-9)


@pytest.mark.parametrize("antialiased", [False, True])
def test_culled_and_degenerate_gaussians_raise_no_warning_and_change_nothing(antialiased):
    gaussians, camera = small_scene()
    weights = {**cotangents(), "antialiased": antialiased}

    def outputs(gaussians):
        rendered = reference.render(gaussians, camera, BACKGROUND, antialiased=antialiased)
        return rendered, reference.render_gradients(gaussians, camera, BACKGROUND, **weights)

    with warnings.catch_warnings(), np.errstate(divide="raise", over="raise", invalid="raise"):
        warnings.simplefilter("error")
        rendered, gradients = outputs(with_invisible(gaussians, camera))
    expected, alone = outputs(gaussians)
    np.testing.assert_array_equal(rendered.image, expected.image)
    for name in (*PARAMETERS, "means2d"):
        # Batched matrix products may round differently in batches of another size.
        np.testing.assert_allclose(gradients[name][:12], alone[name], rtol=1e-12, atol=1e-12)
        assert not gradients[name][12:].any(), name


def test_image_without_gaussians_is_background():
    gaussians, camera = small_scene()
    gradients = reference.render_gradients(only(gaussians, []), camera, BACKGROUND, **cotangents())
    assert gradients["shN"].shape == (0, 15, 3)
    expected = cotangents()["d_image"].sum(axis=(0, 1))
    np.testing.assert_allclose(gradients["background"], expected, rtol=1e-12)
    rendered = reference.render(only(gaussians, []), camera, BACKGROUND)
    np.testing.assert_array_equal(rendered.image, np.broadcast_to(BACKGROUND, (20, 24, 3)))
