"""Cameras to render from: of files and on orbits; those that no image can have are refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.small_capture import FIELD_OF_VIEW, FOCUS, RADIUS, blobs, pose_around, view

from drgs.cameras.orbits import Orbit, near_plane_of, orbit_of_gaussians, orbit_of_views, up_of
from drgs.cameras.viewpoints import look_at
from drgs.core.errors import UserError, UserNote
from drgs.datasets.camera_file import read_viewpoints

pytestmark = pytest.mark.filterwarnings("error")  # no camera makes NumPy warn


def views_at(azimuths, elevations):
    poses = map(pose_around, azimuths, elevations)
    return [view(f"{i}", pose, None) for i, pose in enumerate(poses)]


def offsets_of(viewpoints):
    """(N, 3): positions of cameras from the focus."""
    return np.stack([viewpoint.camera_to_world[:3, 3] for viewpoint in viewpoints]) - FOCUS


def assert_looks_at(viewpoint, target):
    """The target is on the optical axis, in front, and projects to the middle of the image."""
    x, y, z = viewpoint.camera_to_world[:3, :3].T @ (target - viewpoint.camera_to_world[:3, 3])
    assert z > 0
    assert [x, y] == pytest.approx([0, 0], abs=1e-9 * z)
    assert (viewpoint.cx, viewpoint.cy) == (viewpoint.width / 2, viewpoint.height / 2)


@pytest.mark.parametrize("length", [1e-100, 0.3, 5.0, 1e100])
def test_look_at_is_rigid_and_keeps_up_of_any_length_upright(length):
    up = np.array([0.6, 0, 0.8])
    pose = look_at([1, 2, 3], [0, 0.5, -1], length * up)
    rotation = pose[:3, :3]
    assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert pose[:3, 3].tolist() == [1, 2, 3]
    right, down, ahead = rotation.T
    assert right @ up == pytest.approx(0, abs=1e-12) and down @ up < 0
    assert np.cross(ahead, [-1, -1.5, -4]) == pytest.approx(np.zeros(3), abs=1e-12)
    orbit = orbit_of_gaussians(blobs(), length * up, 40.0)
    np.testing.assert_allclose(orbit.up, up, rtol=0, atol=1e-15)


DEGENERATE, FAR = "must not be zero or parallel to up", "camera: the coordinates of {} must be at"


@pytest.mark.parametrize(
    ("origin", "target", "message"),
    [
        ((1, 1, 1), (1, 1, 1), DEGENERATE),
        ((0, 0, 2), (0, 0, 0), DEGENERATE),
        ((0, 1e10, 0), (0, 0, 0), FAR.format("origin")),
        ((0, np.nan, 0), (0, 0, 0), FAR.format("origin")),
        ((0, -4, 1), (0, 1e300, 0), FAR.format("target")),
    ],
)
def test_look_at_refuses_degenerate_directions(origin, target, message):
    with pytest.raises(UserError, match=message):
        look_at(origin, target, (0, 0, 1))


def test_an_orbit_is_a_circle_at_the_cameras_distance_and_height():
    views = views_at(np.arange(7) * 2 * np.pi / 7, np.linspace(0.2, 0.8, 7))
    orbit = orbit_of_views(views, blobs())
    assert orbit.focus == pytest.approx(FOCUS, abs=1e-9)
    frames = orbit.viewpoints(12, 40, 30, np.degrees(FIELD_OF_VIEW))
    assert len({frame.name for frame in frames}) == 12
    offsets = offsets_of(frames)
    assert np.linalg.norm(offsets, axis=1) == pytest.approx(np.full(12, RADIUS))
    # Camera heights of the views average to sin(0.5): not exactly, the axis is a least-squares fit.
    assert np.arcsin(offsets[:, 2] / RADIUS) == pytest.approx(np.full(12, 0.5), abs=1e-3)
    azimuths = np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0]))
    assert np.diff(azimuths) == pytest.approx(np.full(11, 2 * np.pi / 12), abs=1e-3)
    for frame in frames:
        assert_looks_at(frame, FOCUS)
        assert frame.fx == pytest.approx(20 / np.tan(FIELD_OF_VIEW / 2))


def test_orbit_stays_on_the_photographed_side():
    views = views_at(np.linspace(2.5, 4.0, 6), np.full(6, 0.1))
    offsets = offsets_of(orbit_of_views(views, blobs()).viewpoints(20, 40, 40, 40))
    swept = np.arctan2(offsets[:, 1], offsets[:, 0]) % (2 * np.pi)
    assert swept.min() > 2.5 and swept.max() < 4.0 and np.ptp(swept) > 1.0
    # There and back: no jump where the animation starts again.
    assert np.abs(np.diff(swept, append=swept[0])).max() < 0.25


def test_orbit_of_parallel_cameras_is_around_the_gaussians():
    (first,), gaussians = views_at([0], [0]), blobs()
    orbit = orbit_of_views([first, first.with_offset(np.array([0, 1, 0]))], gaussians)
    opaque = gaussians.means[gaussians.opacities >= 0.5]
    assert orbit.focus == pytest.approx(np.median(opaque, axis=0))
    assert_looks_at(orbit.viewpoints(1, 10, 10, 40)[0], orbit.focus)


def test_up_is_vertical_for_level_cameras_on_one_side():
    """The mean of the cameras' own up vectors leans over if all cameras are on one side."""
    views = views_at([0.1, 0.4, 0.5, 0.9], [0.9, 1.0, 0.8, 1.1])
    mean_up = np.mean([-v.camera_to_world[:3, 1] for v in views], axis=0)
    assert mean_up[2] / np.linalg.norm(mean_up) < 0.7
    assert up_of(views)[2] > 0.999


