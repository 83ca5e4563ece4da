"""Positions of points in images before anything is rendered, against the float64 reference."""

from dataclasses import replace

import numpy as np
import pytest
from support.datasets import view_at
from support.lens_scenes import LENSES, PINHOLE, kernel_lens
from support.small_capture import reference_camera

from drgs.datasets.film import to_camera, to_film

LENSES = {"pinhole": PINHOLE, **LENSES}


@pytest.mark.parametrize("name", ["pinhole", "rational", "fisheye", "thin prism"])
def test_projected_points_match_the_reference(name):
    lens = LENSES[name]
    host = None if lens is PINHOLE else kernel_lens(lens)
    view = replace(view_at((3, -2, 1), (0.5, 0.25, 0)), lens=host, fy=35.0, cx=17.0)
    camera = reference_camera(view, near=1e-9)
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
