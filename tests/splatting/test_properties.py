"""Invariants of every scene: the kernels are compared with themselves on random scenes.

Hypothesis draws the structure of a scene (its film, its size, what is rendered) and a seed; the
numbers come from the recipes of ``helpers`` and ``views``. Every run sees the same examples.
"""

import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.helpers import (
    both_precisions,
    device_camera,
    frame_tangent,
    rows,
    single,
)
from support.random_scenes import (
    KINDS,
    ROUNDOFF,
    Result,
    _with_shapes,
    assert_agree,
    assume_decided,
    cases,
    changed,
    examples,
    point_at,
    random_weights,
    result_of,
    seeds,
    taken,
    undecided_pixels,
    uploaded,
    with_row,
)

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import rendering


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Rendering
# ----------------------------------------------------------------------------------------------


def assert_equal(actual, expected) -> None:
    """To the last bit, but for the signs of zeros; all is finite."""
    for of in ("rendered", "gradients"):
        for name, values in getattr(expected, of).items():
            assert np.isfinite(values).all(), name
            np.testing.assert_array_equal(getattr(actual, of)[name], values, name)


# How far rounding moves a splat on the film, in roundoffs, if all roundings conspire. Measured on
# 400 scenes in either precision: at most 0.08 of what follows from it, and once 0.35.
#
# A camera coordinate is a row of the rotation times the difference of a mean and the centre. For
# a mean at a depth of 1 these are at most about 8, 3 and 2.5 in size. Rounded once each where they
# are moved, then once per operation, they make some 45 roundoffs, times a focal length of at most
# 56 px, and three roundings of up to 64 px. (Behind, coordinates grow less than the depth.)
MOVED = 45 * 56 + 3 * 64


# A rotation's entries are off by some eight roundoffs. That turns the rim of a splat, 3.3 standard
# deviations of up to 20 px from its mean.
TURNED = 8 * 3.3 * 20


# ----------------------------------------------------------------------------------------------
# Not a bit changes
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@both_precisions
@examples
@given(cases(), seeds)
def test_result_is_invariant_to_row_order(precision, case, seed):
    """Only the depth orders the splats, and each row has its own gradient."""
    assume_decided(case)
    weights = random_weights(case)
    order = np.random.default_rng(seed).permutation(case.count)
    result = result_of(case, precision, weights)
    gradients = {name: values[order] for name, values in result.gradients.items()}
    permuted = result_of(case, precision, weights, taken(case.gaussians, order))
    assert_equal(permuted, replace(result, gradients=gradients))


@pytest.mark.slow
@both_precisions
@examples
@given(cases(), seeds)
def test_negated_and_scaled_quaternions_are_the_same_rotations(precision, case, seed):
    """Their gradients are divided by the factor, and nothing else changes."""
    rng = np.random.default_rng(seed)
    signs, exponents = rng.choice([-1.0, 1.0], case.count), rng.integers(-20, 21, case.count)
    factors = (signs * 2.0**exponents)[:, None]
    weights = random_weights(case)
    result = result_of(case, precision, weights)
    gradients = result.gradients | {"quats": result.gradients["quats"] / factors}
    scaled = changed(case.gaussians, quats=lambda quats: factors * quats)
    assert_equal(result_of(case, precision, weights, scaled), replace(result, gradients=gradients))


@pytest.mark.slow
@both_precisions
@examples
@given(cases(), st.floats(-10, 0.99), seeds)
def test_gaussian_before_the_near_plane_is_ignored(precision, case, depth, seed):
    """depth: in units of the near plane's; negative ones are behind the camera."""
    rng = np.random.default_rng(seed)
    row = rng.integers(0, case.count + 1)
    film = rng.uniform(0, 1, 2) * [case.width, case.height]
    added = with_row(
        case.gaussians, row, means=point_at(case.camera, film, depth * case.camera.near)
    )
    weights = random_weights(case)
    result = result_of(case, precision, weights)
    gradients = {name: np.insert(v, row, 0, axis=0) for name, v in result.gradients.items()}
    assert_equal(result_of(case, precision, weights, added), replace(result, gradients=gradients))


@pytest.mark.slow
@both_precisions
@examples
@given(cases([(0, False), (3, False)]), st.integers(-20, 20))
def test_image_is_invariant_to_scaling_by_powers_of_two(precision, case, exponent):
    """Depths scale, and the weights of depths inversely: the loss is the same.

    Points, since the logarithm of a scaled size would be rounded: e^-1000 is zero.
    """
    factor = 2.0**exponent
    points = changed(case.gaussians, log_scales=lambda logs: np.full_like(logs, -1000.0))
    scaled = changed(points, means=lambda means: factor * means)
    camera = case.camera
    camera = replace(camera, center=factor * camera.center, near=factor * camera.near)
    weights = random_weights(case)
    result = result_of(case, precision, weights, points)
    weights[-1] /= factor
    actual = result_of(case, precision, weights, scaled, device_camera(camera, precision))
    assert_equal(actual, scaled_result(result, factor))


def scaled_result(result, factor) -> Result:
    """Return the result that a division of the unit of length by ``factor`` must give."""
    return Result(
        rendered=result.rendered | {"depth": factor * result.rendered["depth"]},
        gradients=result.gradients | {"means": result.gradients["means"] / factor},
    )


