"""Isolated splats as drawn by drgs and by Mitsuba's own ``volprim_rf_basic``.

The two do not compute the same. drgs projects a Gaussian with the affine approximation at its mean
(EWA) and adds a low-pass; volprim takes the Gaussian's peak along each pixel's ray. How far this
sets the images apart is derived here, and nothing else may.

**Opacity.** In camera axes let u = (x/z, y/z) be the slope of a pixel's ray, u0 that of the mean,
d = u - u0, z the mean's depth, S the covariance, and A(u) = [I | -u], the 2x3 projection along the
ray onto a plane parallel to the film. With C(u) = A(u) S A(u)^T / z^2,

    volprim: alpha = o exp(-d^T C(u)^-1 d / 2)        EWA: alpha = o exp(-d^T C(u0)^-1 d / 2)

since the Mahalanobis distance of a point from a line is that of their projections along the line.
A(u) = A(u0) - d e_z^T, so with k = A(u0) S e_z / z^2 and w = S_zz / z^2, the squared ratio of the
splat's depth to its distance,

    C(u) = C(u0) - d k^T - k d^T + w d d^T

Let e, kappa be d, k in coordinates where C(u0) is the identity, and rho = |e|: the distance from
the mean on the film, in standard deviations. Inverting the 2x2 matrix,

    d^T C(u)^-1 d = rho^2 / D,    D = 1 - 2 e.kappa + rho^2 w - (rho^2 |kappa|^2 - (e.kappa)^2)

S is positive, hence |kappa|^2 <= w, the last bracket lies between 0 and rho^2 w, and

    1 - 2 rho |kappa| <= D <= 1 + 2 rho |kappa| + rho^2 w

kappa is what a splat's depth has to do with its place on the film. It vanishes for a round splat
on the axis: there the models differ by the square of the splat's angular size. For a round splat
at the angle theta from the axis |kappa| = sin(theta) sigma / z, and a tilted one has some, too:
the models then differ by the first power.

**Low-pass.** It is undone by giving volprim the Gaussian widened in the directions parallel to
the film: C(u0) then is drgs's covariance on the film, and k, w are unchanged.

**Colour.** drgs takes the colour in the direction of the mean, volprim in that of the ray. The
angle between them is at most |d|. By the addition theorem, in the tangent plane,
sum_m grad Y_lm grad Y_lm^T = l (l + 1) (2 l + 1) / (8 pi) I, so that a colour sum_lm c_lm Y_lm
changes per radian by at most sum_l |c_l| sqrt(l (l + 1) (2 l + 1) / (8 pi)).

**Order.** drgs orders by the depth of the means, volprim by where a ray enters the splats' shells.
In these scenes both are the same order.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import single
from support.volprim import (
    LONG,
    OFF_AXIS,
    SCENES,
    STRAIGHT,
    Splats,
    _projection,
    assert_within,
    axes_of,
    bound,
    covariances,
    drgs_image,
    footprints,
    propagated,
    volprim_image,
    widened,
)

import drgs  # noqa: F401  (registers the plugin)
from drgs.core.constants import ALPHA_CUT, LOW_PASS
from drgs.reference import splatting as reference


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


all_scenes = pytest.mark.parametrize("splats", SCENES.values(), ids=SCENES.keys())


# ----------------------------------------------------------------------------------------------
# Images
# ----------------------------------------------------------------------------------------------


def difference_of(gaussians, view) -> np.ndarray:
    """volprim's image, the low-pass undone, less drgs's: (H, W, 3)."""
    axes = axes_of(widened(gaussians, view.camera))
    return volprim_image(gaussians, view, *axes) - drgs_image(gaussians, view)


# ----------------------------------------------------------------------------------------------
# Agreement
# ----------------------------------------------------------------------------------------------


@all_scenes
def test_isolated_splats_agree_with_volprim(splats):
    gaussians, view = splats.gaussians, splats.view
    allowed = bound(gaussians, view.camera, widened(gaussians, view.camera))
    assert_within(difference_of(gaussians, view), allowed)


def test_unmodified_splats_agree_with_volprim_if_the_low_pass_is_negligible():
    """Nothing is undone: drgs's variances on the film, at least 18^2 px^2, are larger by 0.3."""
    splats = Splats(angle=0.005, sizes=((27.0, 22.0, 18.0),), film=128)
    gaussians, view = splats.gaussians, splats.view
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    expected = volprim_image(gaussians, view, np.exp(gaussians.log_scales), quats[:, [1, 2, 3, 0]])
    allowed = bound(gaussians, view.camera, covariances(gaussians), excess=LOW_PASS / 18.0**2)
    assert_within(expected - drgs_image(gaussians, view), allowed)


