"""Motion blur and rolling shutter against the float64 reference; turns; through the plugin."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.derivative_checks import check_against_differences, check_transpose
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Cotangents,
    assert_arrays_agree,
    assert_images_agree,
    both_precisions,
    clear,
    device_gaussians,
    frame_adjoint,
    image_planes,
    plane_cotangents,
    rows,
    single,
)
from support.lens_checks import keep_bounds, planes_of
from support.lens_scenes import LENSES, lens_camera
from support.motion_checks import MovingCase, time_of
from support.reference_scenes import rotation_about

from drgs.cameras.camera import cameras_in_time
from drgs.cameras.motion import (
    Motion,
    MotionBlur,
    RollingShutter,
)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import effects
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from drgs.splatting.projection import load_rows

# Tolerances of test_lenses.
IMAGE = {FLOAT64: 1e-11, FLOAT32: 2e-5}


GRADIENTS = {FLOAT64: 1e-12, FLOAT32: 5e-5}


# ----------------------------------------------------------------------------------------------
# Cameras that move
# ----------------------------------------------------------------------------------------------


def case_of(name, **others) -> MovingCase:
    # A fisheye's pixels are wide.
    turn = {"turn": 0.1 if name == "fisheye" else 0.06}
    return MovingCase(name, 37, 29, 1, 20, lens=KINDS[name], **(turn | others))


KINDS = {
    "pinhole": effects.Pinhole(),
    "rational": LENSES["rational"],
    "fisheye": LENSES["fisheye"],
}


all_kinds = pytest.mark.parametrize("name", KINDS)


# The images that blurred ones are a mean of have no derivatives of their own.
kinds_and_samples = pytest.mark.parametrize(
    ("name", "samples"),
    [("pinhole", 2), *((name, 0) for name in KINDS)],
    ids=["motion blur", *(f"rolling, {name}" for name in KINDS)],
)


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


# ----------------------------------------------------------------------------------------------
# Motion blur
# ----------------------------------------------------------------------------------------------


def blurred(frames, case) -> dict[str, np.ndarray]:
    """The mean of images."""
    images = [image_planes(frame, case) for frame in frames]
    return {name: np.mean([p[name] for p in images], axis=0) for name in images[0]}


@pytest.mark.parametrize(
    ("name", "precision"),
    [("pinhole", FLOAT32), ("pinhole", FLOAT64), ("rational", FLOAT32)],
    ids=["pinhole, float32", "pinhole", "rational"],
)
def test_motion_blur_equals_the_reference(precision, name):
    """Images of one camera at other places: what a lens does to each is in test_lenses."""
    case = clear(case_of(name))
    expected = effects.render_motion_blur(
        case.gaussians, case.camera, case.close_camera, 3, case.background, case.lens
    )
    assert not case.rendered.near_threshold.any()
    np.testing.assert_array_equal(expected.image, case.rendered.image)
    _, frames = case.frames(precision)
    assert len(frames) == 3
    assert_images_agree(blurred(frames, case), case.rendered, IMAGE[precision])
    still = (
        case.reference_image(case.gaussians).image
        - effects.render(*case.scene, case.lens, case.background).image
    )
    assert np.abs(still).max() > 0.03


@both_precisions
@pytest.mark.parametrize("samples", [0, 1, 4])
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
    # A second pose that is the first one, from rounded matrices.
    again = replace(case, turn=0.0, travel=0.0)
    _, frames = again.frames(precision)
    for frame in frames:
        np.testing.assert_allclose(planes_of(frame), plain, rtol=0, atol=IMAGE[precision])


# ----------------------------------------------------------------------------------------------
# Rolling shutter
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@both_precisions
@all_kinds
def test_rolling_shutter_matches_splats_at_the_time_of_their_row(precision, name):
    """Found by bisection and secants in the reference. Some are never read: above, or below."""
    case = clear(case_of(name, samples=0))
    times = np.array([time_of(case, mean) for mean in case.gaussians.means])
    assert (times == 0).any() and (times == 1).any() and ((times > 0) & (times < 1)).sum() >= 8
    _, (frame,) = case.frames(precision)
    assert_images_agree(image_planes(frame, case), case.rendered, IMAGE[precision])
    still = effects.render(*case.scene, case.lens, case.background)
    assert np.abs(case.rendered.image - still.image).max() > 0.02


def small_scene(case, rng):
    """Round splats of half a pixel and more, side by side: what a row sees of them is known."""
    camera = reference.Camera(
        rotation_about([0.3, -1.0, 0.5], 0.7), np.array([0.5, -0.75, 1.0]), 40.0, 40.0, 24.0, 20.0,
        case.width, case.height,
    )  # fmt: skip
    x, y = (v.ravel() for v in np.meshgrid(np.arange(5, 45, 9.5), np.arange(4, 38, 8.0)))
    film = np.column_stack([x, y]) + rng.uniform(-1, 1, (len(x), 2))
    z = rng.uniform(1.5, 3.0, len(x))
    slopes = (film - [24, 20]) / 40
    points = np.column_stack([slopes * z[:, None], z])
    sizes = rng.uniform(0.5, 0.8, (len(x), 1)) * z[:, None] / 40
    return (
        reference.Gaussians(
            means=points @ camera.rotation + camera.center,
            quats=np.tile([1.0, 0, 0, 0], (len(x), 1)),
            log_scales=np.log(np.repeat(sizes, 3, axis=1)),
            logit_opacities=np.full(len(x), 1.5),
            sh0=rng.uniform(-1, 1.7, (len(x), 1, 3)),
            shN=np.zeros((len(x), 0, 3)),
        ),
        camera,
    )


def test_rolling_shutter_of_small_splats_matches_an_image_per_row():
    """While a row is read, splats move by up to V / H = 4.9 px / 40 = 0.12 px; d rows from its mean
    a splat is off by so much d. With a standard deviation of sigma = 0.74 px and more, low-pass
    included, and an opacity of 0.82, alpha is off by 0.12 d 0.82 exp(-1/2) / sigma exp(-d^2 / 2
    sigma^2), at most 0.036 (d = sigma), to the first order. Measured: 0.041.
    """
    case = MovingCase("small", 48, 40, 0, 25, recipe=small_scene, turn=0.1, travel=0.05, samples=0)
    _, (frame,) = case.frames(FLOAT64)
    actual = image_planes(frame, case)
    expected = effects.render_rolling_shutter(
        case.gaussians, case.camera, case.close_camera, case.background
    )
    still = effects.render(*case.scene, background=case.background)
    middle = effects.render(case.gaussians, case.camera_at(0.5), background=case.background)
    moved_by = np.abs(
        effects.project(case.gaussians, case.close_camera).means2d
        - effects.project(*case.scene).means2d
    )
    assert 3 < moved_by.max() < 5
    errors = np.abs(actual["alpha"] - expected.alpha)
    assert errors.max() < 0.05
    for wrong in (still, middle):
        assert np.abs(wrong.alpha - expected.alpha).max() > 0.5


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


@pytest.mark.parametrize("turn", [0.03, 0.1, 0.3])
def test_times_are_found_for_fast_rotations(turn):
    """Times are fractions of the turn at which a splat is seen. Measured: 3e-15."""
    case = case_of("pinhole", samples=0, turn=turn, travel=0.0)
    camera = case.device_camera(FLOAT64)
    rows_of = load_rows(device_gaussians(case.gaussians, FLOAT64), 0)
    at = camera.shutter.camera_of(rows_of.means, camera)
    in_front = effects.project(*case.scene).visible
    found = []
    for n in np.flatnonzero(in_front):
        turned = np.array(at.rotation)[..., n] @ case.camera.rotation.T
        found.append(np.linalg.norm(Rotation.from_matrix(turned).as_rotvec()) / turn)
    expected = [time_of(case, mean) for mean in case.gaussians.means[in_front]]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


# ----------------------------------------------------------------------------------------------
# Derivatives
# ----------------------------------------------------------------------------------------------


# Tolerance of test_lenses; brentq finds times to 1e-15, which over the step is 1e-9.
DIFFERENCES = 1e-6


def kernel_gradients(case, precision, cotangents):
    """Return gradients of the mean over the times."""
    gaussians, frames = case.frames(precision)
    d_features, d_transmittance = plane_cotangents(case, cotangents, precision)
    parts = [
        frame_adjoint(gaussians, frame, d_features, d_transmittance).parameters for frame in frames
    ]
    return {n: np.mean([np.array(getattr(part, n)) for part in parts], 0) for n in PARAMETER_NAMES}


@pytest.mark.slow
@kinds_and_samples
def test_gradients_equal_differences_of_the_reference(name, samples, monkeypatch):
    case = clear(case_of(name, samples=samples, threshold_width=1e-3))
    keep_bounds(case, monkeypatch)
    terms = check_against_differences(case, kernel_gradients, DIFFERENCES)
    for parameter, of_parameter in terms.items():
        # One percent of any parameter's gradient would be noticed.
        noticed = DIFFERENCES * np.abs(of_parameter).sum()
        assert np.abs(0.01 * of_parameter.sum()) > noticed, parameter


@pytest.mark.parametrize(
    ("name", "samples", "precision"),
    [
        *(("pinhole", samples, precision) for samples in (2, 0) for precision in GRADIENTS),
        *((name, 0, FLOAT64) for name in ("rational", "fisheye")),
    ],
    ids=["blur", "blur, float32", "rolling", "rolling, float32", "rational", "fisheye"],
)
def test_adjoint_is_the_transpose_of_the_tangent(precision, name, samples):
    case = clear(case_of(name, samples=samples))
    gaussians, frames = case.frames(precision)

    check_transpose(case, precision, gaussians, frames, kernel_gradients, GRADIENTS[precision] / 5)


@pytest.mark.parametrize("samples", [2, 0], ids=["motion blur", "rolling"])
def test_single_precision_gradients_equal_double_precision(samples):
    case = clear(case_of("pinhole", samples=samples))
    cotangents = Cotangents.random(case)
    expected = kernel_gradients(case, FLOAT64, cotangents)
    assert_arrays_agree(kernel_gradients(case, FLOAT32, cotangents), expected, GRADIENTS[FLOAT32])


def test_motion_gradients_equal_central_differences():
    """A calibration of the motion needs those of a rolling shutter's travel and turn."""
    case = clear(case_of("pinhole", samples=0, threshold_width=1e-3))
    weights = single(np.random.default_rng(1).normal(size=(5, case.height * case.width)))
    gaussians, (frame,) = case.frames(FLOAT64)
    gradients = rendering.frames_adjoint(
        gaussians, [frame], [list(map(FLOAT64.array, weights))], of_camera=True
    )
    step = 1e-7
    motion = frame.camera.shutter
    # The motion's are the last of the camera's numbers.
    for n, name in enumerate(["travel"] * 3 + ["turn"] * 3):
        change = np.eye(3)[n % 3] * step
        found = []
        for sign in (1, -1):
            value = getattr(motion, name) + FLOAT64.Array3f((sign * change).tolist())
            camera = replace(frame.camera, shutter=replace(motion, **{name: value}))
            dr.make_opaque(camera)
            found.append(weights * planes_of(rendering.render(gaussians, camera, case.pipeline)))
        terms = (found[0] - found[1]) / (2 * step)
        actual = float(gradients.camera[n - 6][0])
        assert abs(actual - terms.sum()) <= 1e-6 * np.abs(terms).sum(), (name, n % 3)


