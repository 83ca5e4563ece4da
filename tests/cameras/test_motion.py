"""Cameras that move, against the float64 reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Cotangents,
    assert_images_agree,
    both_precisions,
    clear,
    device_gaussians,
    frame_adjoint,
    image_planes,
    plane_cotangents,
    rows,
)
from support.lens_scenes import IMAGE, LENSES, lens_camera, planes_of
from support.motion_checks import MovingCase, time_of

from drgs.cameras.camera import cameras_in_time
from drgs.cameras.motion import Motion, MotionBlur, RollingShutter
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import effects
from drgs.reference import splatting as reference
from drgs.splatting import rendering

KINDS = {name: LENSES.get(name, effects.Pinhole()) for name in ("pinhole", "rational", "fisheye")}


def case_of(name, **others) -> MovingCase:
    return MovingCase(name, 37, 29, 1, 20, lens=KINDS[name], **others)


@both_precisions
@pytest.mark.parametrize("turn", [0.0, 1e-5, 0.06, 2.5])
def test_poses_match_the_reference(precision, turn):
    case = case_of("pinhole", turn=turn, travel=3.0)
    camera = case.device_camera(precision)
    for time in (0.0, 0.25, 1.0):
        actual = camera.shutter.pose(camera, precision.Float(time))
        expected = case.camera_at(time)
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
    case = clear(case_of("pinhole", samples=samples))
    zero = precision.Array3f(0, 0, 0)
    camera = lens_camera(case.camera, case.lens, precision)
    moving = RollingShutter(zero, zero) if samples == 0 else MotionBlur(zero, zero, samples)
    gaussians = device_gaussians(case.gaussians, precision)
    plain = planes_of(rendering.render(gaussians, camera, case.pipeline))
    cameras = cameras_in_time(replace(camera, shutter=moving))
    assert len(cameras) == max(samples, 1)
    for at_time in cameras:
        planes = planes_of(rendering.render(gaussians, at_time, case.pipeline))
        np.testing.assert_array_equal(planes, plain)


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize(
    ("name", "turn"), [("pinhole", 0.06), ("pinhole", 0.3), ("rational", 0.06), ("fisheye", 0.1)]
)
def test_rolling_shutter_matches_splats_at_the_time_of_their_row(precision, name, turn):
    """Found by bisection and secants in the reference. Some are never read: above, or below."""
    case = clear(case_of(name, samples=0, turn=turn))
    times = np.array([time_of(case, mean) for mean in case.gaussians.means])
    assert (times == 0).any() and (times == 1).any() and ((times > 0) & (times < 1)).sum() >= 8
    _, (frame,) = case.frames(precision)
    assert_images_agree(image_planes(frame, case), case.rendered, IMAGE[precision])
    still = effects.render(*case.scene, case.lens, case.background)
    assert np.abs(case.rendered.image - still.image).max() > 0.02


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
    device = lens_camera(camera, effects.Pinhole(), FLOAT64)
    end = lens_camera(close, effects.Pinhole(), FLOAT64)
    motion = Motion.relative_motion(device, end.rotation, end.center)
    device = replace(device, shutter=RollingShutter(*motion))
    frame = rendering.render(device_gaussians(gaussians, FLOAT64), device, rendering.Pipeline(0))
    alpha = 1 - planes_of(frame)[0].reshape(height, 32)
    expected = effects.render_rolling_shutter(gaussians, camera, close)
    rows_of_splats = y.astype(int)
    np.testing.assert_allclose(
        alpha[rows_of_splats], expected.alpha[rows_of_splats], rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("samples", [2, 0], ids=["motion blur", "rolling"])
@pytest.mark.parametrize(("turn", "travel"), [(0.5, 2.0), (2.5, 50.0), (3.0, 1e5)])
@pytest.mark.parametrize("name", ["pinhole", "fisheye"])
def test_fast_camera_motion_stays_finite(samples, turn, travel, name):
    """Past the splats, through them, away from them; and positions that are no numbers."""
    case = case_of(name, samples=samples, turn=turn, travel=travel)
    means = case.gaussians.means.copy()
    means[-3:] = [[np.nan, 0, 0], [0, np.inf, 0], [-np.inf, np.nan, np.inf]]
    cotangents = Cotangents.random(replace(case, samples=0, turn=0.0, travel=0.0))
    d_features, d_transmittance = plane_cotangents(case, cotangents, FLOAT32)
    gaussians, frames = case.frames(FLOAT32, gaussians=replace(case.gaussians, means=means))
    for frame in frames:
        assert np.isfinite(planes_of(frame)).all()
        gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance)
        for parameter in PARAMETER_NAMES:
            values = np.array(getattr(gradients.parameters, parameter))
            assert np.isfinite(values).all() and not values[-3:].any(), parameter
