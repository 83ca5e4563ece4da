"""Sensors of type ``batch``: images side by side, each as if its sensor were alone."""

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import bitwise, clear
from support.views import VIEWS, Scene, gradients_of, image_of, side_by_side

import drgs  # noqa: F401  (registers the plugins)
from drgs.gaussians.parameters import PARAMETER_NAMES

SCENE = Scene(VIEWS[1])
SENSORS = (VIEWS[1], VIEWS[2], VIEWS[10])


def load(sensor, wall=False, **others):
    scene = clear(SCENE)
    position = scene.camera.rotation.T @ [0, 0, 2] + scene.camera.center
    place = mi.ScalarTransform4f().translate(position)
    emitter = {"type": "area", "radiance": 0.5}
    ball = {"type": "sphere", "radius": 0.5, "to_world": place, "emitter": emitter}
    return scene.load_with(sensor, {"wall": ball} if wall else None, **others)


def batch(samples=1, rfilter="box", pixel_format="rgba", **film):
    given = {"samples": samples, "rfilter": rfilter, "pixel_format": pixel_format}
    return side_by_side(*SENSORS, **given, **film)


def weights_of(seed=2) -> np.ndarray:
    view = SENSORS[0]
    shape = view.height, len(SENSORS) * view.width, 4
    return np.random.default_rng(seed).normal(0, 1, shape).astype(np.float32)


def parts(image) -> list[np.ndarray]:
    return np.split(image, len(SENSORS), axis=1)


@pytest.mark.parametrize("wall", [False, True], ids=["splats", "hybrid"])
@pytest.mark.parametrize("pixel_format", ["rgba", "xyz"])
def test_images_are_side_by_side(wall, pixel_format):
    settings = {"aovs": "z:depth", "srgb_primitives": True, "hide_emitters": not wall}
    image = image_of(load(batch(pixel_format=pixel_format), wall, **settings))
    for part, view in zip(parts(image), SENSORS, strict=True):
        alone = image_of(load(view.sensor(pixel_format), wall, **settings))
        # A path's samples at the edge of the sphere are not the same.
        differs = np.abs(part - alone).max(axis=-1) > 1e-6
        assert differs.mean() <= (0.1 if wall else 0)


def fovs_of(loaded) -> list[str]:
    params = mi.traverse(loaded)
    return [key for key in params.keys() if key.endswith(".x_fov")]  # noqa: SIM118


def gradients(sensor, weights, keys=None) -> list[np.ndarray]:
    """Gradients for the Gaussians, and for the fields of view of the sensors."""
    loaded = load(sensor)
    of_gaussians = [f"integrator.{name}" for name in (*PARAMETER_NAMES, "background")]
    return list(gradients_of(loaded, weights, keys or of_gaussians + fovs_of(loaded), "").values())


def test_gradients_of_a_batch_are_sums_over_its_sensors():
    """Gradients for a sensor come from its part of the film."""
    weights = weights_of()
    found = gradients(batch(), weights)
    actual, of_sensors = found[: -len(SENSORS)], found[-len(SENSORS) :]
    of_each = [
        gradients(view.sensor(), part) for view, part in zip(SENSORS, parts(weights), strict=True)
    ]
    for value, *terms in zip(actual, *(one[:-1] for one in of_each), strict=True):
        size = sum(np.abs(term).max() for term in terms)
        np.testing.assert_allclose(value, sum(terms), rtol=0, atol=1e-5 * size)
    for of_sensor, (*_, alone) in zip(of_sensors, of_each, strict=True):
        assert of_sensor == pytest.approx(alone, rel=1e-4) and alone != 0
    assert bitwise(actual) == bitwise(gradients(batch(), weights)[: -len(SENSORS)])


def test_a_batch_may_contain_a_sensor_twice():
    """Its gradient is the sum of those of both parts; its name is that of its last place."""
    weights, view = weights_of(), SENSORS[0]
    twice = mi.load_dict(view.sensor())
    sensor = batch() | {"view_0": twice, "view_2": twice}
    loaded = load(sensor)
    fovs = fovs_of(loaded)
    assert len(fovs) == 2
    (found,) = gradients(sensor, weights, sorted({*fovs} - {"sensor.view_1.x_fov"}))
    for part, one in zip(parts(image_of(loaded)), (view, SENSORS[1], view), strict=True):
        np.testing.assert_array_equal(part, image_of(load(one.sensor())))
    *_, expected = gradients(view.sensor(), sum(parts(weights)[::2]))
    assert found == pytest.approx(expected, rel=1e-4)


def test_a_crop_window_is_refused():
    loaded = load(batch(crop_offset_x=3, crop_width=20))
    with pytest.raises(ValueError, match="must not have a crop window"):
        loaded.integrator().render(loaded)
