"""Default camera positions of a capture."""

import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from drgs.capture.camera_placement import (
    hemisphere,
    perspective_sensors,
    settings_for,
    views_around,
    views_of,
)
from drgs.capture.path_tracing import CaptureCamera, CaptureSettings, bounding_box
from drgs.core.errors import UserError

LAMP = {
    "type": "sphere",
    "radius": 0.1,
    "center": [0.3, 0.2, 0.7],
    "emitter": {"type": "area", "radiance": 10.0},
}
SKY = {"type": "constant"}

BALL = {
    "type": "sphere",
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.05, 0.2, 0.6]}},
}


def loaded(**parts):
    return mi.load_dict({"type": "scene", **parts})


def sensor(origin, target, up=(0, 1, 0), fov=40.0, width=8):
    film = {"type": "hdrfilm", "width": width, "height": 8, "rfilter": {"type": "box"}}
    return {
        "type": "perspective",
        "fov": fov,
        "fov_axis": "smaller",
        "to_world": mi.ScalarTransform4f().look_at(list(origin), list(target), list(up)),
        "film": film,
        "sampler": {"type": "multijitter"},
    }


def ring(count):
    """Sensors around a ball, each with a field of view of its own."""
    angles = 2 * np.pi * np.arange(count) / count
    return {
        f"sensor{k:02d}": sensor((4 * math.cos(a), 1.0, 4 * math.sin(a)), (0, 0, 0), fov=40.0 + k)
        for k, a in enumerate(angles)
    }


def derived(scene, **given):
    return settings_for(scene, CaptureSettings(**given), given.keys())


def centers(scene, settings):
    return np.array([view.pose[:3, 3] for view in views_of(scene, settings)])


def test_one_sensor_decides_up_distance_target_and_field_of_view():
    # It looks past the middle at (1.5, 2, 3); the film's smaller side spans 30 degrees.
    seen_from = sensor((1.5, 2, 9), (1.5, 2, 3), fov=30.0, width=16)
    scene = loaded(ball={"type": "sphere", "center": [1, 2, 3]}, sky=SKY, sensor=seen_from)
    settings = derived(scene)
    assert (settings.cameras, settings.up) == ("around", "y")
    assert settings.target == pytest.approx((1.5, 2, 3), abs=1e-5)
    assert settings.distance == pytest.approx(6, abs=1e-5)
    assert math.degrees(settings.fov) == pytest.approx(30, abs=1e-4)
    assert derived(scene, size=(20, 10)).narrower_fov == pytest.approx(settings.fov)
    given = derived(scene, fov=0.5, up="x")
    assert (given.fov, given.up, given.target, given.distance) == (0.5, "x", None, None)


def test_up_may_point_down_the_axis():
    scene = loaded(ball=BALL, sky=SKY, s=sensor((5, -1, 0), (0, 0, 0), (0, -1, 0)))
    settings = derived(scene)
    assert settings.up == "-y"
    assert (centers(scene, settings)[:, 1] < 0).all()
    for view in views_of(scene, settings):
        assert view.pose[1, 1] < 0, "upside down"
        assert np.linalg.det(view.pose[:3, :3]) == pytest.approx(1)


def test_many_sensors_are_used_as_cameras():
    scene = loaded(ball=BALL, sky=SKY, **ring(17))
    settings = derived(scene, size=(8, 8), spp=64)
    assert (settings.cameras, settings.views, settings.test_views) == ("sensors", 14, 3)
    views = views_of(scene, settings)
    assert [view.split for view in views] == ["train"] * 14 + ["test"] * 3
    assert [view.index for view in views] == [*range(14), *range(3)]
    order = [n for n in range(17) if n % 8] + [0, 8, 16]
    camera = CaptureCamera(scene, settings)
    integrator = mi.load_dict({"type": "path", "hide_emitters": True})
    for view, number in zip(views, order, strict=True):
        assert math.degrees(view.fov) == pytest.approx(40 + number, abs=1e-4)
        # Rendered by Mitsuba through the sensor itself. At an edge, 64 samples in
        # 8x8 strata err by 1/8 of the largest channel, 0.6, at most.
        own = scene.sensors()[number]
        shown = np.array(mi.render(scene, sensor=own, integrator=integrator, spp=64))
        np.testing.assert_allclose(camera.linear(view)[:, :, :3], shown[:, :, :3], atol=0.075)


