"""Isolated splats as drawn by drgs and by Mitsuba's own ``volprim_rf_basic``.

The two do not compute the same. drgs projects a Gaussian with the affine approximation at its mean
(EWA), adds a low-pass, takes its colour in the direction of the mean, draws nothing below
ALPHA_CUT and orders by the depth of the means. volprim takes the Gaussian's peak along each pixel's
ray and the colour in the ray's direction, and orders by where the ray enters the splats' shells: in
these scenes the same order. What this makes of the images is subtracted, and only rounding is left.

In camera axes let u = (x/z, y/z) be the slope of a pixel's ray, u0 that of the mean, d = u - u0, z
the mean's depth, S the covariance, and A(u) = [I | -u], the 2x3 projection along the ray onto a
plane parallel to the film. With C(u) = A(u) S A(u)^T / z^2,

    volprim: alpha = o exp(-d^T C(u)^-1 d / 2)        EWA: alpha = o exp(-d^T C(u0)^-1 d / 2)

since the Mahalanobis distance of a point from a line is that of their projections along the line.
The low-pass is undone by giving volprim the Gaussian widened in the directions parallel to the
film: C(u0) then is drgs's covariance on the film.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.volprim import (
    LONG,
    SCENES,
    TWO,
    Splats,
    assert_within,
    axes_of,
    covariances,
    drgs_image,
    footprints,
    opacities_of,
    propagated,
    volprim_image,
    widened,
)

import drgs  # noqa: F401  (registers the plugin)
from drgs.core.constants import ALPHA_CUT
from drgs.reference import splatting as reference


def check_difference(splats, change=None, covariance_of=widened):
    """Check volprim's image less that of drgs; ``change`` is made to drgs's Gaussians."""
    gaussians, view = splats.gaussians, splats.view
    covariance = covariance_of(gaussians, view.camera)
    changed = gaussians if change is None else change(gaussians, view.camera)
    difference = volprim_image(gaussians, view, *axes_of(covariance)) - drgs_image(changed, view)

    on_film = footprints(gaussians, view.camera, covariance)
    depths = (gaussians.means - view.camera.center) @ view.camera.rotation[2]
    drawn = np.where(on_film.alpha_by_mean >= ALPHA_CUT, on_film.alpha_by_mean, 0)
    colors = np.broadcast_to(on_film.color_by_mean, on_film.color_by_ray.shape)
    derived = composite(on_film.alpha_by_ray, on_film.color_by_ray, depths)
    derived -= composite(drawn, colors, depths)
    d_alpha = on_film.alpha_rounding + np.where(on_film.near_cut, on_film.alpha_by_mean, 0)
    assert_within(difference - derived, propagated(on_film, d_alpha, on_film.color_rounding))


def composite(alphas, colors, depths) -> np.ndarray:
    """(H, W, 3) from alphas (N, H, W) and colours (N, H, W, 3), front to back."""
    image, transmittance = np.zeros(colors.shape[1:]), np.ones(alphas.shape[1:])
    for i in np.argsort(depths):
        image += (transmittance * alphas[i])[..., None] * colors[i]
        transmittance *= 1 - alphas[i]
    return image


@pytest.mark.parametrize("splats", SCENES.values(), ids=SCENES.keys())
def test_difference_from_volprim_is_the_derived_one(splats):
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


@pytest.mark.parametrize("name", WRONG)
def test_wrong_splats_violate_the_difference(name):
    with pytest.raises(AssertionError, match="worst at"):
        check_difference(*WRONG[name])


def test_splats_without_the_low_pass_violate_the_difference():
    with pytest.raises(AssertionError, match="worst at"):
        check_difference(SMALL, covariance_of=lambda gaussians, _: covariances(gaussians))
