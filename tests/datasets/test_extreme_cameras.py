"""Cameras that no image can have are refused, and none makes NumPy warn."""

import json
import warnings

import numpy as np
import pytest

from drgs.core.errors import UserError
from drgs.datasets.orbits import near_plane_of, orbit_of_gaussians
from drgs.datasets.viewpoints import look_at, read_viewpoints
from drgs.gaussians.parameters import Gaussians

POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]


@pytest.fixture(autouse=True)
def warnings_are_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"fl_x": 1e-300}, "fl_x must be between 0.16 and 160000 px for 16 px, got 1e-300"),
        ({"fl_x": 1e300}, "fl_x must be between 0.16 and 160000 px for 16 px, got 1e+300"),
        ({"fl_y": 1e-300}, "fl_y must be between 0.12 and 120000 px for 12 px, got 1e-300"),
        ({"w": 1e9}, "w must be <= 16777216, got 1000000000.0"),
        ({"h": 1e20}, "h must be <= 16777216, got 1e+20"),
        ({"h": 1e-300}, "h must be >= 1, got 1e-300"),
        ({"cx": 1e300, "cy": 0.0}, "cx must be within 1600 px of the image, got 1e+300"),
        (
            {"k1": 1e308},
            "camera_model: k1 must be a coefficient of at most 1e+06 in size, got 1e+308",
        ),
        (
            {"p2": -2e6},
            "camera_model: p2 must be a coefficient of at most 1e+06 in size, got -2e+06",
        ),
        ({"cx": 8.0, "cy": -1e5}, "cy must be within 1200 px of the image, got -100000"),
    ],
)
def test_invalid_camera_parameters_are_refused(tmp_path, values, message):
    meta = {"w": 16, "h": 12, "fl_x": 20.0, **values, "frames": [{"transform_matrix": POSE}]}
    (tmp_path / "a.json").write_text(json.dumps(meta))
    with pytest.raises(UserError) as error:
        read_viewpoints(tmp_path / "a.json", None)
    assert str(error.value).startswith(f"{tmp_path}/a.json: {message}")


def test_camera_is_scaled_to_the_requested_size(tmp_path):
    meta = {"w": 16, "h": 12, "fl_x": 20.0, "cx": 8.0, "cy": 6.0}
    (tmp_path / "a.json").write_text(json.dumps({**meta, "frames": [{"transform_matrix": POSE}]}))
    (view,) = read_viewpoints(tmp_path / "a.json", (32, 24))
    assert (view.fx, view.cx, view.cy, view.width, view.height) == (40, 16, 12, 32, 24)


@pytest.mark.parametrize("where", ["origin", "target"])
@pytest.mark.parametrize("size", [1e10, 1e300, np.nan])
def test_coordinates_beyond_float32_resolution_are_refused(where, size):
    places = {"origin": (0, -4, 1), "target": (0, 0, 0), where: (0, size, 0)}
    with pytest.raises(UserError, match=f"camera: the coordinates of {where} must be at most"):
        look_at(**places, up=(0, 0, 1))


@pytest.mark.parametrize(("size", "near"), [(1e38, 1e9), (1e-30, 1e-9)])
def test_near_planes_are_within_limits_for_scenes_of_any_size(size, near):
    means = np.random.default_rng(0).normal(size=(20, 3)) * size
    ones = np.ones((20, 4))
    gaussians = Gaussians.from_numpy(means, ones, ones[:, :3], 0.5 * ones[:, 0], ones[:, None, :3])
    assert near_plane_of(gaussians) == near


@pytest.mark.parametrize("length", [1e-100, 0.3, 1e100])
def test_up_may_have_any_length(length):
    up = length * np.array([0.6, 0, 0.8])
    expected = look_at((0, -4, 1), (0, 0, 0), (0.6, 0, 0.8))
    np.testing.assert_allclose(look_at((0, -4, 1), (0, 0, 0), up), expected, rtol=0, atol=1e-15)
    zeros = {"quats": 4, "log_scales": 3}
    gaussians = Gaussians(
        means=np.float32([[0, 0, 0], [1, 2, 3]]),
        **{name: np.zeros((2, width), np.float32) for name, width in zeros.items()},
        logit_opacities=np.float32([1, 1]),
        sh0=np.zeros((2, 1, 3), np.float32),
        shN=np.zeros((2, 0, 3), np.float32),
    )
    found = orbit_of_gaussians(gaussians, up, 40.0).up
    np.testing.assert_allclose(found, (0.6, 0, 0.8), rtol=0, atol=1e-15)
