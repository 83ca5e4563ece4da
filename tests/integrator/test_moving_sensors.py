"""Sensors that move, through the plugin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
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
from support.helpers import (
    single,
)
from support.lens_scenes import directions, moved
from support.motion_checks import MovingCase
from support.views import gradients_of, image_of

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference

# ----------------------------------------------------------------------------------------------
# Through the plugin
# ----------------------------------------------------------------------------------------------


@pytest.fixture
def variant():
    mi.set_variant("llvm_ad_rgb")


SENSORS = [
    replace(sensor, view=replace(FILM, crop=(5, 4, 26, 21)), close=CLOSE, shutter=kind)
    for sensor in (PINHOLE, OPENCV, FISHEYE)
    for kind in ("global", "rolling")
]


SAMPLES = 3


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
def test_calibrated_sensor_image_matches_the_reference(variant, sensor):
    gaussians, rendered = clear_gaussians(
        sensor, lambda gaussians: image_by_reference(sensor, gaussians)
    )
    scene = splats_scene(replace_samples(sensor), gaussians)
    expected = np.concatenate([rendered.image, rendered.alpha[..., None]], axis=-1)
    np.testing.assert_allclose(image_of(scene), expected[sensor.view.window], rtol=0, atol=5e-5)
    still = image_of(splats_scene(replace(sensor, close=None), gaussians))
    assert np.abs(still - expected[sensor.view.window]).max() > 0.02


def replace_samples(sensor) -> dict:
    return sensor.dictionary(shutter_samples=SAMPLES)


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS[:2], ids=lambda s: f"{s.name}, {s.shutter}")
def test_gradients_add_up_over_the_times(variant, sensor):
    """Gradients of mi.render in single precision, against differences of the float64 reference."""
    gaussians, _ = clear_gaussians(
        sensor, lambda gaussians: image_by_reference(sensor, gaussians, threshold_width=1e-3)
    )
    rows_of_window, columns = sensor.view.window
    shape = rows_of_window.stop - rows_of_window.start, columns.stop - columns.start, 4
    weights = single(np.random.default_rng(1).normal(0, 1, shape))
    scene = splats_scene(replace_samples(sensor), gaussians)
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


def test_sharing_kernels_among_poses_changes_no_byte(variant, monkeypatch):
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


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS[:2], ids=lambda s: f"{s.name}, {s.shutter}")
def test_forward_derivatives_of_a_moving_camera_are_the_transpose(variant, sensor):
    gaussians, _ = clear_gaussians(sensor, lambda gaussians: image_by_reference(sensor, gaussians))
    scene = splats_scene(replace_samples(sensor), gaussians)
    weights = single(np.random.default_rng(1).normal(0, 1, image_of(scene).shape))
    gradients = gradients_of(scene, weights, PARAMETER_NAMES)
    for parameter, direction in directions(gaussians, seed=2).items():
        # A new scene: the derivatives that were accumulated would be taken for directions.
        fresh = splats_scene(replace_samples(sensor), gaussians)
        params = mi.traverse(fresh)
        value = params[f"integrator.{parameter}"]
        dr.enable_grad(value)
        dr.set_grad(value, type(value)(getattr(direction, parameter).astype(np.float32)))
        tangent = np.array(dr.forward_to(mi.render(fresh, params))).astype(np.float64)
        left = weights * tangent
        right = getattr(direction, parameter) * gradients[parameter]
        size = np.abs(left).sum() + np.abs(right).sum()
        assert abs(left.sum() - right.sum()) <= 1e-5 * size, parameter


# ----------------------------------------------------------------------------------------------
# Only what the scene calls for
# ----------------------------------------------------------------------------------------------


RENDERING = """
import sys
sys.modules["drgs." + {blocked!r}] = None  # importing it raises ImportError
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import drgs
import numpy as np
splats = {{
    "type": "splats", "means": mi.TensorXf(np.zeros((1, 3), np.float32)),
    "quats": mi.TensorXf(np.ones((1, 4), np.float32)),
    "log_scales": mi.TensorXf(np.full((1, 3), -2, np.float32)),
    "logit_opacities": mi.TensorXf(np.ones(1, np.float32)),
    "sh0": mi.TensorXf(np.ones((1, 1, 3), np.float32)),
    "shN": mi.TensorXf(np.zeros((1, 0, 3), np.float32)),
}}
film = {{"type": "hdrfilm", "width": 8, "height": 8}}
T = mi.ScalarTransform4f
sensor = {{"to_world": T().translate([0, 0, -2]), "film": film}} | {sensor}
print(np.array(mi.render(mi.load_dict({{"type": "scene", "i": splats, "s": sensor}}))).max() > 0.1)
"""


CLOSING_POSE = '"to_world_close": T().translate([0, 0.1, -2])'


SENSOR_MODULES = {
    "lens": ('{"type": "calibrated", "lens": "opencv"}', "cameras.radial_tangential"),
    "orthographic": ('{"type": "orthographic"}', "cameras.orthographic"),
    "thin lens": ('{"type": "thinlens", "aperture_radius": 0.1}', "effects.defocus"),
    "moving": (f'{{"type": "calibrated", {CLOSING_POSE}}}', "cameras.motion"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("sensor", "module"), SENSOR_MODULES.values(), ids=SENSOR_MODULES)
def test_a_sensor_requires_its_module(run_python, sensor, module):
    """test_summary covers other sensors, and kernels without these modules."""
    result = run_python(RENDERING.format(blocked=module, sensor=sensor))
    assert result.returncode != 0 and f"drgs.{module}" in result.stderr, result.stderr
