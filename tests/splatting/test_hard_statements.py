"""Hard inputs of which more can be said than that they are within the bound."""

from dataclasses import replace

import numpy as np
import pytest
from support.hard_cases import FAMILIES, PLANES, camera_for, cotangents_of, splats
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    Cotangents,
    both_precisions,
    image_planes,
    kernel_gradients,
    reference_gradients,
    render,
    single,
)

from drgs.reference import splatting as reference


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


@both_precisions
def test_a_quaternion_of_norm_zero_is_the_identity_and_has_no_gradient(precision):
    case = FAMILIES["quaternions of norm 0, 1e-20, 1e20 and negated"]
    zero = ~case.gaussians.quats.any(axis=1)
    assert zero.sum() >= 4
    gradients = kernel_gradients(case, precision, cotangents_of(case.name))
    assert not gradients["quats"][zero].any() and gradients["log_scales"][zero].any()


@both_precisions
def test_an_empty_view_is_the_background_and_has_no_gradient(precision):
    case = FAMILIES["no visible Gaussian"]
    _, frame = render(case, precision)
    rendered = image_planes(frame, case)
    assert (rendered["transmittance"] == 1).all() and not rendered["depth"].any()
    gradients = kernel_gradients(case, precision, cotangents_of(case.name))
    del gradients["background"]
    assert not any(value.any() for value in gradients.values())


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