# ----------------------------------------------------------------------------------------------
# Nothing but rounding changes
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@both_precisions
@examples
@given(cases(KINDS[:2]), seeds)
def test_image_is_invariant_to_rigid_motion(precision, case, seed):
    """Gradients of positions turn with the scene, those of quaternions as quaternions do.

    With q' = p q, p of norm 1, quaternions are multiplied by an orthogonal matrix P, and so are
    their gradients.
    """
    assume_decided(case)
    undecided = undecided_pixels(case)
    weights = random_weights(case) * ~undecided
    rng = np.random.default_rng(seed)
    quat = rng.normal(0, 1, 4)
    R = reference.quat_to_rotation(quat[None])[0]
    P = hamilton_product(quat / np.linalg.norm(quat))
    shift = rng.normal(0, 1, 3)

    moved = changed(
        case.gaussians, means=lambda means: means @ R.T + shift, quats=lambda quats: quats @ P.T
    )
    camera = case.camera
    camera = replace(camera, rotation=camera.rotation @ R.T, center=R @ camera.center + shift)
    actual = result_of(case, precision, weights, moved, device_camera(camera, precision))

    result = result_of(case, precision, weights)
    turned = {"means": result.gradients["means"] @ R.T, "quats": result.gradients["quats"] @ P.T}
    expected = replace(result, gradients=result.gradients | turned)
    assert_agree(actual, expected, moved.quats, undecided, MOVED * ROUNDOFF[precision])


def hamilton_product(quat) -> np.ndarray:
    """The matrix (4, 4) that multiplies a quaternion by ``quat`` from the left, wxyz."""
    w, x, y, z = quat
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


@pytest.mark.slow
@both_precisions
@examples
@given(cases(), st.floats(-10, 10))
def test_image_is_invariant_to_scaling(precision, case, exponent):
    """With the near plane; depths scale, and the weights of depths inversely.

    Sizes are off by the roundings of their logarithms, of up to 11: less than the positions.
    """
    assume_decided(case)
    undecided = undecided_pixels(case)
    weights = random_weights(case) * ~undecided
    factor = 2.0**exponent
    scaled = changed(
        case.gaussians,
        means=lambda means: factor * means,
        log_scales=lambda logs: logs + math.log(factor),
    )
    camera = case.camera
    camera = replace(camera, center=factor * camera.center, near=factor * camera.near)
    expected = scaled_result(result_of(case, precision, weights), factor)
    weights[-1] /= factor
    actual = result_of(case, precision, weights, scaled, device_camera(camera, precision))
    assert_agree(actual, expected, scaled.quats, undecided, MOVED * ROUNDOFF[precision])


@pytest.mark.slow
@both_precisions
@examples
@given(cases(), seeds)
def test_quaternions_of_any_norm_are_rotations(precision, case, seed):
    """A gradient is divided by the factor of its quaternion."""
    undecided = undecided_pixels(case)
    weights = random_weights(case) * ~undecided
    factors = np.exp(np.random.default_rng(seed).uniform(-5, 5, (case.count, 1)))
    scaled = changed(case.gaussians, quats=lambda quats: factors * quats)
    actual = result_of(case, precision, weights, scaled)
    result = result_of(case, precision, weights)
    divided = {"quats": result.gradients["quats"] / factors}
    expected = replace(result, gradients=result.gradients | divided)
    assert_agree(actual, expected, scaled.quats, undecided, TURNED * ROUNDOFF[precision])


@pytest.mark.slow
@both_precisions
@examples
@given(cases())
def test_gradients_of_quaternions_are_orthogonal_to_them(precision, case):
    """The norm of a quaternion is of no effect.

    A gradient's four components are sums of some 20 terms, each rounded about five times; how
    large these are, gradients of scales tell too (see ``_with_shapes``).
    Measured below 50 roundoffs.
    """
    result = result_of(case, precision, random_weights(case))
    quats = case.gaussians.quats
    terms = _with_shapes(result.gradients, quats)["shapes"]
    along = np.sum(quats * result.gradients["quats"], axis=1)
    assert np.abs(along).max() <= 400 * ROUNDOFF[precision] * np.abs(terms).max()


@pytest.mark.slow
@both_precisions
@examples
@given(cases(), seeds)
def test_adjoint_is_the_transpose_of_the_tangent(precision, case, seed):
    """<J v, w> = <v, J^T w>, and both replay the decisions of the same frame.

    The terms are products of the same numbers in another order, rounded some hundred times each
    in either direction. The sums may cancel, so the error is relative to the terms.
    Measured below 25 roundoffs.
    """
    rng = np.random.default_rng(seed)
    draw = dict.fromkeys(PARAMETER_NAMES, lambda values: single(rng.normal(0, 1, values.shape)))
    direction = changed(case.gaussians, **draw)
    weights = random_weights(case)
    gaussians = uploaded(case.gaussians, precision)
    frame = rendering.render(gaussians, device_camera(case.camera, precision), case.pipeline)
    tangents = frame_tangent(gaussians, frame, uploaded(direction, precision))
    gradients = result_of(case, precision, weights).gradients
    left = [w.ravel() * rows(plane) for w, plane in zip(weights, tangents, strict=True)]
    right = [gradients[name] * getattr(direction, name) for name in PARAMETER_NAMES]
    size = math.sqrt(sum((term**2).sum() for term in [*left, *right]))
    pixels, parameters = (sum(term.sum() for term in terms) for terms in (left, right))
    assert abs(pixels - parameters) <= 200 * ROUNDOFF[precision] * size
