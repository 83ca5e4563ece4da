"""Initial Gaussians from masks, a point cloud or random points, and the messages about them."""

from dataclasses import replace

import numpy as np
import pytest
from support.analytic_shapes import colors_at, dataset_of_images, images_of, sphere
from support.datasets import write_points

from drgs.config.schema import FitConfig
from drgs.core.constants import SH_C0
from drgs.core.errors import UserError
from drgs.initialization.start import initial_gaussians, mean_squared_neighbour_distance, start_of

BALL = dataset_of_images(images_of(sphere(0.8), 12))


def with_alpha(change):
    """The dataset with other alpha."""
    return replace(BALL, train=tuple(replace(v, alpha=change(v.alpha)) for v in BALL.train))


OPAQUE = with_alpha(np.ones_like)


def config(**init):
    return FitConfig(data={"path": "unused"}, init={"num_points": 300} | init)


@pytest.fixture
def cloud(tmp_path):
    positions = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    write_points(tmp_path / "cloud.ply", positions, np.full((50, 3), 51, np.uint8))
    return tmp_path / "cloud.ply"


def test_fit_with_alpha_images_starts_on_the_visual_hull():
    start = start_of(config(), BALL)
    assert start.description == f"{len(start.means)} points on the hull of 12 masks, coloured"
    assert 200 < len(start.means) <= 300
    assert np.abs(np.linalg.norm(start.means, axis=1) - 0.8).max() < 0.25
    assert np.abs(start.colors - colors_at(start.means)).mean() < 0.05
    g = initial_gaussians(config(opacity=0.3), BALL)
    np.testing.assert_array_equal(g.means, start.means)
    np.testing.assert_allclose(0.5 + SH_C0 * g.sh0[:, 0], start.colors, atol=1e-6)
    np.testing.assert_allclose(g.opacities, 0.3, rtol=1e-6)
    nearest = mean_squared_neighbour_distance(g.means.astype(float))
    np.testing.assert_allclose(g.scales[:, 0], np.sqrt(nearest), rtol=1e-4)


EMPTY = with_alpha(np.zeros_like)
NO_HULL = " (the masks of 12 images have no hull to start from)"


@pytest.mark.parametrize(
    ("dataset", "kind", "reason"),
    [
        (OPAQUE, "auto", ""),
        (with_alpha(lambda _: None), "auto", ""),
        (BALL, "random", ""),
        (EMPTY, "auto", NO_HULL),
        (EMPTY, "masks", NO_HULL),
    ],
)
def test_fit_without_masks_starts_at_random(dataset, kind, reason):
    start = start_of(config(start=kind), dataset)
    expected = np.random.default_rng(0).uniform(-1.3, 1.3, (300, 3))
    np.testing.assert_array_equal(start.means, expected)
    assert start.colors is None
    assert start.description == f"300 random points in [-1.3, 1.3]^3{reason}"


@pytest.mark.parametrize(
    ("dataset", "init", "description"),
    [
        (BALL, {}, "on the hull"),
        (OPAQUE, {}, "the points of "),
        (BALL, {"start": "points"}, "the points of "),
        (OPAQUE, {"start": "random"}, "random points in"),
        (BALL, {"half_extent": 1.0}, "random points in [-1, 1]^3"),
        (BALL, {"point_cloud": "cloud.ply"}, "the points of "),
    ],
)
def test_explicit_start_is_before_masks_and_masks_before_the_dataset_cloud(
    cloud, monkeypatch, dataset, init, description
):
    monkeypatch.chdir(cloud.parent)
    start = start_of(config(**init), replace(dataset, point_cloud=cloud))
    assert description in start.description


def test_masks_are_carved_within_the_given_box():
    start = start_of(config(start="masks", half_extent=0.7), BALL)
    assert len(start.means) > 100 and np.abs(start.means).max() <= 0.7


def test_unknown_box_is_derived_from_the_cameras():
    start = start_of(config(), replace(BALL, start_half_extent=None))
    assert len(start.means) > 150
    assert np.abs(np.linalg.norm(start.means, axis=1) - 0.8).max() < 0.25


FEW_MASKS = replace(OPAQUE, train=(*BALL.train[:2], *OPAQUE.train[2:]))

REFUSED = [
    (FEW_MASKS, {"start": "masks"}, "init.start: masks needs nearly all .*, but only 2 are; cut"),
    (BALL, {"start": "points"}, "init.start: points needs a point cloud, and the dataset names no"),
    (
        BALL,
        {"start": "masks", "point_cloud": "a.ply"},
        "init.point_cloud must be null where init.s",
    ),
    (BALL, {"start": "points", "half_extent": 1.0}, "init.half_extent must be null where init.sta"),
]


@pytest.mark.parametrize(("dataset", "init", "message"), REFUSED)
def test_missing_and_contradictory_starts_are_refused(dataset, init, message):
    """Contradictions by the configuration, whose errors are reported when it is loaded."""
    with pytest.raises(UserError if len(init) == 1 else ValueError, match=message):
        start_of(config(**init), dataset)
