"""Parameters of the ``calibrated`` sensor: followed, differentiated, refused."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.calibrated_sensors import (
    BARREL,
    CLOSE,
    FILM,
    OPENCV,
    PINHOLE,
    sampled_rays,
    splats_scene,
    transform,
)
from support.views import image_of, pose, splats_before

from drgs.reference.effects import OpenCV

OTHER_POSE = pose([1, 2, 3], 30, (0.5, -0.6, 1.0))

CHANGES = {
    **{"to_world": OTHER_POSE, "to_world_close": OTHER_POSE},
    **{"fx": 33.0, "fy": 33.0, "cx": 19.0, "cy": 19.0, "k1": -0.125, "p1": -0.03125},
}

MOVING_SENSOR = replace(OPENCV, close=CLOSE, shutter="rolling")


@pytest.mark.parametrize("name", CHANGES)
def test_changed_parameter_takes_effect(name):
    value = CHANGES[name]
    is_pose = name.startswith("to_world")
    expected = MOVING_SENSOR.load(**{name: transform(value) if is_pose else value})
    gaussians = splats_before(MOVING_SENSOR.view, 1, 40, 0)
    scene = splats_scene(MOVING_SENSOR, gaussians)
    before = image_of(scene)
    sensor = scene.sensors()[0]
    params = mi.traverse(scene)
    own = [key for key in params.keys() if not key.startswith("integrator.")]  # noqa: SIM118
    key = next(key for key in own if key.split(".")[-1] == name)
    params[key] = transform(value) if is_pose else mi.Float(value)
    params.update()
    (ray, weight, _), (other, other_weight, _) = map(sampled_rays, (sensor, expected))
    np.testing.assert_allclose(np.array(ray.d), np.array(other.d), rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.array(ray.o), np.array(other.o), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(weight, other_weight)
    image = image_of(scene)
    np.testing.assert_array_equal(image, image_of(scene, sensor=expected))
    assert np.abs(image - before).max() > 0.01


def test_valid_region_of_the_lens_follows_its_coefficients():
    scene = splats_scene(BARREL, splats_before(FILM, 1, 40, 0))
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.endswith("k1"))  # noqa: SIM118
    params[key] = mi.Float(-0.0625)
    params.update()
    sensor = scene.sensors()[0]
    assert sensor.lens.max_squared_radius == pytest.approx(1 / (3 * 0.0625))
    _, weight, _ = sampled_rays(sensor)
    assert (weight == 1).all()


def test_missing_coefficients_are_not_exposed():
    own = {k for k in mi.traverse(PINHOLE.load()).keys() if not k.startswith(("film", "shutter_"))}  # noqa: SIM118
    assert own - {"near_clip", "far_clip"} == {"to_world", "fx", "fy", "cx", "cy"}
    assert PINHOLE.load().to_world_close is None
    keys = set(mi.traverse(replace(OPENCV, lens=OpenCV(k1=0.125)).load()).keys())
    assert "k1" in keys and not keys & {"k2", "k3", "k4", "p1", "to_world_close"}
    assert "to_world_close" in mi.traverse(MOVING_SENSOR.load()).keys()  # noqa: SIM118


LENS_NAMES = (
    "there are equirectangular, fisheye, opencv, pinhole, thin_prism_fisheye (others come with "
    'installed packages that have an entry point of the group "drgs")'
)

REFUSED = [
    (
        {"lens": "opencvv"},
        f'lens: no lens is called "opencvv"; did you mean opencv?; {LENS_NAMES}',
    ),
    ({"lens": 3}, f'lens: no lens is called "3"; {LENS_NAMES}'),
    ({"lens": "fisheye", "k5": 0.1}, "lens 'fisheye' has the coefficients k1, k2, k3, k4, got k5"),
    ({"k1": 0.1}, "lens 'pinhole' has no coefficients, got k1"),
    ({"lens": "equirectangular", "k1": 0.1}, "lens 'equirectangular' has no coefficients, got k1"),
    (
        {"lens": "equirectangular", "fx": 10.0, "cy": 3.0},
        "the film of lens 'equirectangular' is a whole turn, whatever fx and cy; leave them out",
    ),
    ({"fx": "long"}, "fx must be a positive number, got 'long'"),
    ({"cx": True}, "cx must be a finite number, got True"),
    ({"fy": 0.0}, "fy must be a positive number, got 0.0"),
    ({"cy": np.inf}, "cy must be a finite number, got inf"),
    ({"lens": "opencv", "k1": "a"}, "k1 must be a finite number, got 'a'"),
    ({"near_clip": -1.0}, "near_clip must be a positive number, got -1.0"),
    ({"far_clip": 0.005}, "far_clip must be larger than near_clip, 0.01, got 0.005"),
    ({"shutter": "leaf"}, "shutter must be one of global, rolling, got 'leaf'"),
    ({"shutter_samples": 0}, "shutter_samples must be an integer from 1 to 1000, got 0"),
    ({"shutter_samples": 1001}, "shutter_samples must be an integer from 1 to 1000, got 1001"),
    ({"shutter_samples": 2.5}, "shutter_samples must be an integer from 1 to 1000, got 2.5"),
    (
        {"lens": "fisheye", "k2": 1e7},
        "k2 must be a coefficient of at most 1e+06 in size, got 1e+07; calibrate the camera again",
    ),
    ({"to_world_close": 3.0}, "to_world_close must be a transform, got float"),
    ({"shutter_sample": 3}, "there is no parameter shutter_sample; did you mean shutter_samples?"),
]


@pytest.mark.parametrize(("values", "message"), REFUSED, ids=str)
def test_wrong_values_are_refused(values, message):
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({"type": "calibrated", **values})
    kind, _, found = str(caught.value).strip().splitlines()[-1].partition(": calibrated: ")
    assert kind.endswith(("PluginError", "PluginTypeError"))
    assert found.startswith(message)


def test_documented_defaults_are_used():
    sensor = mi.load_dict({"type": "calibrated", "film": {"type": "hdrfilm", "width": 30}})
    width, height = sensor.film().size()
    values = [float(v[0]) for v in (sensor.fx, sensor.fy, sensor.cx, sensor.cy)]
    assert values == [30, 30, 15, height / 2] and width == 30
    focal = mi.load_dict({"type": "calibrated", "fx": 43.5})
    assert (float(focal.fx[0]), float(focal.fy[0])) == (43.5, 43.5)
    assert (sensor.near_clip(), sensor.far_clip(), sensor.shutter_samples) == (0.01, 1e4, 8)
    assert not sensor.needs_aperture_sample() and sensor.shutter_open_time() == 0
    moving = MOVING_SENSOR.load()
    assert (moving.shutter_open(), moving.shutter_open_time()) == (0, 1)
