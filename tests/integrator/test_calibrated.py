"""The ``calibrated`` sensor: its rays, its parameters, and what ``splats`` sees through it.

Rays are compared with Mitsuba's own sensors, and projected again by the float64 reference.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.calibrated_sensors import (
    BARREL,
    CLOSE,
    FILM,
    FISHEYE,
    OPENCV,
    PINHOLE,
    PIXELS,
    STATIC_SENSORS,
    THIN_PRISM,
    Calibrated,
    by_name,
    clear_gaussians,
    sampled_rays,
    splats_scene,
    transform,
)
from support.lens_scenes import LENSES, points_at
from support.lenses import OpenCV
from support.views import VIEWS, gradients_of, image_of, pose, splats_before

from drgs.gaussians.parameters import PARAMETER_NAMES

MOVING = [replace(s, close=CLOSE) for s in (PINHOLE, OPENCV, FISHEYE)]
ROLLING = [replace(s, shutter="rolling") for s in MOVING]


def row_times(sensor, sample) -> np.ndarray:
    """Return times of rows of the whole film, not of the crop window."""
    return (sample[:, 1] * sensor.size[1] + sensor.corner[1]) / sensor.view.height


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
def test_pinhole_rays_match_perspective(view):
    camera = view.camera
    focal, principal = (float(camera.fx),) * 2, (float(camera.cx), float(camera.cy))
    sensor = Calibrated("", view=view, f=focal, c=principal).load()
    (ray, weight, _), (expected, _, _) = map(
        sampled_rays, (sensor, mi.load_dict(view.sensor())), (0.25, 0.25)
    )
    assert (weight == 1).all()
    # Some roundings of numbers of size one; the origins are at the near plane.
    np.testing.assert_allclose(np.array(ray.d), np.array(expected.d), rtol=0, atol=5e-7)
    np.testing.assert_allclose(np.array(ray.o), np.array(expected.o), rtol=0, atol=2e-7)
    np.testing.assert_allclose(np.array(ray.maxt), np.array(expected.maxt), rtol=5e-7)
    np.testing.assert_array_equal(np.array(ray.time), np.array(expected.time))


@pytest.mark.parametrize(
    ("sensor", "time", "exposed", "shutter"),
    [
        *((sensor, 0.0, 0.0, {}) for sensor in STATIC_SENSORS),
        *((sensor, time, time, {}) for sensor in MOVING for time in (0.0, 0.375, 1.0)),
        (MOVING[0], 2.5, 0.25, {"shutter_open": 2.0, "shutter_close": 4.0}),
        (MOVING[0], 2.0, 0.0, {"shutter_open": 2.0, "shutter_close": 2.0}),
        *((sensor, 0.75, None, {}) for sensor in ROLLING),  # whatever the ray's time
    ],
    ids=lambda value: getattr(value, "name", str(value)),
)
def test_points_on_rays_project_to_their_pixels(sensor, time, exposed, shutter):
    """The reference's camera is that at the time of the exposure, or of the row."""
    ray, weight, sample = sampled_rays(sensor.load(**shutter), time)
    assert (weight == 1).all() and (np.array(ray.time) == time).all()
    distances = np.random.default_rng(4).uniform(1, 8, dr.width(ray.o))
    world = np.array(ray(mi.Float(distances))).T.astype(np.float64)
    expected = sample * sensor.size + sensor.corner
    times = row_times(sensor, sample) if exposed is None else np.full(200, exposed)
    for point, place, at in zip(world, expected, times, strict=True):
        camera = sensor.camera_at(at)
        points = (point[None] - camera.center) @ camera.rotation.T
        assert sensor.lens.is_seen(camera, points).all()
        assert np.abs(sensor.lens.film_points(camera, points) - place).max() < PIXELS


# Its image is a circle of a radius of 16 px.
WIDE_FISHEYE = Calibrated(
    "wide fisheye", LENSES["plain fisheye"], FILM, f=(5.5, 5.5), c=(19.0, 14.0)
)


@pytest.mark.parametrize("sensor", [BARREL, WIDE_FISHEYE], **by_name)
def test_rays_outside_the_lens_have_zero_weight(sensor):
    ray, weight, sample = sampled_rays(sensor.load(), count=2000)
    points = points_at(sensor.lens, sensor.camera, sample * sensor.size, np.ones(2000))
    shown = ~np.isnan(points).any(axis=1)
    assert 0.2 < shown.mean() < 0.9
    assert set(weight) == {0, 1}
    # At the fold itself, to within the hundredth of a pixel that the sensor allows.
    assert (weight != shown).mean() < 2e-3
    assert np.isfinite(np.array(ray.o)).all()
    np.testing.assert_allclose(np.linalg.norm(np.array(ray.d), axis=0), 1, atol=1e-6)


