"""Projection of splats that are far, long, small or without area, stage alone."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    both_precisions,
    device_camera,
    device_gaussians,
    rows,
    single,
)
from support.reference_scenes import needle

from drgs.reference import splatting as reference
from drgs.splatting.projection import compensated_opacity, load_rows, plain_opacity, project


def splats_of(gaussians, camera, precision, degree=0, rule=plain_opacity):
    parameter_rows = load_rows(device_gaussians(gaussians, precision), degree)
    return project(parameter_rows, device_camera(camera, precision), degree, rule)


@both_precisions
def test_camera_far_from_the_origin_renders_the_same(precision):
    """Coordinates are multiples of 2^-10, so moving them by 4096 is exact."""
    gaussians, camera = Case("far", 37, 29, 3).scene
    means, center = (np.round(v * 1024) / 1024 for v in (gaussians.means, camera.center))
    shift = np.array([4096.0, -4096.0, 4096.0])
    here, there = (
        splats_of(
            replace(gaussians, means=means + offset),
            replace(camera, center=center + offset),
            precision,
            degree=3,
        )
        for offset in (0 * shift, shift)
    )
    for name in ("means2d", "conic_factor", "depths", "opacities", "colors", "variances"):
        np.testing.assert_array_equal(rows(getattr(here, name)), rows(getattr(there, name)))


@pytest.mark.parametrize(("length", "precision"), [(1e7, FLOAT64), (1e5, FLOAT32)])
def test_needle_keeps_its_determinant(length, precision):
    """cov2d = l^2 v v^T + 0.3 I with v at 45 degrees: xx yy - xy^2 would cancel entirely."""
    gaussians, camera = needle(np.log([length, 1 / length, 1 / length]))
    gaussians = replace(gaussians, log_scales=single(gaussians.log_scales))
    expected = reference.project(gaussians, camera).conics
    splats = splats_of(gaussians, camera, precision)
    a, b, c = rows(splats.conics).T
    actual = np.moveaxis(np.array([[a, b], [b, c]]), -1, 0)
    # exp(log_scales) carries log(1e5) = 12 times the format's epsilon, squared.
    scale = np.abs(expected).max()
    tolerance = 64 * float(np.finfo(precision.dtype).eps)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * scale)
    # At the distance l along the needle |U d|^2 = 1; a dx^2 + 2 b dx dy + c dy^2 would be noise
    # of l^2 times epsilon. What is left is p + r = 0 up to a rounding of p, against s = 1.4 / l.
    p, r, s = rows(splats.conic_factor)[0]
    assert length**2 / 2 * ((p + r) ** 2 + s**2) == pytest.approx(1, rel=1e-3)


@both_precisions
@pytest.mark.parametrize("sizes", [(3.0, 0.01), (0.3, 0.2), (0.05, 0.04), (1e-3, 1e-3)])
def test_compensated_splats_keep_their_integral(precision, sizes):
    """o 2 pi sqrt(det cov2d) is that of the splat before the low-pass, for the smallest too."""
    gaussians, camera = needle(np.log([*sizes, 1e-3]))
    splats = splats_of(gaussians, camera, precision, rule=compensated_opacity)
    p, _, s = rows(splats.conic_factor)[0]
    integral = rows(splats.opacities)[0] / (p * s)
    expected = reference.sigmoid(np.float64(3.0)) * sizes[0] * sizes[1]
    assert integral == pytest.approx(expected, rel=32 * float(np.finfo(precision.dtype).eps))


@both_precisions
def test_a_splat_without_area_is_invisible_when_compensated(precision):
    gaussians, camera = needle([0.0, -80.0, -80.0])
    assert splats_of(gaussians, camera, precision).visible[0]
    parameter_rows = load_rows(device_gaussians(gaussians, precision), 0)
    dr.enable_grad(parameter_rows)
    splats = project(parameter_rows, device_camera(camera, precision), 0, compensated_opacity)
    assert not splats.visible[0] and splats.opacities[0] == 0
    dr.backward(splats.opacities)
    assert not rows(dr.grad(parameter_rows.log_scales)).any()
