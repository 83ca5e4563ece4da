"""Scenes that the bound between drgs and ``volprim_rf_basic`` refuses."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.volprim import (
    LONG,
    SCENES,
    TWO,
    Splats,
    assert_within,
    axes_of,
    bound,
    covariances,
    drgs_image,
    opacities_of,
    volprim_image,
    widened,
)

import drgs  # noqa: F401  (registers the plugin)
from drgs.reference import splatting as reference


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


SMALL = Splats(angle=0.005, sizes=LONG)


COLORED = SCENES["degree 3"]


def conjugated(gaussians, camera):
    return replace(gaussians, quats=gaussians.quats * [1, -1, -1, -1])


def with_quats_read_as_xyzw(gaussians, camera):
    return replace(gaussians, quats=gaussians.quats[:, [3, 0, 1, 2]])


def with_axes_exchanged(gaussians, camera):
    return replace(gaussians, log_scales=gaussians.log_scales[:, [1, 0, 2]])


def widened_by_two_percent(gaussians, camera):
    return replace(gaussians, log_scales=gaussians.log_scales + 0.02)


def shifted_by_a_tenth_of_a_pixel(gaussians, camera):
    z = (gaussians.means - camera.center) @ camera.rotation[2]
    shift = 0.1 * z[:, None] / camera.fx * camera.rotation[0]
    return replace(gaussians, means=gaussians.means + shift)


def more_opaque_by_half_a_percent(gaussians, camera):
    opacities = 1.005 * opacities_of(gaussians)
    return replace(gaussians, logit_opacities=np.log(opacities / (1 - opacities)))


def brighter_by_a_thousandth(gaussians, camera):
    return replace(gaussians, sh0=gaussians.sh0 + 0.001 / reference.C_00)


def with_swapped_depths(gaussians, camera):
    """The first splat in the second's place in depth, the image of each unchanged."""
    factors = np.array([4.0, 1.0])
    means = camera.center + (gaussians.means - camera.center) * factors[:, None]
    scales = gaussians.log_scales + np.log(factors)[:, None]
    return replace(gaussians, means=means, log_scales=scales)


def seen_from_behind(gaussians, camera):
    odd = np.repeat([-1, 1, -1], [3, 5, 7])[:, None]
    return replace(gaussians, shN=gaussians.shN * odd)


def with_coefficients_in_another_order(gaussians, camera):
    return replace(gaussians, shN=gaussians.shN.transpose(0, 2, 1).reshape(gaussians.shN.shape))


WRONG_SPLATS = (
    (SMALL, conjugated),
    (SMALL, with_quats_read_as_xyzw),
    (SMALL, with_axes_exchanged),
    (SMALL, widened_by_two_percent),
    (SMALL, shifted_by_a_tenth_of_a_pixel),
    (SMALL, more_opaque_by_half_a_percent),
    (SMALL, brighter_by_a_thousandth),
    (TWO, with_swapped_depths),
    (COLORED, seen_from_behind),
    (COLORED, with_coefficients_in_another_order),
)


@pytest.mark.parametrize(
    "splats, wrong", WRONG_SPLATS, ids=[wrong.__name__ for _, wrong in WRONG_SPLATS]
)
def test_bound_rejects_wrong_splats(splats, wrong):
    gaussians, view = splats.gaussians, splats.view
    covariance = widened(gaussians, view.camera)
    expected = volprim_image(gaussians, view, *axes_of(covariance))
    difference = expected - drgs_image(wrong(gaussians, view.camera), view)
    with pytest.raises(AssertionError, match="worst at"):
        assert_within(difference, bound(gaussians, view.camera, covariance))


def test_bound_rejects_splats_without_the_low_pass():
    gaussians, view = SMALL.gaussians, SMALL.view
    covariance = covariances(gaussians)
    difference = volprim_image(gaussians, view, *axes_of(covariance)) - drgs_image(gaussians, view)
    with pytest.raises(AssertionError, match="worst at"):
        assert_within(difference, bound(gaussians, view.camera, covariance))
