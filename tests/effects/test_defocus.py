"""Depth of field against the float64 reference and against many samples of the aperture."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    both_precisions,
    device_gaussians,
    render_composed,
    rows,
    single,
)
from support.lens_scenes import PINHOLE, covariances, lens_camera, planes_of
from support.reference_effects import ThinLens, lens_cameras, project_defocused
from support.reference_lenses import camera_at_origin, gaussians_at

from drgs.accuracy.pipeline import pipeline_of
from drgs.cameras.camera import Aperture
from drgs.config.approximations import Approximations
from drgs.effects.defocus import Defocused
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from drgs.splatting.projection import compensated_opacity, ewa, load_rows, plain_opacity, project
from drgs.testing import Case

# Blurred by up to 3 px: f a |1 / focus - 1 / z| with f = 26 px and z from 1 to 4.
DEFOCUS = ThinLens(0.21875, 2.0)


def aperture_camera(camera, precision, defocus):
    """The kernels' pinhole camera; without an aperture if ``defocus`` is None."""
    device = lens_camera(camera, PINHOLE, precision)
    if defocus is None:
        return device
    numbers = (dr.opaque(precision.Float, n) for n in vars(defocus).values())
    return replace(device, aperture=Aperture(*numbers))


def splats_of(gaussians, camera, precision, defocus, rule=plain_opacity, low_pass=0.3):
    """Projection by the kernels, in focus if ``defocus`` is None."""
    device = aperture_camera(camera, precision, defocus)
    shape = ewa if defocus is None else Defocused(ewa)
    parameter_rows = load_rows(device_gaussians(gaussians, precision), 0)
    return project(parameter_rows, device, 0, rule, shape, low_pass=low_pass)


@both_precisions
def test_zero_aperture_renders_the_pinhole_image(precision):
    case = Case("defocus", aperture=(0.0, 2.0))
    in_focus = replace(case, aperture=None).planes(case.values, precision.Float)
    # The same covariance; the factor of the opacity is x / x.
    np.testing.assert_array_equal(case.planes(case.values, precision.Float), in_focus)


@both_precisions
def test_cameras_of_an_aperture_are_the_reference(precision):
    """Points are seen at the same places: those in focus at one, others all over their blur."""
    camera = camera_at_origin(fx=200.0, fy=180.0)
    device = aperture_camera(camera, precision, DEFOCUS)
    points = np.array([[0.25, -0.125, 0.5], [0.5, 0.25, 2.0], [-1.0, 0.5, 8.0]])
    found = [
        rows(at.lens.project_point(at, at.rotation @ (precision.vectors(points) - at.center)))
        for at in device.aperture.cameras(device, 16)
    ]
    expected = [
        at.film_points((points - at.center) @ at.rotation.T)
        for at in lens_cameras(camera, DEFOCUS, 16)
    ]
    np.testing.assert_allclose(found, expected, rtol={FLOAT64: 1e-12}.get(precision, 2e-6))
    np.testing.assert_allclose(np.ptp(found, axis=0)[1], 0, atol=1e-3)


@both_precisions
def test_splat_in_focus_is_not_blurred(precision):
    """Nor dimmed; those before and behind it are."""
    camera = camera_at_origin(fx=200.0, fy=200.0)
    points = [[0.25, -0.125, 0.5], [0.5, 0.25, 2.0], [-1.0, 0.5, 8.0]]
    gaussians = replace(
        gaussians_at(points, [0.05, 0.1, 0.02]), quats=single([[0.3, 0.8, -0.5, 0.1]] * 3)
    )
    blurred, in_focus = (
        splats_of(gaussians, camera, precision, defocus) for defocus in (ThinLens(0.125, 2.0), None)
    )
    for name in ("conic_factor", "variances", "opacities"):
        a, b = (rows(getattr(splats, name)) for splats in (blurred, in_focus))
        np.testing.assert_array_equal(a[1], b[1])
        assert (np.abs(a[[0, 2]] / b[[0, 2]] - 1).reshape(2, -1).max(axis=1) > 0.1).all()
    np.testing.assert_array_equal(rows(blurred.means2d), rows(in_focus.means2d))
    np.testing.assert_array_equal(rows(blurred.depths), rows(in_focus.depths))