# ----------------------------------------------------------------------------------------------
# Hard cases
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [2, 0], ids=["motion blur", "rolling"])
@pytest.mark.parametrize(("turn", "travel"), [(0.5, 2.0), (2.5, 50.0), (3.0, 1e5)])
@pytest.mark.parametrize(
    ("name", "precision"),
    [("pinhole", FLOAT32), ("pinhole", FLOAT64), ("fisheye", FLOAT32)],
    ids=["pinhole, float32", "pinhole", "fisheye"],
)
def test_fast_camera_motion_stays_finite(precision, samples, turn, travel, name):
    """Past the splats, through them, away from them; and positions that are no numbers."""
    case = case_of(name, samples=samples, turn=turn, travel=travel)
    means = case.gaussians.means.copy()
    means[-3:] = [[np.nan, 0, 0], [0, np.inf, 0], [-np.inf, np.nan, np.inf]]
    cotangents = Cotangents.random(replace(case, samples=0, turn=0.0, travel=0.0))
    d_features, d_transmittance = plane_cotangents(case, cotangents, precision)
    gaussians, frames = case.frames(precision, gaussians=replace(case.gaussians, means=means))
    for frame in frames:
        assert np.isfinite(planes_of(frame)).all()
        gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance)
        for parameter in PARAMETER_NAMES:
            values = np.array(getattr(gradients.parameters, parameter))
            assert np.isfinite(values).all() and not values[-3:].any(), parameter
