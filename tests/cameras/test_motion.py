"""Cameras that move, against the float64 reference, and the rotations of their turns."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import lenses, reference_effects
from support.cases import close_camera, reference_camera, shutter, with_lens
from support.helpers import (
    FLOAT32,
    FLOAT64,
    both_precisions,
    device_camera,
    device_gaussians,
    rows,
    single,
)
from support.lens_scenes import lens_camera, planes_of

from drgs.cameras.motion import (
    MIN_TURN_RAD,
    Motion,
    MotionBlur,
    RollingShutter,
    rotation_matrix,
    rotation_vector,
)
from drgs.core.arrays import types_of
from drgs.effects.compose import with_effects
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from drgs.testing import Case

SHUTTERS = {0: (RollingShutter,), 2: (MotionBlur, 2), 4: (MotionBlur, 4)}
"""Type and further arguments, by the number of samples; 0 of a rolling shutter."""

AXIS, DIRECTION = np.array([0.6, 0.48, -0.64]), np.array([0.36, -0.8, 0.48])


@both_precisions
@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.06, 2.5])
def test_poses_match_the_reference(precision, angle):
    camera = reference_camera(Case("pose"))
    # A rotation to more than single precision: turns are products of rotations.
    camera = replace(camera, rotation=Rotation.from_matrix(camera.rotation).as_matrix())
    close = close_camera(camera, 3 * DIRECTION, angle * AXIS)
    device, end = (device_camera(each, precision) for each in (camera, close))
    motion = Motion(*Motion.relative_motion(device, end.rotation, end.center))
    for time in (0.0, 0.25, 1.0):
        actual = motion.pose(device, precision.Float(time))
        expected = reference_effects.camera_at(camera, close, time)
        # Products of some ten roundings; the turn's axis is found by its sine.
        tolerance = {FLOAT64: 1e-14, FLOAT32: 2e-6}[precision]
        rotation = np.array(actual.rotation).astype(np.float64)[..., 0]
        np.testing.assert_allclose(rotation, expected.rotation, rtol=0, atol=tolerance)
        np.testing.assert_allclose(rows(actual.center)[0], expected.center, rtol=0, atol=tolerance)
        assert actual.shutter is None


@both_precisions
@pytest.mark.parametrize("samples", [0, 4])
def test_static_camera_renders_the_plain_image(precision, samples):
    """To the last bit: turns of zero are the identity."""
    plain, still = Case("plain"), np.zeros(3)
    moving = replace(plain, shutter=shutter(*SHUTTERS[samples], travel=still, turn=still))
    assert len(moving.frames(plain.values)[1]) == max(samples, 1)
    images = (case.planes(plain.values, precision.Float) for case in (moving, plain))
    np.testing.assert_array_equal(*images)


def test_horizontal_motion_is_exact_at_row_centers():
    """A camera that moves to the right, and splats in the middle of rows: each is seen by its row
    at the time at which it is projected.
    """
    height = 24
    camera = reference.Camera(np.eye(3), np.zeros(3), 30.0, 30.0, 16.0, 12.0, 32, height)
    close = replace(camera, center=np.array([0.5, 0.0, 0.0]))
    y = np.arange(2, height, 5) + 0.5
    points = np.column_stack([0.05 * y - 0.3, (y - 12) / 30 * 2, np.full(len(y), 2.0)])
    gaussians = reference.Gaussians(
        points, np.tile([1.0, 0, 0, 0], (len(y), 1)), np.full((len(y), 3), np.log(0.05)),
        np.full(len(y), 2.0), np.zeros((len(y), 1, 3)), np.zeros((len(y), 0, 3)),
    )  # fmt: skip
    device = lens_camera(camera, lenses.Pinhole(), FLOAT64)
    end = lens_camera(close, lenses.Pinhole(), FLOAT64)
    motion = Motion.relative_motion(device, end.rotation, end.center)
    device = replace(device, shutter=RollingShutter(*motion))
    splats = device_gaussians(gaussians, FLOAT64)
    pipeline = with_effects(rendering.Pipeline(0), splats, device)
    frame = rendering.render(splats, device, pipeline)
    alpha = 1 - planes_of(frame)[0].reshape(height, 32)
    expected = reference_effects.render_rolling_shutter(gaussians, camera, close)
    rows_of_splats = y.astype(int)
    np.testing.assert_allclose(
        alpha[rows_of_splats], expected.alpha[rows_of_splats], rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("samples", [2, 0], ids=["motion blur", "rolling"])
@pytest.mark.parametrize(("angle", "distance"), [(0.5, 2.0), (2.5, 50.0), (3.0, 1e5)])
@pytest.mark.parametrize("name", ["pinhole", "fisheye"])
def test_fast_camera_motion_stays_finite(samples, angle, distance, name):
    """Past the splats, through them, away from them; and positions that are no numbers."""
    motion = {"travel": distance * DIRECTION, "turn": angle * AXIS}
    case = with_lens(name, shutter=shutter(*SHUTTERS[samples], **motion), count=20)
    means = case.values["means"].copy()
    means[-3:] = [[np.nan, 0, 0], [0, np.inf, 0], [-np.inf, np.nan, np.inf]]
    values = {**case.values, "means": means}
    weights = np.random.default_rng(1).normal(size=(5, case.width * case.height))
    assert np.isfinite(case.planes(values, FLOAT32.Float)).all()
    for parameter, gradient in case.gradients(values, weights, FLOAT32.Float).items():
        assert np.isfinite(gradient).all() and not gradient[-3:].any(), parameter


# ----------------------------------------------------------------------------------------------
# Turns
# ----------------------------------------------------------------------------------------------


def matrices(values, precision) -> object:
    """Matrix3f of (N, 3, 3)."""
    values = np.asarray(values)
    return types_of(precision.Float).Matrix3f(
        [[precision.array(values[:, i, j]) for j in range(3)] for i in range(3)]
    )


def turns() -> np.ndarray:
    """(N, 3), radians: every size from nothing to almost half a turn, about every axis."""
    rng = np.random.default_rng(0)
    angles = np.concatenate([[0], 10.0 ** np.arange(-20, 0.4, 0.1), np.linspace(1, 3.1, 50)])
    at = MIN_TURN_RAD * (1 + np.array([-1e-2, -1e-6, 1e-6, 1e-2]))
    angles = np.concatenate([angles, at])
    axes = rng.normal(size=(len(angles), 3))
    axes[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    axes[-20:-14] = axes[:6]
    return single(angles[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True))


@both_precisions
def test_rotation_vector_gives_rotation_about_its_axis_by_its_length(precision):
    actual = np.moveaxis(np.array(rotation_matrix(precision.vectors(turns()))), -1, 0)
    expected = Rotation.from_rotvec(turns()).as_matrix()
    # Some roundings of numbers of size one. Measured: 4e-16 and 2e-7.
    tolerance = {FLOAT64: 2e-15, FLOAT32: 1e-6}[precision]
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance)


@both_precisions
def test_rotation_vector_inverts_rotation_matrix(precision):
    rotations = Rotation.from_rotvec(turns()).as_matrix()
    actual = rows(rotation_vector(matrices(rotations, precision)))
    angles = np.linalg.norm(turns(), axis=1)
    # The entries' roundings; next to half a turn, over the sine that tells the axis. Below
    # SLOWEST the angle is its sine: off by SLOWEST^3 / 6.
    tolerance = {FLOAT64: 1e-14, FLOAT32: 1e-6}[precision] / np.sin(np.clip(angles, 0.5, 3.1))
    errors = np.abs(actual - turns()).max(axis=1)
    assert (errors <= tolerance + (angles < 2 * MIN_TURN_RAD) * 2e-13).all()


def test_derivatives_at_zero_rotation_match_small_rotations():
    """(a_x)' = e_x: nothing is divided by an angle of zero."""
    turn = FLOAT64.vectors(np.zeros((1, 3)))
    dr.enable_grad(turn)
    matrix = rotation_matrix(turn)
    dr.backward(matrix[2, 1] + 10 * matrix[0, 2] + 100 * matrix[1, 0] + 1000 * matrix[0, 0])
    assert rows(dr.grad(turn)).tolist() == [[1, 10, 100]]
    rotation = matrices(np.eye(3)[None], FLOAT64)
    dr.enable_grad(rotation)
    dr.backward(rotation_vector(rotation).y)
    gradient = np.array(dr.grad(rotation))[..., 0]
    np.testing.assert_allclose(gradient, [[0, 0, 0.5], [0, 0, 0], [-0.5, 0, 0]], atol=1e-15)
