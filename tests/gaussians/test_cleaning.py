"""Which Gaussians a selection keeps, and models that are turned from one direction to another."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.formats import distance_of_ellipsoids, gaussians_within_ranges

from drgs.export import find_kept, take
from drgs.gaussians.similarity import rotation_towards, shortest_rotation


def test_selection_keeps_gaussians_within_its_limits():
    g = gaussians_within_ranges(400)
    found = find_kept(g, box=(1, -1, 2, -1, 1, 0), min_opacity=0.3, max_scale=0.1)
    for name, kept in found.items():
        one_by_one = [
            {
                "box": all(abs(m) <= 1 for m in g.means[i, :2]) and 0 <= g.means[i, 2] <= 2,
                "opacity": 1 / (1 + np.exp(-g.logit_opacities[i])) >= 0.3,
                "size": np.exp(max(g.log_scales[i])) <= 0.1,
            }[name]
            for i in range(400)
        ]
        assert kept.tolist() == one_by_one
        assert 0 < kept.sum() < 400
    assert find_kept(g) == {}


def test_rows_are_taken_from_every_parameter():
    g = gaussians_within_ranges(9)
    rows = np.array([7, 0])
    found = take(g, rows)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(found, name), getattr(g, name)[rows])
    assert found.features is None and found.smoothing is None


AXES = np.concatenate([np.eye(3), -np.eye(3)])


@pytest.mark.parametrize("towards", AXES, ids=str)
@pytest.mark.parametrize("direction", [*AXES, np.array([0.6, 0, 0.8])], ids=str)
def test_shortest_rotation_axis_is_perpendicular_to_both_directions(direction, towards):
    rotation = shortest_rotation(direction, towards)
    np.testing.assert_allclose(rotation @ direction, towards, atol=1e-15)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) > 0
    angle = Rotation.from_matrix(rotation).magnitude()
    assert angle == pytest.approx(np.arccos(direction @ towards), abs=1e-7)


def test_rotation_turns_means_quats_and_sh():
    g = gaussians_within_ranges(50)
    found = rotation_towards(g, np.array([0.0, -1, 0]), np.array([0.0, 0, 1]))
    x, y, z = g.means.T
    np.testing.assert_allclose(found.means, np.column_stack([x, z, -y]), atol=1e-6)
    about_x = Rotation.from_euler("x", -90, degrees=True)
    quats = about_x * Rotation.from_quat(np.roll(g.quats, -1, axis=1))
    expected = np.roll(quats.as_quat(), 1, axis=1)
    assert distance_of_ellipsoids(expected, found.quats).max() < 1e-6
    assert np.abs(found.shN - g.shN).max() > 0.1