@both_precisions
@pytest.mark.parametrize("rule", [plain_opacity, compensated_opacity], ids=lambda f: f.__name__)
@pytest.mark.parametrize("scale", [0.1, 1e-6])
@pytest.mark.parametrize("low_pass", [0.3, 0.0])
def test_defocus_preserves_the_integral_of_a_splat(precision, rule, scale, low_pass):
    """2 pi opacity sqrt(det cov2d). Also of splats that are far thinner than the low-pass."""
    camera = camera_at_origin(fx=200.0, fy=200.0)
    gaussians = gaussians_at([[0.25, -0.125, 1.0]], [[scale, 2 * scale, 0.5 * scale]])
    integrals, sizes = [], []
    for defocus in (DEFOCUS, None):
        splats = splats_of(gaussians, camera, precision, defocus, rule, low_pass)
        p, _, s = rows(splats.conic_factor)[0]
        integrals.append(rows(splats.opacities)[0] / (p * s))
        sizes.append(1 / (p * s))
    rounding = float(np.finfo(precision.dtype).eps)
    assert integrals[0] == pytest.approx(integrals[1], rel=64 * rounding)
    assert sizes[0] > sizes[1] + 100


# ----------------------------------------------------------------------------------------------
# Surfaces far out of focus
# ----------------------------------------------------------------------------------------------

FAR = ThinLens(0.4, 1.0)
"""At the wall's depth, 4, points are spread over discs with a radius of 12 px."""


def wall() -> tuple[reference.Gaussians, reference.Camera]:
    """A plane of splats, one each half px, of 0.6 px and opacity 0.2; its colour changes slowly.

    Out of focus they have an opacity of 0.0017, less than half of what is cut in focus.
    """
    camera = camera_at_origin(fx=40.0, fy=40.0, cx=6.0, cy=4.5, width=12, height=9)
    x, y = (v.ravel() for v in np.mgrid[-24:36:0.5, -24:33:0.5])
    # In any order: all are equally far, and those that come first are composited first.
    shuffled = np.random.default_rng(0).permutation(x.size)
    x, y = x[shuffled], y[shuffled]
    points = 4 * np.column_stack([(x - 6) / 40, (y - 4.5) / 40, np.ones(x.size)])
    colors = np.column_stack([0.7 + 0.02 * x, -0.9 + 0 * x, 0.2 - 0.02 * y])
    return replace(gaussians_at(points, 0.01, 0.2), sh0=colors[:, None]), camera


def planes_of_wall(**approximations) -> np.ndarray:
    gaussians, camera = wall()
    device = device_gaussians(gaussians, FLOAT64)
    camera = aperture_camera(camera, FLOAT64, FAR)
    pipeline = pipeline_of(Approximations(**approximations), 0)
    return planes_of(render_composed(device, camera, pipeline))


@pytest.mark.slow
def test_defocused_wall_keeps_alpha_and_colour():
    """A mean of many pinhole images has the same alpha and colour.

    With S the sum of all alphas at a pixel, a wall of splats that are hardly there lets exp(-S)
    through; one of splats of opacity o lets exp(-S (1 + o / 4 + o^2 / 9 + ...)) through, where the
    integral of -ln(1 - alpha) over a splat is that of alpha times the parenthesis: for S = 1.55,
    0.212 and 0.201. What remains is the grain of 64 images. Measured: 0.001.
    """
    gaussians, camera = wall()
    device = device_gaussians(gaussians, FLOAT64)
    pinholes = [aperture_camera(c, FLOAT64, None) for c in lens_cameras(camera, FAR, 64)]
    images = [planes_of(render_composed(device, c, rendering.Pipeline(0))) for c in pinholes]
    mean, found = np.mean(images, axis=0), planes_of_wall()
    thicker = 1 + 0.2 / 4 + 0.2**2 / 9 + 0.2**3 / 16
    np.testing.assert_allclose(found[0] ** thicker, mean[0], rtol=0, atol=0.004)
    np.testing.assert_allclose(found[1:] / (1 - found[0]), mean[1:] / (1 - mean[0]), atol=0.004)
    assert mean[0].min() > 0.1 and mean[0].max() < 0.3


