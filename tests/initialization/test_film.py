"""Positions of points in images before anything is rendered, against the float64 reference."""

from dataclasses import replace

import numpy as np
import pytest
from support.datasets import view_at

from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye
from drgs.datasets.types import CameraMotion
from drgs.initialization.film import is_projectable, to_camera, to_film
from drgs.reference import effects as reference
from drgs.reference.splatting import Camera

OPENCV = {"k1": -0.25, "k2": 0.0625, "k4": 0.03125, "p1": 0.004, "p2": -0.002}
FISHEYE = {"k1": -0.03125, "k2": 0.015625}
THIN_PRISM = {**FISHEYE, "p1": 0.004, "p2": -0.002, "sx1": -0.01, "sy1": 0.02}

LENSES = {
    "pinhole": (None, reference.Pinhole()),
    "opencv": (RadialTangential.from_coefficients(**OPENCV), reference.OpenCV(**OPENCV)),
    "fisheye": (Fisheye.from_coefficients(**FISHEYE), reference.Fisheye(**FISHEYE)),
    "thin prism": (
        ThinPrismFisheye.from_coefficients(**THIN_PRISM),
        reference.ThinPrismFisheye(**THIN_PRISM),
    ),
}


@pytest.mark.parametrize("name", LENSES)
def test_projected_points_match_the_reference(name):
    host, lens = LENSES[name]
    view = replace(view_at((3, -2, 1), (0.5, 0.25, 0)), lens=host, fy=35.0, cx=17.0)
    intrinsics = view.fx, view.fy, view.cx, view.cy, 40, 30
    camera = Camera(view.camera_to_world[:3, :3].T, view.center, *intrinsics, 1e-9)
    points = np.random.default_rng(0).uniform(-6, 6, (500, 3))
    points[0] = view.center + 2 * view.camera_to_world[:3, 2]  # on the optical axis
    position = (points - view.center) @ view.camera_to_world[:3, :3]
    actual = to_camera(view, points.T)
    np.testing.assert_allclose(np.stack(actual, axis=1), position, atol=1e-12)
    u, v, depth = to_film(view, actual)
    assert (u[0], v[0], depth[0]) == pytest.approx((17, 15, 2))
    seen = lens.is_seen(camera, position)
    np.testing.assert_array_equal(depth > 0, seen)
    assert 100 < seen.sum() < 500 and np.isfinite([u, v]).all()
    np.testing.assert_allclose(depth[seen], lens.depths(camera, position)[seen], rtol=1e-12)
    expected = lens.film_points(camera, position)[seen]
    np.testing.assert_allclose(np.stack([u, v], axis=1)[seen], expected, rtol=1e-9, atol=1e-9)


def test_moving_camera_is_not_projectable():
    view = view_at((0, -2, 0), (0, 0, 0))
    assert is_projectable(view)
    assert not is_projectable(replace(view, motion=CameraMotion(np.eye(4), "global")))
