"""Mitsuba's ``thinlens`` and ``orthographic`` sensors, against the rays that they sample."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from support.calibrated_sensors import POSES, SCALED, WINDOW, own_sensor
from support.sensors import PIXELS, camera_of, numbers, points_on_rays, project
from support.views import View


@pytest.mark.parametrize("crop", [None, WINDOW])
@pytest.mark.parametrize("to_world", POSES.values(), ids=POSES)
def test_points_on_thin_lens_rays_project_to_their_pixels(crop, to_world):
    """Rays go through the middle of the aperture."""
    view = View("", 53, 41, crop=crop, to_world=to_world)
    sensor = mi.load_dict(own_sensor("thinlens", view))
    points, expected = points_on_rays(sensor)
    camera = camera_of(sensor)
    assert np.abs(project(camera, points) - expected).max() < PIXELS


@pytest.mark.parametrize("to_world", POSES.values(), ids=POSES)
def test_thin_lens_rays_start_on_the_aperture_and_meet_in_focus(to_world):
    """Rays of one place on the film."""
    view = View("", 53, 41, to_world=to_world)
    sensor = mi.load_dict(own_sensor("thinlens", view))
    camera = camera_of(sensor)
    sample = np.random.default_rng(0).uniform(size=(2, 1000)).astype(np.float32)
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.3, 0.7), mi.Point2f(sample))
    c = numbers(camera)
    origins, directions = (
        c["rotation"] @ (np.array(v).astype(np.float64) - shift)
        for v, shift in ((ray.o, c["center"][:, None]), (ray.d, 0))
    )
    on_aperture = origins - directions * origins[2] / directions[2]
    radius, focus_distance = (
        float(v[0]) for v in (camera.aperture.radius, camera.aperture.focus_distance)
    )
    assert np.linalg.norm(on_aperture, axis=0).max() == pytest.approx(radius, rel=0.01)
    in_focus = on_aperture + directions * focus_distance / directions[2]
    # Positions of up to 10 units in float32.
    assert np.ptp(in_focus, axis=1).max() < 1e-5 * focus_distance
    assert (radius, focus_distance) == pytest.approx((0.125, 3.0), rel=1e-6)


@pytest.mark.parametrize("crop", [None, WINDOW])
@pytest.mark.parametrize("to_world", (POSES | SCALED).values(), ids=POSES | SCALED)
def test_points_on_orthographic_rays_project_to_their_pixels(crop, to_world):
    view = View("", 53, 41, crop=crop, to_world=to_world)
    sensor = mi.load_dict(own_sensor("orthographic", view))
    points, expected = points_on_rays(sensor)
    camera = camera_of(sensor)
    c = numbers(camera)
    x, y, z = c["rotation"] @ (points - c["center"]).T
    film = np.stack([x, y], axis=-1) * c["focal"] + c["principal"]
    assert np.abs(film - expected).max() < PIXELS and (z > 0).all()