def test_an_orbit_of_gaussians_shows_them():
    gaussians = blobs(count=200)
    orbit = orbit_of_gaussians(gaussians, np.array([0.0, 0.0, 2.0]), fov=40)
    for frame in orbit.viewpoints(5, 50, 50, 40):
        assert_looks_at(frame, orbit.focus)
        pose = frame.camera_to_world
        x, y, z = ((gaussians.means - pose[:3, 3]) @ pose[:3, :3]).T
        u, v = frame.fx * x / z + frame.cx, frame.fy * y / z + frame.cy
        inside = (z > 0) & (u >= 0) & (u <= 50) & (v >= 0) & (v <= 50)
        assert inside.mean() >= 0.95


def test_orbit_of_cameras_at_the_zenith_is_not_degenerate():
    orbit = Orbit(FOCUS, np.eye(3)[2], np.eye(3)[0], 2.0, 1.3, None)
    assert_looks_at(orbit.viewpoints(3, 10, 10, 40)[2], FOCUS)
    views = views_at(np.arange(5.0), np.full(5, 1.55))
    assert orbit_of_views(views, blobs()).elevation < 1.4


@pytest.mark.parametrize(("size", "near"), [(1e38, 1e9), (1e-30, 1e-9)])
def test_near_planes_are_within_limits_for_scenes_of_any_size(size, near):
    means = np.random.default_rng(0).normal(size=(30, 3)) * size
    assert near_plane_of(replace(blobs(), means=means.astype(np.float32))) == near


def write_cameras(path, top, *frames):
    pose = (pose_around(0.3, 0.2) * [1, -1, -1, 1]).tolist()
    frames = [{"transform_matrix": pose, **frame} for frame in frames]
    path.write_text(json.dumps({**top, "frames": frames}))
    return path


ANGLE = {"camera_angle_x": 0.7}
FOCAL = {"w": 16, "h": 12, "fl_x": 20.0}


def test_cameras_of_a_file_are_opencv_poses_with_its_lens(tmp_path):
    path = write_cameras(tmp_path / "c.json", ANGLE, {}, {"camera_angle_x": 0.9})
    first, second = read_viewpoints(path, (64, 48))
    assert first.camera_to_world == pytest.approx(pose_around(0.3, 0.2), abs=1e-12)
    assert (first.width, first.height, first.cx, first.cy) == (64, 48, 32, 24)
    assert first.fx == first.fy == pytest.approx(32 / np.tan(0.35))
    assert second.fx == pytest.approx(32 / np.tan(0.45))
    assert (first.name, second.name) == ("camera_0", "camera_1")


def test_another_size_keeps_the_field_of_view(tmp_path):
    lens = {"fl_x": 100.0, "w": 200, "h": 100, "cx": 90.0, "cy": 60.0}
    path = write_cameras(tmp_path / "c.json", lens, {})
    (own,), (half,) = read_viewpoints(path, None), read_viewpoints(path, (100, 50))
    assert (own.fx, own.cx, own.cy, own.width, own.height) == (100, 90, 60, 200, 100)
    assert (half.fx, half.cx, half.cy) == (50, 45, 30)


@pytest.mark.parametrize(
    ("top", "size", "message"),
    [
        (ANGLE, None, "w is missing; give --size"),
        ({}, (8, 8), "camera_angle_x is missing; or give fl_x"),
        ({"camera_angle_x": 4.0}, (8, 8), "camera_angle_x must be <= 3.1015"),
        (FOCAL | {"w": -1}, None, "w must be >= 1, got -1"),
        (FOCAL | {"w": 1e9}, None, "w must be <= 16777216, got 1000000000.0"),
        (FOCAL | {"fl_y": 1e300}, None, "fl_y must be between 0.12 and 120000 px for 12 px, got"),
        (FOCAL | {"cx": 1e300, "cy": 0.0}, None, "cx must be within 1600 px of the image, got 1e"),
        (FOCAL | {"p2": -2e6}, None, "camera_model: p2 must be a coefficient of at most 1e+06 in"),
    ],
)
def test_wrong_intrinsics_are_refused_with_file_and_key(tmp_path, top, size, message):
    path = write_cameras(tmp_path / "c.json", top, {})
    with pytest.raises(UserError) as error:
        read_viewpoints(path, size)
    assert str(error.value).startswith(f"{path}: {message}")


def test_unread_keys_of_a_file_of_cameras_are_reported(tmp_path):
    path = write_cameras(tmp_path / "a.json", ANGLE | {"up": [0, 0, 1], "lens": 3}, {"dof": 0.1})
    with pytest.warns(UserNote, match=r"a.json: keys that are not read: lens, frames\[\].dof$"):
        read_viewpoints(path, (4, 3))
