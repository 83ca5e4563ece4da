"""``splats`` among Mitsuba's sensors, films, samplers and ways to call: see ``docs/mitsuba.md``."""

from __future__ import annotations

import gc
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.calibrated_sensors import (
    CLOSE,
    FISHEYE,
    OPENCV,
    PINHOLE,
    POSES,
    SCALED,
    SHUTTER_SAMPLES,
    WINDOW,
    camera_of,
    numbers,
    own_camera,
    own_sensor,
)
from support.helpers import clear
from support.kernels import kernel_hashes
from support.openexr import read_exr
from support.splats_checks import GRADIENTS, IMAGE
from support.splats_checks import XYZ as TO_XYZ
from support.views import VIEWS, Scene, View, gradient, image_of, pose, tensors
from support.wall_scenes import Wall

import drgs  # noqa: F401  (registers the plugins)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.io.scenes import openexr_threads

VIEW = View("", 53, 41, crop=WINDOW)
OWN_VIEWS = {name: replace(VIEW, to_world=to_world) for name, to_world in (POSES | SCALED).items()}
ROLLING, BLURRED = (replace(OPENCV, close=CLOSE, shutter=s) for s in ("rolling", "global"))

SENSORS = {
    "perspective": (VIEW.sensor, lambda _: VIEW.camera),
    "thinlens": (lambda: own_sensor("thinlens", VIEW), lambda _: VIEW.camera),
    **{
        f"orthographic, {name}": (
            lambda view=view: own_sensor("orthographic", view),
            lambda _, view=view: own_camera(view),
        )
        for name, view in OWN_VIEWS.items()
    },
    **{
        name: (lambda sensor=sensor: sensor.dictionary(), sensor.camera_at)
        for name, sensor in {
            "calibrated": PINHOLE,
            "opencv": OPENCV,
            "fisheye": FISHEYE,
            "rolling shutter": ROLLING,
            "global shutter": BLURRED,
        }.items()
    },
}
"""Sensors, and their cameras at a time of the shutter."""