@all_scenes
def test_difference_from_volprim_is_the_derived_one(splats):
    """Only rounding is left when it is subtracted."""
    gaussians, view = splats.gaussians, splats.view
    on_film = footprints(gaussians, view.camera, widened(gaussians, view.camera))
    depths = (gaussians.means - view.camera.center) @ view.camera.rotation[2]
    drawn = np.where(on_film.alpha_by_mean >= ALPHA_CUT, on_film.alpha_by_mean, 0)
    colors = np.broadcast_to(on_film.color_by_mean, on_film.color_by_ray.shape)
    derived = composite(on_film.alpha_by_ray, on_film.color_by_ray, depths)
    derived -= composite(drawn, colors, depths)

    d_alpha = on_film.alpha_rounding + np.where(on_film.near_cut, on_film.alpha_by_mean, 0)
    assert_within(
        difference_of(gaussians, view) - derived,
        propagated(on_film, d_alpha, on_film.color_rounding),
    )


def composite(alphas, colors, depths) -> np.ndarray:
    """(H, W, 3) from alphas (N, H, W) and colours (N, H, W, 3), front to back."""
    image, transmittance = np.zeros(colors.shape[1:]), np.ones(alphas.shape[1:])
    for i in np.argsort(depths):
        image += (transmittance * alphas[i])[..., None] * colors[i]
        transmittance *= 1 - alphas[i]
    return image


# ----------------------------------------------------------------------------------------------
# Convergence
# ----------------------------------------------------------------------------------------------


class Sheared(Splats):
    """Splats sheared along their rays until kappa = 0.

    Thus ellipsoids that are turned, and off the axis, whose depth has nothing to do with their
    place on the film.
    """

    @property
    def gaussians(self) -> reference.Gaussians:
        gaussians, camera = super().gaussians, self.view.camera
        means = (gaussians.means - camera.center) @ camera.rotation.T
        slopes = means[:, :2] / means[:, 2:]
        covariance = camera.rotation @ covariances(gaussians) @ camera.rotation.T
        at_mean = _projection(slopes)
        uncoupled = np.zeros_like(covariance)
        uncoupled[:, :2, :2] = at_mean @ covariance @ at_mean.transpose(0, 2, 1)
        uncoupled[:, 2, 2] = covariance[:, 2, 2]
        shear = np.broadcast_to(np.eye(3), covariance.shape).copy()
        shear[:, :2, 2] = slopes
        to_world = camera.rotation.T @ shear
        scales, quats_xyzw = axes_of(to_world @ uncoupled @ to_world.transpose(0, 2, 1))
        quats = single(quats_xyzw[:, [3, 0, 1, 2]])
        return replace(gaussians, quats=quats, log_scales=single(np.log(scales)))


FIRST_ORDER = {
    "round, off the axis": Splats(slope=OFF_AXIS),
    "tilted": Splats(sizes=LONG),
    "tilted, off the axis": Splats(sizes=LONG, slope=OFF_AXIS),
}


SECOND_ORDER = {
    "round, on the axis": Splats(to_world=STRAIGHT),
    "round, the camera turned": Splats(),
    "sheared": Sheared(sizes=LONG),
    "sheared, off the axis": Sheared(sizes=LONG, slope=OFF_AXIS),
}


def observed_orders(splats, angles) -> np.ndarray:
    """Exponents of the angular size in the largest difference, for angles that are halved."""
    largest = []
    for angle in angles:
        smaller = replace(splats, angle=angle)
        gaussians, view = smaller.gaussians, smaller.view
        alpha = footprints(gaussians, view.camera, widened(gaussians, view.camera)).alpha_by_mean
        both_draw = alpha[0] > 2 * ALPHA_CUT
        largest.append(np.abs(difference_of(gaussians, view)[both_draw]).max())
    return -np.diff(np.log2(largest))


@pytest.mark.parametrize("splats", FIRST_ORDER.values(), ids=FIRST_ORDER.keys())
def test_difference_is_first_order_if_depth_correlates_with_position(splats):
    """In alpha it is rho^2 exp(-rho^2 / 2) e.kappa, at most 1.16 |kappa|.

    It is followed by at most (w rho^4 / 2 + 2 kappa^2 rho^4 + kappa^2 rho^6 / 2) exp(-rho^2 / 2),
    which is 1.08 w + 9.7 kappa^2: here, relative to the first, at most 8 times the angle. Single
    precision adds 0.05 of the last, smallest difference. -log2((1 - 0.32) / (1 - 0.16) (1 - 0.05))
    = 0.38. Measured 0.06.
    """
    assert np.all(np.abs(observed_orders(splats, (0.04, 0.02, 0.01)) - 1) < 0.38)


@pytest.mark.parametrize("splats", SECOND_ORDER.values(), ids=SECOND_ORDER.keys())
def test_difference_is_second_order_otherwise(splats):
    """In alpha it is w rho^4 / 2 exp(-rho^2 / 2), largest at rho = 2.

    The next term is that times w (rho^4 / 4 - rho^2), which vanishes there: less than w = 0.02.
    Single precision adds 0.06 of the last, smallest difference. -log2((1 - 0.02) (1 - 0.06)) =
    0.12. Measured 0.001.
    """
    assert np.all(np.abs(observed_orders(splats, (0.12, 0.06, 0.03)) - 2) < 0.12)
