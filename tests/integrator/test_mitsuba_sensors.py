"""Mitsuba's ``thinlens`` and ``orthographic`` sensors, against the rays that they sample."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.calibrated_sensors import (
    POSES,
    SCALED,
    WINDOW,
    Calibrated,
    clear_gaussians,
    own_camera,
    own_sensor,
    scaled,
    splats_scene,
)
from support.helpers import NEAR_THRESHOLD
from support.sensors import PIXELS, camera_of, numbers, points_on_rays, project
from support.views import VIEWS, View, image_of

from drgs.reference import effects
from drgs.reference.effects import Orthographic, ThinLens


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


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


@pytest.mark.parametrize("factors", [(2.0, 2.0, 1.0), (2.0, 1.5, 1.0)])
def test_orthographic_image_matches_the_reference(factors):
    view = View("", 53, 41, crop=WINDOW, to_world=scaled(VIEWS[1].to_world, *factors))
    sensor = Calibrated("orthographic", view=view)
    camera = own_camera(view)
    plain = replace(view, to_world=VIEWS[1].to_world)
    gaussians, rendered = clear_gaussians(
        sensor,
        lambda gaussians: effects.render(
            gaussians, camera, Orthographic(), threshold_width=NEAR_THRESHOLD
        ),
        view=plain,
    )
    image = image_of(splats_scene(own_sensor("orthographic", view), gaussians))
    expected = np.concatenate([rendered.image, rendered.alpha[..., None]], axis=-1)
    np.testing.assert_allclose(image, expected[view.window], rtol=0, atol=5e-5)
    assert image[..., 3].max() > 0.8


def test_thin_lens_image_matches_the_reference():
    view = View("", 53, 41, crop=WINDOW)
    sensor = Calibrated("thin lens", view=view)
    camera, defocus = replace(view.camera, near=0.01), ThinLens(0.125, 3.0)
    gaussians, rendered = clear_gaussians(
        sensor,
        lambda gaussians: effects.render(
            gaussians, camera, defocus=defocus, threshold_width=NEAR_THRESHOLD
        ),
    )
    image = image_of(splats_scene(own_sensor("thinlens", view), gaussians))
    expected = np.concatenate([rendered.image, rendered.alpha[..., None]], axis=-1)
    np.testing.assert_allclose(image, expected[view.window], rtol=0, atol=5e-5)
    in_focus = effects.render(gaussians, camera)
    assert np.abs(in_focus.image - rendered.image)[view.window].max() > 0.05


def test_view_dependent_colours_follow_a_rolling_shutter():
    """Rays of small splats have the direction of the mean, with which colours change."""
    count = 3000
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    gaussians = {
        "means": 4 * directions,
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.full((count, 3), np.log(0.05)),
        "logit_opacities": np.full(count, 3.0),
        "sh0": np.zeros((count, 1, 3)),
        "shN": np.tile(np.eye(3), (count, 1, 1)),
    }
    tensors = {name: mi.TensorXf(value.astype(np.float32)) for name, value in gaussians.items()}
    transform = mi.ScalarTransform4f()
    sensor = {
        "type": "calibrated", "fx": 40.0, "fy": 40.0, "shutter": "rolling",
        "to_world": transform.look_at([0, 0, 0], [0, 0, 1], [0, -1, 0]),
        "to_world_close": transform.look_at([0, 0, 0], [1.2, 0, 0.7], [0, -1, 0]),
        "film": {"type": "hdrfilm", "width": 48, "height": 40, "rfilter": {"type": "box"}},
    }  # fmt: skip
    images = [
        image_of(mi.load_dict({
            "type": "scene", "sensor": sensor,
            "integrator": {"type": "splats", "sh_direction": name, **tensors},
        }))
        for name in ("mean", "pixel")
    ]  # fmt: skip
    assert np.ptp(images[0][..., :3]) > 0.5
    # Three standard deviations are 0.04 radians, over which colours of degree 1 change by 0.02.
    np.testing.assert_allclose(images[1], images[0], rtol=0, atol=0.03)
