"""From dataset views and Gaussians to Mitsuba objects that render the same image."""

from dataclasses import fields, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.calibrated_sensors import camera_of, numbers
from support.cases import APPROXIMATIONS
from support.helpers import NEAR_THRESHOLD, assert_arrays_agree
from support.viewer_rendering import VIEWER_RENDERING
from support.views import View as Perspective
from support.views import image_of, pose, splats_before

import drgs
from drgs.bench.scenes import bench_gaussians
from drgs.cameras.camera import cameras_in_time
from drgs.cameras.fisheye import Fisheye
from drgs.cameras.lens import Pinhole
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye
from drgs.cameras.viewpoints import CameraMotion
from drgs.config.approximations import Approximations
from drgs.config.schema import DataConfig, ModelConfig
from drgs.core.errors import UserError
from drgs.datasets.types import View
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.scene import SQUARE_PIXEL_TOLERANCE, make_scene, make_sensors, render_views
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.reference import splatting as reference

BACKGROUND = (0.875, 0.375, 0.1875)


def make_view(width=37, height=23, fx=30.0, fy=30.0, cx=20.5, cy=9.25, name="view"):
    """An oblique camera with an off-centre principal point."""
    camera_to_world = np.array(pose([0.3, -1.0, 0.5], 40, (0.4, -0.7, 1.1)))
    image = np.zeros((height, width, 3), np.float32)
    return View(name, camera_to_world, fx, fy, cx, cy, width, height, image=image)


def make_gaussians(view, count=40, degree=2, seed=0):
    """numpy Gaussians before ``view``; the first is behind it, the second very near."""
    focal = (view.fx * view.fy) ** 0.5
    fov = float(np.degrees(2 * np.arctan(view.width / 2 / focal)))
    offset = (0.5 - view.cx / view.width, 0.5 - view.cy / view.height)
    to_world = view.camera_to_world @ np.diag([-1.0, -1.0, 1.0, 1.0])
    before = Perspective(
        "", view.width, view.height, fov, offset=offset, to_world=tuple(map(tuple, to_world))
    )
    g = splats_before(before, degree, count, seed)
    return Gaussians(**{n: getattr(g, n).astype(np.float32) for n in PARAMETER_NAMES})


@pytest.mark.parametrize("samples", [None, 3])
def test_sensor_of_a_moving_view_has_the_configured_shutter_samples(samples):
    """The configuration sets their number; the default is the sensor's own."""
    data = DataConfig(path=".", **({} if samples is None else {"shutter_samples": samples}))
    view = make_view()
    view = replace(view, motion=CameraMotion(view.camera_to_world, "global", data.shutter_samples))
    (sensor,) = make_sensors([view])
    expected = mi.load_dict({"type": "calibrated"}).shutter_samples if samples is None else samples
    assert sensor.shutter_samples == expected
    state = read_sensor(sensor, 0.0)
    assert len(cameras_in_time(camera_from_sensor(state))) == expected


def test_views_of_one_size_share_a_film():
    wide, tall = make_view(), make_view(23, 37, cx=8.0, cy=20.0)
    a, b, c = (sensor.film() for sensor in make_sensors([wide, tall, replace(wide, fx=31, fy=31)]))
    assert a is c and a is not b
    assert [list(film.size()) for film in (a, b)] == [[37, 23], [23, 37]]


@pytest.mark.parametrize(
    "lens",
    [
        None,
        RadialTangential.from_coefficients(k1=-0.2, p2=0.01),
        Fisheye.from_coefficients(k1=0.1),
        ThinPrismFisheye.from_coefficients(k1=0.1, sx1=0.01),
    ],
)
def test_cameras_unsupported_by_mitsuba_become_calibrated_sensors(lens):
    view = replace(make_view(fx=30.0, fy=33.0), lens=lens)
    (sensor,) = make_sensors([view])
    camera = camera_of(sensor)
    actual = numbers(camera)
    assert type(sensor).__name__ == "CalibratedSensor"
    assert actual["rotation"] == pytest.approx(view.camera_to_world[:3, :3].T, abs=1e-7)
    assert actual["center"] == pytest.approx(view.center, rel=1e-7)
    assert actual["focal"].tolist() == [30, 33]
    assert actual["principal"].tolist() == [20.5, 9.25]
    expected = {} if lens is None else lens.coefficients()
    named = {name: float(value[0]) for name, value in camera.lens.coefficients().items()}
    assert named == pytest.approx(expected, rel=1e-7)
    assert type(camera.lens) is (Pinhole if lens is None else type(lens))