SENSORS = {"cameras": "sensors"}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (SENSORS, "--cameras sensors: the scene has no sensor of type"),
        ({"azimuth": (30.0, -30.0)}, "azimuth must be two angles in rising order between -360"),
        ({"elevation": (-91.0, 0.0)}, "elevation must be two angles in rising order between -90"),
        ({"elevation": (0.0, math.nan)}, "elevation must be two angles"),
    ],
)
def test_contradictory_settings_are_refused(given, message):
    scene = loaded(ball=BALL, sky=SKY)
    with pytest.raises(UserError, match=message):
        views_of(scene, derived(scene, **given))


def test_placement_options_are_refused_with_sensors():
    scene = loaded(ball=BALL, sky=SKY, **ring(12))
    values = {"views": 3, "test_views": 1, "target": (0.0, 0.0, 0.0), "distance": 2.0, "fov": 0.5}
    for name, value in (values | {"azimuth": (0.0, 1.0)}).items():
        assert derived(scene, **{name: value}).cameras == "around"
        message = f"^--{name.replace('_', '-')}: is not used with --cameras sensors; leave it out$"
        with pytest.raises(UserError, match=message):
            derived(scene, **SENSORS, **{name: value})


@pytest.mark.parametrize("up", ["x", "y", "z", "-z"])
def test_angles_fill_their_ranges_evenly(up):
    ranges = {"azimuth": (-30.0, 60.0), "elevation": (-10.0, 40.0)}
    settings = CaptureSettings(test_views=200, up=up, **ranges)
    views = views_around(settings, np.array([1.0, 2.0, 3.0]), 2.0)[-200:]
    offsets = np.array([(view.pose[:3, 3] - [1, 2, 3]) / 2 for view in views])
    sign = -1 if up.startswith("-") else 1
    axis = "xyz".index(up[-1])
    level = sign * offsets[:, [(axis + 1) % 3, (axis + 2) % 3]]
    azimuth = np.degrees(np.arctan2(level[:, 1], level[:, 0]))
    height = sign * offsets[:, axis]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 1)
    low, high = np.sin(np.radians([-10, 40]))
    for values, first, last in ((azimuth, -30, 60), (height, low, high)):
        assert first - 1e-9 <= values.min() and values.max() <= last + 1e-9
        # Each tenth of the range has a tenth of the cameras: the spiral leaves no gaps.
        counts, _ = np.histogram(values, 10, (first, last))
        assert np.abs(counts - 20).max() <= 2


@pytest.mark.parametrize("jitter", [0.0, 1.0])
def test_directions_are_spread_evenly_over_the_upper_hemisphere(jitter):
    count = 100
    directions = hemisphere(count, jitter, np.random.default_rng(3))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    assert (directions[:, 2] > 0).all()
    np.testing.assert_allclose(directions[:, 2], (np.arange(count) + 0.5) / count, atol=0.5 / count)
    # No gaps: a direction in the hemisphere has a camera within two mean spacings,
    # sqrt(2 pi / 100) = 14 degrees.
    probes = np.random.default_rng(0).normal(size=(500, 3))
    probes[:, 2] = abs(probes[:, 2])
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    assert np.degrees(np.arccos((probes @ directions.T).max(axis=1))).max() < 28


def test_splits_and_seeds_have_different_cameras():
    settings = CaptureSettings(views=5, val_views=5, test_views=5)
    views = [
        *views_around(settings, np.zeros(3), 4.0),
        *views_around(replace(settings, seed=1), np.zeros(3), 4.0),
    ]
    centers = np.array([view.pose[:3, 3] for view in views])
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    assert distances[~np.eye(len(centers), dtype=bool)].min() > 0.01


def test_sensors_of_other_types_are_no_cameras():
    scene = loaded(a=sensor((0, 0, 4), (0, 0, 0)), b={"type": "orthographic"})
    assert len(perspective_sensors(scene)) == 1


@pytest.mark.parametrize(
    ("shape", "message"),
    [(LAMP, "no surfaces that cameras could see"), ({"type": "sphere", "radius": 0.0}, "a size")],
)
def test_scene_without_extent_is_refused(shape, message):
    with pytest.raises(UserError, match=message):
        bounding_box(loaded(shape=shape))


def test_light_that_is_not_finite_is_refused_with_its_pixel(monkeypatch):
    scene = loaded(ball=BALL, sky=SKY)
    settings = derived(scene)
    light = np.ones((8, 8, 4))
    light[2, 5] = np.inf
    monkeypatch.setattr(CaptureCamera, "linear", lambda *_: light)
    view = views_of(scene, settings)[0]
    with pytest.raises(UserError, match="the light at pixel x 5, y 2 is not finite"):
        CaptureCamera(scene, settings).image(view)
