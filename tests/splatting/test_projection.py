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

<<<<<<< HEAD
# Relative to the largest number of each array. Chains of some hundred roundings, 1e-14 in float64
# and 1e-5 in float32 (2^29 times as much), and factors of a few where the terms of a quaternion's
# or a mean's gradient cancel. Measured: 1e-14 and 5e-6.
TOLERANCE = {FLOAT64: 1e-12, FLOAT32: 5e-5}

CASES = [
    Case("degree 3", 37, 29, 3),
    Case("degree 2, antialiased", 37, 29, 2, antialiased=True, seed=1),
    Case("degree 1", 24, 60, 1, seed=2),
    Case("degree 0, antialiased", 60, 24, 0, antialiased=True, seed=3),
    Case("degree 2 of 3", 5, 3, 3, sh_degree=2, seed=4),
    Case("many", 33, 47, 1, count=500, antialiased=True, seed=5),
]
all_cases = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


def project_case(case, precision, parameter_rows=None):
    rule = compensated_opacity if case.antialiased else plain_opacity
    if parameter_rows is None:
        gaussians = device_gaussians(case.gaussians, precision)
        parameter_rows = load_rows(gaussians, case.rendered_degree)
    camera = device_camera(case.camera, precision)
    return project(parameter_rows, camera, case.rendered_degree, rule)


def splats_as_numpy(splats) -> dict[str, np.ndarray]:
    """Under the names of ``reference.Projection``; a covariance's diagonal as variances."""
    a, b, c = rows(splats.conics).T
    return {
        "means2d": rows(splats.means2d),
        "conics": np.moveaxis(np.array([[a, b], [b, c]]), -1, 0),
        "variances": rows(splats.variances),
        "depths": rows(splats.depths),
        "opacities": rows(splats.opacities),
        "colors": rows(splats.colors),
    }


def test_constants_match_the_reference():
    assert constants.ALPHA_MAX == reference.ALPHA_MAX
    assert constants.ALPHA_CUT == reference.ALPHA_CUT
    assert constants.TRANSMITTANCE_STOP == reference.TRANSMITTANCE_STOP
    assert constants.LOW_PASS == reference.LOW_PASS
    assert constants.TAN_CLAMP == reference.FRUSTUM_MARGIN


@both_precisions
@all_cases
def test_splats_match_the_reference(precision, case):
    expected = reference.project(case.gaussians, case.camera, case.antialiased)
    splats = project_case(case, precision)
    visible = np.array(splats.visible)
    np.testing.assert_array_equal(visible, expected.visible)
    assert visible.any() and not visible[:3].any()
    fields = {
        "means2d": expected.means2d,
        "conics": expected.conics,
        "variances": np.diagonal(expected.cov2d, axis1=1, axis2=2),
        "depths": expected.depths,
        "opacities": expected.opacities,
        "colors": reference.sh_colors(case.gaussians, case.camera, case.rendered_degree),
    }
    actual = {name: value[visible] for name, value in splats_as_numpy(splats).items()}
    assert all(np.isfinite(value).all() for value in splats_as_numpy(splats).values())
    # Each row relative to its own size, so that a small splat is not hidden behind the largest
    # covariance; positions and colours, which are sums with terms of the film's size or of size
    # one, relative to the largest of all. These are short sums: a tenth of the tolerance.
    for name, values in fields.items():
        values = values[visible]
        axes = tuple(range(1, values.ndim))
        size = np.abs(values).max(axis=axes, keepdims=True)
        if name in ("means2d", "colors"):
            size = np.maximum(size, np.abs(values).max())
        errors = np.abs(actual[name] - values) / size
        assert errors.max() <= 0.1 * TOLERANCE[precision], f"{name}: {errors.max():.2g}"


def project_gradients(case, precision, weights) -> dict[str, np.ndarray]:
    """Dr.Jit's derivatives of sum(weights * splats), by parameter."""
    parameter_rows = load_rows(device_gaussians(case.gaussians, precision), case.rendered_degree)
    dr.enable_grad(parameter_rows)
    splats = project_case(case, precision, parameter_rows)
    G = weights["conics"]
    abc = np.column_stack([G[:, 0, 0], 2 * G[:, 0, 1], G[:, 1, 1]])
    loss = (
        dr.dot(precision.vectors(weights["means2d"]), splats.means2d)
        + dr.dot(precision.vectors(abc), splats.conics)
        + dr.dot(precision.vectors(weights["colors"]), splats.colors)
        + precision.array(weights["opacities"]) * splats.opacities
        + precision.array(weights["depths"]) * splats.depths
    )
    dr.backward(loss)
    gradients = dr.grad(parameter_rows)
    n = len(case.gaussians.means)
    coefficients = [rows(c) for c in gradients.sh]
    missing = (case.degree + 1) ** 2 - len(coefficients)
    sh = np.stack(coefficients + [np.zeros((n, 3))] * missing, axis=1)
    names = ("means", "quats", "log_scales", "logit_opacities")
    return {
        **{name: rows(getattr(gradients, name)) for name in names},
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }


@pytest.mark.slow
@both_precisions
@all_cases
def test_gradients_equal_the_reference(precision, case):
    """Weights of the invisible are zero, as compositing gives them."""
    splats = reference.project(case.gaussians, case.camera, case.antialiased)
    rng = np.random.default_rng(3)
    n = len(splats.depths)
    weights = {
        "means2d": rng.normal(0, 1, (n, 2)),
        # Conics are about 1 / variance: weights of that inverse size, or the smallest
        # splats would hide the others.
        "conics": rng.normal(0, 1, (n, 1, 1)) * splats.cov2d,
        "opacities": rng.normal(0, 1, n),
        "colors": rng.normal(0, 1, (n, 3)),
        "depths": rng.normal(0, 1, n),
    }
    weights = {
        name: single(value * splats.visible.reshape((-1,) + (1,) * (value.ndim - 1)))
        for name, value in weights.items()
    }
    expected = reference.project_gradients(
        case.gaussians, case.camera, weights["means2d"], weights["conics"], weights["opacities"],
        weights["depths"], case.antialiased,
    )  # fmt: skip
    through_color = reference.sh_colors_gradients(
        case.gaussians, case.camera, case.rendered_degree, weights["colors"]
    )
    expected["means"] = expected["means"] + through_color["means"]
    expected.update(sh0=through_color["sh0"], shN=through_color["shN"])
    actual = project_gradients(case, precision, weights)
    assert_arrays_agree(actual, expected, TOLERANCE[precision])
    for name in PARAMETER_NAMES:
        assert not actual[name][~splats.visible].any(), name
        if actual[name].any():
            with pytest.raises(AssertionError, match=rf"{name}\["):
                scaled = {**actual, name: 1.01 * actual[name]}
                assert_arrays_agree(scaled, expected, TOLERANCE[precision])


def test_scenes_clamp_slopes_on_every_side_and_keep_visible_splats():
    case = CASES[0]
    splats = reference.project(case.gaussians, case.camera)
    affine = reference.local_affine(case.gaussians, case.camera)
    slopes = affine.means[:, :2] / affine.means[:, 2:]
    low, high = affine.ratios > slopes, affine.ratios < slopes
    assert (low & splats.visible[:, None]).any(axis=0).all()
    assert (high & splats.visible[:, None]).any(axis=0).all()


# ----------------------------------------------------------------------------------------------
# Facts that need no reference
# ----------------------------------------------------------------------------------------------

=======
>>>>>>> t43-spl

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
