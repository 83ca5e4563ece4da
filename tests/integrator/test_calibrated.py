"""The ``calibrated`` sensor: its rays, and what ``splats`` sees through it.

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
    STATIC_SENSORS,
    THIN_PRISM,
    Calibrated,
    by_name,
    clear_gaussians,
    sampled_rays,
    splats_scene,
)
from support.lens_scenes import LENSES, points_at
from support.sensors import PIXELS
from support.views import VIEWS, gradients_of, image_of

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


def test_text_of_a_sensor_contains_lens_and_focal_length():
    text = str(mi.load_dict({"type": "calibrated", "lens": "fisheye", "fx": 30.5, "k1": 0.25}))
    assert "Fisheye, k1" in text and "fx = [30.5]" in text


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