@pytest.mark.parametrize("sensor", [*STATIC_SENSORS, ROLLING[1], BARREL], **by_name)
def test_ray_differentials_are_rays_of_neighbouring_pixels(sensor):
    loaded = sensor.load()
    sample = np.random.default_rng(0).uniform(0.1, 0.8, (2, 50)).astype(np.float32)
    arguments = (0.0, 0.5, mi.Point2f(sample), mi.Point2f(0.5))
    ray, weight = loaded.sample_ray_differential(*arguments)
    assert ray.has_differentials
    plain, plain_weight = loaded.sample_ray(*arguments)
    for a, b in ((ray.o, plain.o), (ray.d, plain.d), (weight, plain_weight)):
        np.testing.assert_array_equal(np.array(a), np.array(b))
    for axis, o, d in ((0, ray.o_x, ray.d_x), (1, ray.o_y, ray.d_y)):
        step = np.zeros((2, 1), np.float32)
        step[axis] = 1 / sensor.size[axis]
        beside, _ = loaded.sample_ray(0.0, 0.5, mi.Point2f(sample + step), mi.Point2f(0.5))
        # The sample is one rounding away.
        np.testing.assert_allclose(np.array(d), np.array(beside.d), rtol=0, atol=1e-6)
        np.testing.assert_allclose(np.array(o), np.array(beside.o), rtol=0, atol=1e-6)


@pytest.mark.parametrize("sensor", [*STATIC_SENSORS, ROLLING[1]], **by_name)
def test_rays_end_at_the_far_plane(sensor):
    """From depth ``near_clip`` to ``far_clip``: z, with a fisheye the distance."""
    near_view = replace(sensor.view, near_clip=0.5)
    loaded = replace(sensor, view=near_view).load(far_clip=8.0)
    ray, _, sample = sampled_rays(loaded)
    for world, depth in ((ray.o, 0.5), (ray(ray.maxt), 8.0)):
        places = np.array(world).T.astype(np.float64)
        for place, time in zip(places, row_times(sensor, sample), strict=True):
            camera = sensor.camera_at(time)
            point = (place - camera.center) @ camera.rotation.T
            assert sensor.lens.depths(camera, point[None])[0] == pytest.approx(depth, rel=2e-6)


@pytest.mark.parametrize(
    ("sensor", "name"),
    [(OPENCV, name) for name in ("fx", "cy", "k1", "p2")]
    + [(THIN_PRISM, name) for name in ("fx", "k1", "p2", "sy1")],
    ids=lambda value: getattr(value, "name", value),
)
def test_rays_are_differentiable_in_the_calibration(sensor, name):
    """Against central differences, in single precision; the search for a ray is not unrolled."""
    loaded = sensor.load()
    params = mi.traverse(loaded)
    value = float(params[name][0])
    sample = mi.Point2f(np.random.default_rng(0).uniform(size=(2, 20)).astype(np.float32))

    def directions(value) -> mi.Vector3f:
        params[name] = value
        params.update()
        return loaded.sample_ray(0.0, 0.5, sample, mi.Point2f(0.5))[0].d

    step = 2.0**-6 if name in ("fx", "cy") else 2.0**-10
    after, before = (np.array(directions(mi.Float(value + s)), float) for s in (step, -step))
    expected = (after - before) / (2 * step)
    attached = mi.Float(value)
    dr.enable_grad(attached)
    d = directions(attached)
    dr.forward(attached, flags=dr.ADFlag.ClearEdges)
    # Differences: 1e-7 / step of rounding, step^2 times a third derivative.
    size = np.abs(expected).max()
    np.testing.assert_allclose(np.array(dr.grad(d)), expected, rtol=0, atol=3e-3 * size)


SPLATS_SENSORS = [
    replace(sensor, view=replace(FILM, crop=(5, 4, 26, 21)), close=CLOSE, shutter=shutter)
    for sensor in (PINHOLE, OPENCV, FISHEYE)
    for shutter in ("global", "rolling")
]


@pytest.mark.parametrize(
    "sensor",
    [*STATIC_SENSORS, BARREL, *(pytest.param(s, marks=pytest.mark.slow) for s in SPLATS_SENSORS)],
    ids=lambda s: f"{s.name}, {s.shutter if s.close else 'static'}",
)
def test_splats_through_the_sensor_match_the_reference(sensor):
    gaussians, rendered = clear_gaussians(sensor)
    image = image_of(splats_scene(sensor, gaussians))
    expected = np.concatenate([rendered.image, rendered.alpha[..., None]], axis=-1)
    expected = expected[sensor.view.window]
    # Tolerance of test_rendering in float32; Mitsuba's numbers are float32 too.
    np.testing.assert_allclose(image, expected, rtol=0, atol=5e-5)
    assert image[..., 3].max() > 0.8
    if sensor.close:
        still = image_of(splats_scene(replace(sensor, close=None), gaussians))
        assert np.abs(still - expected).max() > 0.02


def test_sharing_kernels_among_poses_changes_no_byte(monkeypatch):
    """More poses than :data:`PASSES_PER_KERNEL` are compiled in parts."""
    gaussians, _ = clear_gaussians(SPLATS_SENSORS[0])
    sensor = SPLATS_SENSORS[0].dictionary(shutter_samples=5)
    weights = np.random.default_rng(1).normal(0, 1, (21, 26, 4))
    results = []
    for poses in (16, 2):
        monkeypatch.setattr("drgs.integrator.image_render.PASSES_PER_KERNEL", poses)
        gradients = gradients_of(splats_scene(sensor, gaussians), weights, PARAMETER_NAMES)
        results.append({"image": image_of(splats_scene(sensor, gaussians)), **gradients})
    for name, expected in results[0].items():
        np.testing.assert_array_equal(results[1][name], expected, err_msg=name)


# ----------------------------------------------------------------------------------------------
# Parameters
# ----------------------------------------------------------------------------------------------


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
    ({"lens": "opencvv"}, f'lens: no lens is called "opencvv"; did you mean opencv?; {LENS_NAMES}'),
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
