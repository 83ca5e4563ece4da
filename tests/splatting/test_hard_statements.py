"""Hard inputs of which more can be said than that they are within the bound."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from support.hard_cases import FAMILIES, PLANES, camera_for, cotangents_of, splats
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    Cotangents,
    both_precisions,
    device_camera,
    device_gaussians,
    image_planes,
    kernel_gradients,
    reference_gradients,
    render,
    rows,
    single,
)
from support.reference_scenes import needle

from drgs.reference import splatting as reference
from drgs.splatting.projection import compensated_opacity, load_rows, plain_opacity, project


def test_means_at_the_near_plane_are_drawn_and_nearer_ones_are_not():
    case = FAMILIES["means at, just before, just behind and far behind the near plane"]
    visible = [True, True, False, False, False, True] + [False] * 6
    assert (
        reference.project(case.gaussians, case.camera).visible[: len(visible)].tolist() == visible
    )
    for precision in (FLOAT64, FLOAT32):
        gradients = kernel_gradients(case, precision, cotangents_of(case.name))
        moved = np.abs(gradients["means"]).max(axis=1) > 0
        assert not (moved[: len(visible)] & ~np.array(visible)).any()
        assert moved[[0, 1]].any()


@pytest.mark.slow
@both_precisions
def test_million_gaussians_in_one_pixel_match_the_reference(precision):
    """The pixel stops after some 2,130 layers of alpha 1.1 / 255: the nearest 3,000 are all.

    The others are equally visible, but the pixel is finished: their gradient is zero.
    """
    count, near = 1_000_000, 3000
    rng = np.random.default_rng(0)
    camera = camera_for(20, 18)
    alpha = 1.2 / 255
    z = single(rng.permutation(count) * 2e-6 + 1)
    logit = np.log(alpha / (1 - alpha))
    gaussians = splats(rng, camera, np.full((count, 2), [9.6, 9.3]), z, 1e-4, logit, 0)
    first = np.sort(np.argsort(gaussians.means[:, 2], kind="stable")[:near])
    nearest = reference.Gaussians(*(value[first] for value in vars(gaussians).values()))
    case = Case("a million", 20, 18, 0, count=count, recipe=lambda *_: (gaussians, camera))
    small = replace(case, name="3,000 of a million", recipe=lambda *_: (nearest, camera))
    assert not small.rendered.near_threshold.any()
    assert 0.9e-4 < small.rendered.transmittance.min() < 1.1e-4
    cotangents = Cotangents.random(small)
    actual_image = image_planes(render(case, precision)[1], case)
    actual = kernel_gradients(case, precision, cotangents)
    wanted = reference_gradients(small, cotangents)
    # sqrt(2,130 layers) roundings, with lambda = 6, of sums that cancel: 1e-16 and 2e-5.
    tolerance = {FLOAT64: 1e-11, FLOAT32: 5e-5}[precision]
    for plane in PLANES:
        values = getattr(small.rendered, plane)
        assert np.abs(actual_image[plane] - values).max() <= tolerance * np.abs(values).max()
    rest = np.delete(np.arange(count), first)
    for key in ("means", "log_scales", "logit_opacities", "sh0"):
        assert not actual[key][rest].any(), key
        error = np.abs(actual[key][first] - wanted[key]).max()
        assert error <= tolerance * np.abs(wanted[key]).max(), key


@both_precisions
def test_a_colour_of_zero_keeps_its_gradient(precision):
    """The weight of the pixel, opacity 0.5, times the basis function."""
    camera = camera_for(17, 13)
    gaussians = splats(np.random.default_rng(0), camera, [[8.5, 6.5]], 2.0, 0.3, 0.0, 0)
    # The sum is exactly 0 in both precisions.
    gaussians.sh0[:] = -0.5 / float(precision.dtype(reference.C_00))
    case = Case("black", 17, 13, 0, recipe=lambda *_: (gaussians, camera))
    weights = Cotangents(np.zeros((13, 17, 3)), np.zeros((13, 17)), np.zeros((13, 17)))
    weights.d_image[6, 8] = [1.0, 0.5, 0.25]
    expected = 0.5 * reference.C_00 * np.array([1.0, 0.5, 0.25])
    gradient = kernel_gradients(case, precision, weights)["sh0"][0, 0]
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)


@both_precisions
def test_a_splat_without_area_is_invisible_when_compensated(precision):
    gaussians, camera = needle([0.0, -80.0, -80.0])
    camera = device_camera(camera, precision)
    parameter_rows = load_rows(device_gaussians(gaussians, precision), 0)
    assert project(parameter_rows, camera, 0, plain_opacity).visible[0]
    dr.enable_grad(parameter_rows)
    splats_2d = project(parameter_rows, camera, 0, compensated_opacity)
    assert not splats_2d.visible[0] and splats_2d.opacities[0] == 0
    dr.backward(splats_2d.opacities)
    assert not rows(dr.grad(parameter_rows.log_scales)).any()