@pytest.mark.parametrize("order", ["center", "pixel"])
def test_defocused_wall_is_as_opaque_with_exact_splats(order):
    """They are small beside their distance. Which of equally far ones is first is open."""
    found = planes_of_wall(projection="exact", order=order)
    # A splat is seen from 12 px away, at an angle whose square is 0.09, as that much longer.
    # Measured: 0.0002.
    np.testing.assert_allclose(found[0], planes_of_wall()[0], rtol=0, atol=1e-3)


def test_defocus_preserves_the_cut_of_splats():
    """An alpha of 1 / 255 is 1 / 51 of the largest, below which lies that part of the integral; at
    an extent of 2 standard deviations it is exp(-2).
    """
    depths = [
        -np.log(planes_of_wall(**approximations)[0])
        for approximations in ({"alpha_cut": 0.0}, {}, {"extent": 2.0})
    ]
    for depth, part in zip(depths, (0, 1 / 51, math.exp(-2)), strict=True):
        # The squares of alphas count half as much, of up to 0.0017; and a circle's edge in pixels.
        np.testing.assert_allclose(depth, (1 - part) * depths[0], rtol=0.002)


@both_precisions
def test_splats_invisible_in_focus_stay_invisible_when_defocused(precision):
    """Opacities around 1 / 255; dimmed far below it, and down to where no sum notices."""
    opacities = np.array([0.3, 0.004, 0.0038, 0.3])
    camera = camera_at_origin(fx=40.0, fy=40.0, cx=6.0, cy=4.5, width=12, height=9)
    gaussians = gaussians_at(np.tile([0, 0, 4.0], (4, 1)), [[0.01], [0.01], [0.01], [1e-9]])
    gaussians = replace(gaussians, logit_opacities=single(np.log(opacities / (1 - opacities))))
    for low_pass, visible in ((0.3, [1, 1, 0, 1]), (1e-18, [1, 1, 0, 0])):
        splats = splats_of(gaussians, camera, precision, FAR, low_pass=low_pass)
        expected = project_defocused(gaussians, camera, FAR, low_pass=low_pass)
        np.testing.assert_array_equal(np.array(splats.visible), visible)
        np.testing.assert_array_equal(expected.visible, visible)
        assert rows(splats.opacities).max() < reference.ALPHA_CUT


def test_small_exact_splats_are_blurred_like_affine_ones():
    """But for their size, 1e-4 of their distance, squared, times some 10. Measured: 3e-8."""
    camera = camera_at_origin(fx=2e4, fy=2e4, cx=30.0, cy=24.0, width=60, height=48)
    points = np.array([[-6e-4, -4e-4, 1.0], [4e-4, 6e-4, 2.5], [2e-4, -9e-4, 1.5]])
    gaussians = replace(
        gaussians_at(points, 1e-4), quats=np.random.default_rng(0).normal(0, 1, (3, 4))
    )
    planes = {}
    for projection in ("ewa", "exact"):
        for defocus in (ThinLens(2e-4, 2.0), None):
            frame = render_composed(
                device_gaussians(gaussians, FLOAT64),
                aperture_camera(camera, FLOAT64, defocus),
                pipeline_of(Approximations(projection=projection), 0),
            )
            planes[projection, defocus is None] = planes_of(frame)
    np.testing.assert_allclose(planes["exact", False], planes["ewa", False], rtol=0, atol=1e-6)
    assert np.abs(planes["exact", True] - planes["exact", False]).max() > 0.05


@both_precisions
def test_splat_blurred_over_thousands_of_pixels_matches_the_reference_covariance(precision):
    """Next to the near plane, through a large aperture."""
    camera = camera_at_origin(fx=200.0, fy=200.0)
    defocus = ThinLens(1.0, 4.0)
    gaussians = gaussians_at([[0.001, -0.002, 0.015625], [0.1, 0.1, 100.0]], 2.0**-10)
    expected = project_defocused(gaussians, camera, defocus)
    splats = splats_of(gaussians, camera, precision, defocus)
    sizes = np.abs(expected.cov2d).max(axis=(1, 2), keepdims=True)
    assert sizes[0] > 1e7
    errors = np.abs(covariances(splats) - expected.cov2d) / sizes
    assert errors.max() < {FLOAT64: 1e-12, FLOAT32: 2e-6}[precision]
    np.testing.assert_allclose(
        rows(splats.opacities),
        expected.opacities,
        rtol={FLOAT64: 1e-11, FLOAT32: 5e-6}[precision],
    )
