"""Isolated splats as drawn by drgs and by Mitsuba's own ``volprim_rf_basic``.

With the right approximations the two compute the same: a Gaussian's peak along each pixel's ray and
the colour in the ray's direction, with no low-pass and no cut. volprim orders by where the ray
enters the splats' shells: in these scenes the same order. Only rounding is left.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.views import image_of, tensors
from support.volprim import (
    LONG,
    SCENES,
    TWO,
    Splats,
    assert_within,
    footprints,
    opacities_of,
    volprim_image,
)

import drgs  # noqa: F401  (registers the plugin)
from drgs.reference import splatting as reference

SPLATS = {
    "type": "splats", "srgb_primitives": False, "projection": "exact", "order": "pixel",
    "sh_direction": "pixel", "low_pass": 0.0, "extent": 6.0, "alpha_max": 0.9999, "alpha_cut": 0.0,
    "transmittance_stop": 0.0,
}  # fmt: skip


def check_difference(splats, change=lambda gaussians, _: gaussians, **settings):
    """Check volprim's image less that of drgs, by a shape and by tensors; ``change`` is made to
    drgs's Gaussians."""
    gaussians, view = splats.gaussians, splats.view

    def by_shape(gaussians, *integrator):
        quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
        scales = np.exp(gaussians.log_scales)
        return volprim_image(gaussians, view, scales, quats[:, [1, 2, 3, 0]], *integrator)

    changed, integrator = change(gaussians, view.camera), SPLATS | settings
    sensor = view.sensor(pixel_format="rgb")
    by_tensors = mi.load_dict(
        {"type": "scene", "integrator": integrator | tensors(changed), "sensor": sensor}
    )
    allowed, expected = footprints(gaussians, view.camera).image_rounding, by_shape(gaussians)
    assert expected.max() > 1000 * allowed.max()
    for image in (by_shape(changed, integrator), image_of(by_tensors)):
        assert_within(image - expected, allowed)


@pytest.mark.parametrize("splats", SCENES.values(), ids=SCENES.keys())
def test_images_equal_those_of_volprim(splats):
    check_difference(splats)


SMALL, COLORED = Splats(angle=0.005, sizes=LONG), SCENES["degree 3"]


def shifted(gaussians, camera):
    z = (gaussians.means - camera.center) @ camera.rotation[2]
    shift = 0.1 * z[:, None] / camera.fx * camera.rotation[0]
    return replace(gaussians, means=gaussians.means + shift)


def more_opaque(gaussians, _):
    opacities = 1.005 * opacities_of(gaussians)
    return replace(gaussians, logit_opacities=np.log(opacities / (1 - opacities)))


def with_swapped_depths(gaussians, camera):
    """The first splat in the second's place in depth, the image of each unchanged."""
    factors = np.array([4.0, 1.0])
    means = camera.center + (gaussians.means - camera.center) * factors[:, None]
    scales = gaussians.log_scales + np.log(factors)[:, None]
    return replace(gaussians, means=means, log_scales=scales)


def in_another_order(sh):
    return sh.transpose(0, 2, 1).reshape(sh.shape)


ODD = np.repeat([-1, 1, -1], [3, 5, 7])[:, None]
"""Signs of the harmonics of degrees 1 to 3, seen from behind."""

WRONG = {
    "conjugated": (SMALL, lambda g, _: replace(g, quats=g.quats * [1, -1, -1, -1])),
    "quats read as xyzw": (SMALL, lambda g, _: replace(g, quats=g.quats[:, [3, 0, 1, 2]])),
    "axes exchanged": (SMALL, lambda g, _: replace(g, log_scales=g.log_scales[:, [1, 0, 2]])),
    "wider by two percent": (SMALL, lambda g, _: replace(g, log_scales=g.log_scales + 0.02)),
    "shifted by a tenth of a pixel": (SMALL, shifted),
    "more opaque by half a percent": (SMALL, more_opaque),
    "brighter by 0.001": (SMALL, lambda g, _: replace(g, sh0=g.sh0 + 0.001 / reference.C_00)),
    "depths swapped": (TWO, with_swapped_depths),
    "seen from behind": (COLORED, lambda g, _: replace(g, shN=g.shN * ODD)),
    "harmonics exchanged": (COLORED, lambda g, _: replace(g, shN=in_another_order(g.shN))),
}


APPROXIMATIONS = {"low-pass": {"low_pass": 0.3}, "projected at the mean": {"projection": "ewa"}}


@pytest.mark.parametrize("name", [*WRONG, *APPROXIMATIONS])
def test_wrong_splats_and_approximations_differ_from_volprim(name):
    with pytest.raises(AssertionError, match="worst at"):
        check_difference(*WRONG.get(name, (SMALL,)), **APPROXIMATIONS.get(name, {}))