def depths(name, normal, offset) -> np.ndarray:
    """(H, W) of a plane along the sensor's own rays, the mean over the times."""
    make, camera_at = SENSORS[name]
    sensor = mi.load_dict(make())
    rows, columns = VIEW.window
    height, width = rows.stop - rows.start, columns.stop - columns.start
    y, x = (np.mgrid[:height, :width] + 0.5) / np.array([height, width])[:, None, None]
    found = []
    for time in (np.arange(SHUTTER_SAMPLES) + 0.5) / SHUTTER_SAMPLES:
        place = mi.Point2f(x.ravel().astype(np.float32), y.ravel().astype(np.float32))
        ray, _ = sensor.sample_ray(float(time), 0.5, place, mi.Point2f(0.5))
        start, towards = (np.array(v, np.float64).T for v in (ray.o, ray.d))
        points = start + towards * ((offset - start @ normal) / (towards @ normal))[:, None]
        points = points.reshape(height, width, 3)
        times = (np.arange(height) + rows.start + 0.5) / VIEW.height
        times = times if name == "rolling shutter" else np.full(height, time)
        cameras = [camera_at(t) for t in times]
        offsets = [p - c.center for p, c in zip(points, cameras, strict=True)]
        if name == "fisheye":  # of which depths are distances
            found.append(np.linalg.norm(offsets, axis=-1))
        else:
            found.append([p @ c.rotation[2] for p, c in zip(offsets, cameras, strict=True)])
    return np.mean(found, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_depth_of_a_plane_matches_rays_for_every_sensor(name):
    """Without a splat in sight."""
    make, camera_at = SENSORS[name]
    camera, plane = camera_at(0.0), Wall(5.0, (-0.2, 0.3), 100.0)
    behind = np.float32(np.tile(camera.center - 50 * camera.rotation[2], (4, 1)))
    scene = Scene(count=4)
    gaussians = replace(scene.gaussians, means=behind)
    objects = {"plane": plane.shape(camera)}
    image = image_of(scene.load_with(make(), objects, gaussians, aovs="z:depth, a:alpha"))
    normal = plane.axes()[2] @ camera.rotation
    expected = depths(name, normal, normal @ (camera.center + camera.rotation[2] * plane.z))
    assert np.ptp(expected) > 0.1 and (image[..., 5] == 1).all()
    # Positions of up to 10 units in float32, seen along rays that are 30 degrees off the normal.
    np.testing.assert_allclose(image[..., 4], expected, rtol=2e-5)


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


COLORS = {"luminance": TO_XYZ[1:2], "xyz": TO_XYZ, "rgb": np.eye(3)}


@pytest.mark.parametrize("component_format", ["float16", "float32"])
@pytest.mark.parametrize("alpha", [False, True], ids=["without alpha", "with alpha"])
@pytest.mark.parametrize("colors", COLORS)
def test_every_film_format_has_the_same_image(colors, alpha, component_format, tmp_path):
    scene = clear(Scene(srgb_primitives=True))
    names = {"luminance": "luminance_alpha", "xyz": "xyza", "rgb": "rgba"}
    pixel_format = names[colors] if alpha else colors
    loaded = scene.load(pixel_format=pixel_format, component_format=component_format)
    image = image_of(loaded)
    expected = scene.image()
    expected = np.dstack([expected[..., :3] @ COLORS[colors].T, *([expected[..., 3]] * alpha)])
    # Mitsuba rounds the weights of luminance to four digits.
    tolerance = 1e-3 if colors == "luminance" else IMAGE
    np.testing.assert_allclose(image, expected, rtol=0, atol=tolerance * expected.max())
    path = str(tmp_path / "image.exr")
    with openexr_threads():
        loaded.sensors()[0].film().write(path)
    bitmap = read_exr(path)
    assert bitmap.component_format() == getattr(mi.Struct.Type, component_format.capitalize())
    written = np.array(bitmap).astype(np.float64).reshape(image.shape)
    # The colours of float32 are converted anew.
    rounding, least = {"float16": (2**-11, 1e-6), "float32": (2**-22, 0)}[component_format]
    np.testing.assert_allclose(written, image, rtol=rounding, atol=least)


@pytest.mark.parametrize(
    "film",
    [{}, {"samples": 3}, {"samples": 2, "rfilter": "gaussian"}],
    ids=["one sample", "box", "gaussian"],
)
def test_develop_false_leaves_images_in_the_film(film):
    loaded = Scene(count=12).load(**film)
    assert dr.width(loaded.integrator().render(loaded, seed=2, develop=False)) == 0
    developed = np.array(loaded.sensors()[0].film().develop())
    # Other filters than a box are added up in an order that varies.
    np.testing.assert_allclose(developed, image_of(loaded, seed=2), rtol=0, atol=1e-6)


def test_two_renders_are_both_differentiated_at_the_current_parameters():
    """The backward pass knows the scene as it is then."""
    before, after = clear(Scene()), clear(Scene(seed=100))
    loaded = before.load()
    params = mi.traverse(loaded)
    first, second = before.weights(1), before.weights(2)

    def enable():
        for name in PARAMETER_NAMES:
            dr.enable_grad(params[f"integrator.{name}"])

    enable()
    loss = dr.sum(mi.render(loaded, params) * mi.TensorXf(np.float32(first)), axis=None)
    for name, value in tensors(after.gaussians).items():
        params[f"integrator.{name}"] = value
    params.update()
    enable()
    loss += dr.sum(mi.render(loaded, params) * mi.TensorXf(np.float32(second)), axis=None)
    dr.backward(loss)
    expected = after.gradients(first + second)
    for name in PARAMETER_NAMES:
        actual = gradient(params[f"integrator.{name}"])
        tolerance = GRADIENTS * np.abs(expected[name]).max()
        np.testing.assert_allclose(actual, expected[name], rtol=0, atol=tolerance)
    assert loaded.integrator().last.means2d_grad.shape == (40, 2)


@pytest.mark.slow
def test_dr_freeze_is_refused_without_side_effects():
    gc.collect()  # scenes of other tests that die while Dr.Jit records change its own message
    scene = Scene()
    loaded = scene.load()
    params, expected = mi.traverse(loaded), image_of(loaded)
    integrator, weights = loaded.integrator(), mi.TensorXf(np.float32(scene.weights()))
    for call in (
        lambda weights: mi.render(loaded) * weights,
        lambda weights: integrator.render_forward(loaded, params) * weights,
        lambda weights: integrator.render_backward(loaded, params, weights),
    ):
        with pytest.raises(RuntimeError) as caught:
            dr.freeze(call)(weights)
        error = caught.value
        while error.__cause__ is not None:
            error = error.__cause__
        assert str(error) == (
            "splats: rendering cannot be recorded by dr.freeze, as it reads counts back from the "
            "device: call mi.render outside of the frozen function"
        )
        assert np.array_equal(image_of(loaded), expected)


def test_a_camera_far_from_the_origin_keeps_its_centre():
    """A translation -R c would have lost 0.06 units there, and 2 px on a film."""
    position = (1e6, -2e6, 5e5)
    view = View("far", to_world=pose([0.3, -1.0, 0.5], 40, position))
    camera = numbers(camera_of(mi.load_dict(view.sensor())))
    assert np.array_equal(camera["center"], position)


def test_unsupported_sensors_are_refused_by_name():
    sensor = mi.load_dict({"type": "batch", "id": "mine", "first": VIEWS[0].sensor()})
    message = (
        r"^splats: the sensor must be of type perspective, thinlens, orthographic or calibrated, "
        r"got \w+ 'mine'$"
    )
    with pytest.raises(TypeError, match=message):
        read_sensor(sensor, 0.01)


def test_sensors_of_all_poses_and_sizes_share_kernels():
    """No number of the sensor, its film or its crop window is compiled into a kernel."""

    def kernels(fov=40.0, turn=30, **film):
        pose_of_sensor = mi.ScalarTransform4f(pose([1, 2, 3], turn, (turn, 2, 3)))
        film = {"type": "hdrfilm", **film}
        sensor = mi.load_dict(
            {"type": "perspective", "film": film, "fov": fov, "to_world": pose_of_sensor}
        )
        return kernel_hashes(lambda: dr.eval(camera_from_sensor(read_sensor(sensor, 0.01))))

    first = kernels(width=33, height=21)
    assert first and kernels(fov=50.0, turn=70, width=57, height=40) == first
    window = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 11, "crop_height": 9}
    assert kernels(width=33, height=21, **window) == first
