"""Gaussians for viewers in closed form, against the formulas in float64."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.small_capture import blobs, double, make_dataset, reference_camera

from drgs.config.approximations import Approximations
from drgs.effects.smoothing import MIN_VARIANCE_SHARE, bake_for_viewers
from drgs.integrator.scene import make_sensors
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.reference import splatting as reference

VIEWS = make_dataset(train=3, test=1).train


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def small_blobs():
    """Return blobs of half a pixel to three: some lose all variance that they may lose."""
    gaussians = blobs(40)
    return replace(gaussians, log_scales=gaussians.log_scales - np.float32(np.log(4)))


def cameras():
    states = [read_sensor(sensor, 0.2) for sensor in make_sensors(VIEWS)]
    return [camera_from_sensor(state) for state in states]


def film_of(gaussians, view):
    """Whether the view shows each mean, px per scene unit there, and covariances on the film."""
    g, camera = double(gaussians), reference_camera(view)
    x, y, z = points = camera.rotation @ (g.means - camera.center).T
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    seen = (z > 0.2) & (u >= 0) & (v >= 0) & (u <= camera.width) & (v <= camera.height)
    covariances = []
    for row, covariance in enumerate(reference.covariances(g.quats, g.log_scales)):
        px, py, pz = points[:, row]
        jacobian = np.array(
            [
                [camera.fx / pz, 0, -camera.fx * px / pz**2],
                [0, camera.fy / pz, -camera.fy * py / pz**2],
            ]
        )
        to_film = jacobian @ camera.rotation
        covariances.append(to_film @ covariance @ to_film.T)
    return seen, camera.fx / z, np.array(covariances)


@pytest.mark.parametrize(
    ("fitted", "shown"),
    [
        ({"low_pass": 0.1, "antialiased": True}, 0.3),
        ({"low_pass": 0.05}, 0.3),
        ({"antialiased": True}, 0.3),
        ({"low_pass": 0.1, "antialiased": True}, 0.15),
    ],
)
def test_baking_matches_the_documented_closed_form(fitted, shown):
    gaussians, fitted = small_blobs(), Approximations(**fitted)
    viewers = Approximations(low_pass=shown)
    found = bake_for_viewers(gaussians.to(mi.TensorXf), cameras(), fitted, viewers)

    films = [film_of(gaussians, view) for view in VIEWS]
    nu = np.max([seen * rate for seen, rate, _ in films], axis=0)
    assert (nu > 0).all()
    variances = np.exp(2 * gaussians.log_scales.astype(float))
    left = variances - ((shown - fitted.low_pass) / nu**2)[:, None]
    left = np.maximum(left, MIN_VARIANCE_SHARE * variances)
    if fitted.low_pass < 0.3 == shown:
        assert 0.05 < np.mean(left == MIN_VARIANCE_SHARE * variances) < 0.95
    np.testing.assert_allclose(found.log_scales, np.log(left) / 2, atol=2e-5)

    before = after = 0.0
    shrunk = replace(gaussians, log_scales=np.log(left) / 2)
    for (seen, _, old), (_, _, new) in zip(
        films, [film_of(shrunk, view) for view in VIEWS], strict=True
    ):
        wide = np.linalg.det(old + fitted.low_pass * np.eye(2))
        before = before + seen * np.sqrt(np.linalg.det(old) if fitted.antialiased else wide)
        after = after + seen * np.sqrt(np.linalg.det(new + shown * np.eye(2)))
    expected = before / after / (1 + np.exp(-gaussians.logit_opacities.astype(float)))
    opacities = 1 / (1 + np.exp(-found.logit_opacities.astype(float)))
    np.testing.assert_allclose(opacities, np.minimum(expected, 1), rtol=1e-4)
    for name in ("means", "quats", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(found, name), getattr(gaussians, name))


def test_gaussians_that_viewers_render_exactly_are_unchanged(tmp_path):
    gaussians = small_blobs()
    found = bake_for_viewers(gaussians.to(mi.TensorXf), cameras(), Approximations())
    np.testing.assert_allclose(found.log_scales, gaussians.log_scales, atol=1e-6)
    np.testing.assert_allclose(found.logit_opacities, gaussians.logit_opacities, atol=1e-5)


def test_unseen_gaussians_keep_their_opacities():
    gaussians = small_blobs()
    behind = replace(gaussians, means=gaussians.means + np.float32([0, 0, 100]))
    found = bake_for_viewers(
        behind.to(mi.TensorXf), cameras(), Approximations(low_pass=0.1, antialiased=True)
    )
    assert np.isfinite(found.log_scales).all()
    np.testing.assert_allclose(found.logit_opacities, gaussians.logit_opacities, atol=1e-5)