def test_nearly_square_pixels_move_by_less_than_the_tolerance():
    view = make_view(fx=30.0, fy=30.01)
    (sensor,) = make_sensors([view])
    assert sensor.class_name() == "PerspectiveCamera"
    camera = numbers(camera_of(sensor))
    corners = np.array([[0, 0], [view.width, view.height]]) - [view.cx, view.cy]
    shift = corners * (camera["focal"] / [view.fx, view.fy] - 1)
    assert 0.002 < np.abs(shift).max() < SQUARE_PIXEL_TOLERANCE


@pytest.mark.parametrize(
    ("count", "antialiased", "near"),
    [(40, False, 0.01), (40, True, 0.25), *((count, False, 0.01) for count in (1, 2, 3, 4, 16))],
)
def test_a_scene_renders_the_views_image_in_display_space(count, antialiased, near):
    """Mitsuba turns three numbers into a colour, four or sixteen could be a matrix."""
    view, rows = make_view(), slice(3, 3 + count) if count < 40 else slice(None)
    parameters = {name: getattr(make_gaussians(view), name)[rows] for name in PARAMETER_NAMES}
    model = ModelConfig(low_pass=0.3, antialiased=antialiased, near=near)
    scene = make_scene(Gaussians(**parameters), model, BACKGROUND)
    image = image_of(scene, sensor=make_sensors([view])[0])
    camera = reference.Camera(
        view.camera_to_world[:3, :3].T, view.center, view.fx, view.fy, view.cx, view.cy,
        view.width, view.height, near,
    )  # fmt: skip
    rendered = reference.render(
        reference.Gaussians(**parameters), camera, BACKGROUND, antialiased=antialiased,
        threshold_width=NEAR_THRESHOLD,
    )  # fmt: skip
    assert not rendered.near_threshold.any(), "choose another seed"
    # Tolerance of test_splats.
    assert_arrays_agree({"image": image}, {"image": rendered.image}, 1e-5)


def test_derivatives_work_between_images_of_an_unfinished_iterator():
    """A command that was interrupted leaves images that nobody takes."""
    view = make_view()
    scene = make_scene(make_gaussians(view), ModelConfig(**VIEWER_RENDERING), BACKGROUND)
    renders = render_views(scene, [view] * 3)
    next(renders)
    x = mi.Float(2)
    dr.enable_grad(x)
    dr.backward(x * x)
    assert dr.grad(x) == 4


def test_approximations_reach_the_integrator():
    values = APPROXIMATIONS["all three, other cuts"] | {"falloff": "gaussian", "extent": 3.0}
    values |= {"low_pass": 0.1, "antialiased": True}
    assert set(values) == {field.name for field in fields(Approximations)}
    scene = make_scene(bench_gaussians(5), ModelConfig(**values), (1.0, 1.0, 1.0))
    assert scene.integrator().state.approximations == Approximations(**values)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"fov_axis": "y", "principal_point_offset_x": 0.1, "principal_point_offset_y": -0.2},
        {"film": {"crop_offset_x": 5, "crop_offset_y": 3, "crop_width": 20, "crop_height": 10}},
    ],
)
def test_view_of_a_sensor_sees_along_its_rays(changes):
    """Also the sensor of that view, by Mitsuba's own rays."""
    film = {"type": "hdrfilm", "width": 40, "height": 24, **changes.get("film", {})}
    pose = mi.ScalarTransform4f().look_at([3, -2, 1], [0.2, 0.1, 0], [0, 0, 1])
    sensor = {"type": "perspective", "fov": 35, "to_world": pose, **changes, "film": film}
    sensor = mi.load_dict(sensor)
    view = drgs.view_from_sensor(sensor, "a")
    assert (view.name, view.width, view.height) == ("a", *sensor.film().crop_size())
    size = np.array([view.width, view.height])
    for pixel in np.array([[0.5, 0.5], [3.2, 9.0], [18.0, 1.5]]):
        there = mi.Point2f((pixel / size).tolist())
        expected = view.camera_to_world[:3, :3] @ np.linalg.inv(view.K) @ [*pixel, 1]
        expected /= np.linalg.norm(expected)
        for each in (sensor, drgs.sensor_from_view(view)):
            ray, _ = each.sample_ray(0.0, 0.5, there, mi.Point2f(0.5))
            # float32: unit vectors, and points that are 4 from the origin.
            np.testing.assert_allclose(np.ravel(ray.d), expected, atol=1e-6)
            origin = np.ravel(ray.o) - np.ravel(ray.d) * (np.ravel(ray.o) - view.center).dot(ray.d)
            np.testing.assert_allclose(origin, view.center, atol=1e-5)


def test_sensors_that_are_no_pinholes_have_no_view():
    lens = {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.0}
    for sensor in (lens, {"type": "orthographic"}):
        with pytest.raises(UserError, match=r"view_from_sensor\(\): the sensor must be a pinhole"):
            drgs.view_from_sensor(mi.load_dict(sensor))
