"""Sensors that move, through the plugin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.calibrated_sensors import (
    CLOSE,
    FILM,
    FISHEYE,
    OPENCV,
    PINHOLE,
    clear_gaussians,
    splats_scene,
)
from support.helpers import single
from support.lens_scenes import directions, moved
from support.motion_checks import MovingCase
from support.views import gradients_of, image_of

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference

SAMPLES = 3
SENSORS = [
    replace(sensor, view=replace(FILM, crop=(5, 4, 26, 21)), close=CLOSE, shutter=kind)
    for sensor in (PINHOLE, OPENCV, FISHEYE)
    for kind in ("global", "rolling")
]


def image_by_reference(sensor, gaussians, threshold_width=1e-4) -> reference.RenderedImage:
    """Render the whole film on black."""
    camera = replace(sensor.camera, near=0.01)
    case = PluginCase(
        "plugin", camera.width, camera.height, 1, lens=sensor.lens, near_camera=camera,
        far_camera=replace(sensor.close_camera, near=0.01),
        samples=SAMPLES if sensor.shutter == "global" else 0,
    )  # fmt: skip
    return case.reference_image(gaussians, threshold_width)


@dataclass(frozen=True, eq=False)
class PluginCase(MovingCase):
    """With cameras of its own, on black. Its hash is its identity."""

    near_camera: reference.Camera = None
    far_camera: reference.Camera = None

    camera = property(lambda self: self.near_camera)
    close_camera = property(lambda self: self.far_camera)
    background = property(lambda self: np.zeros(3))


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: f"{s.name}, {s.shutter}")
def test_calibrated_sensor_image_matches_the_reference(sensor):
    gaussians, rendered = clear_gaussians(
        sensor, lambda gaussians: image_by_reference(sensor, gaussians)
    )
    scene = splats_scene(sensor.dictionary(shutter_samples=SAMPLES), gaussians)
    expected = np.concatenate([rendered.image, rendered.alpha[..., None]], axis=-1)
    np.testing.assert_allclose(image_of(scene), expected[sensor.view.window], rtol=0, atol=5e-5)
    still = image_of(splats_scene(replace(sensor, close=None), gaussians))
    assert np.abs(still - expected[sensor.view.window]).max() > 0.02


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS[:2], ids=lambda s: f"{s.name}, {s.shutter}")
def test_gradients_add_up_over_the_times(sensor):
    """Gradients of mi.render in single precision, against differences of the float64 reference."""
    gaussians, _ = clear_gaussians(
        sensor, lambda gaussians: image_by_reference(sensor, gaussians, threshold_width=1e-3)
    )
    rows_of_window, columns = sensor.view.window
    shape = rows_of_window.stop - rows_of_window.start, columns.stop - columns.start, 4
    weights = single(np.random.default_rng(1).normal(0, 1, shape))
    scene = splats_scene(sensor.dictionary(shutter_samples=SAMPLES), gaussians)
    gradients = gradients_of(scene, weights, PARAMETER_NAMES)
    step = 1e-6

    def loss(sign, direction) -> np.ndarray:
        rendered = image_by_reference(sensor, moved(gaussians, direction, sign * step))
        image = np.concatenate([rendered.image, rendered.alpha[..., None]], axis=-1)
        return weights * image[sensor.view.window]

    for parameter, direction in directions(gaussians, seed=2).items():
        expected = np.sum(loss(1, direction) - loss(-1, direction)) / (2 * step)
        terms = getattr(direction, parameter) * gradients[parameter]
        assert abs(terms.sum() - expected) <= 2e-5 * np.abs(terms).sum(), parameter
        assert abs(1.01 * terms.sum() - expected) > 2e-5 * np.abs(terms).sum(), parameter


def test_sharing_kernels_among_poses_changes_no_byte(monkeypatch):
    """More poses than :data:`PASSES_PER_KERNEL` are compiled in parts."""
    gaussians, _ = clear_gaussians(
        SENSORS[0], lambda gaussians: image_by_reference(SENSORS[0], gaussians)
    )
    sensor = SENSORS[0].dictionary(shutter_samples=5)
    weights = np.random.default_rng(1).normal(0, 1, (21, 26, 4))
    results = []
    for poses in (16, 2):
        monkeypatch.setattr("drgs.integrator.sensor_render.PASSES_PER_KERNEL", poses)
        gradients = gradients_of(splats_scene(sensor, gaussians), weights, PARAMETER_NAMES)
        results.append({"image": image_of(splats_scene(sensor, gaussians)), **gradients})
    for name, expected in results[0].items():
        np.testing.assert_array_equal(results[1][name], expected, err_msg=name)
