"""Initial Gaussians from masks, a point cloud or random points, and the messages about them."""

from dataclasses import replace

import numpy as np
import pytest
from support.analytic_shapes import (
    DISTANCE,
    colors_at,
    dataset_of_images,
    images_of,
    opaque_at,
    sphere,
)
from support.datasets import load
from support.photographs import write_points

from drgs.config.schema import FitConfig
from drgs.core.constants import SH_C0
from drgs.core.errors import UserError
from drgs.initialization.start import initial_gaussians, start_of

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
    g = initial_gaussians(config(opacity=0.3, scale=0.5), BALL)
    np.testing.assert_array_equal(g.means, start.means)
    np.testing.assert_allclose(0.5 + SH_C0 * g.sh0[:, 0], start.colors, atol=1e-6)
    np.testing.assert_allclose(g.opacities, 0.3, rtol=1e-6)
    squared = ((g.means[:, None] - g.means[None]) ** 2).sum(axis=2)
    nearest = np.sort(squared, axis=1)[:, 1:4].mean(axis=1)
    np.testing.assert_allclose(g.scales[:, 0], 0.5 * np.sqrt(nearest), rtol=1e-4)


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


@pytest.mark.parametrize("distance", [DISTANCE, 0.01 * DISTANCE])
def test_unknown_box_is_derived_from_the_cameras(distance):
    scale = distance / DISTANCE

    def scaled(view):
        pose = view.camera_to_world.copy()
        pose[:3, 3] *= scale
        return replace(view, camera_to_world=pose)

    dataset = replace(BALL, train=tuple(map(scaled, BALL.train)), start_half_extent=None)
    start = start_of(config(), dataset)
    assert len(start.means) > 150
    assert np.abs(np.linalg.norm(start.means / scale, axis=1) - 0.8).max() < 0.25


FEW_MASKS = replace(OPAQUE, train=(*BALL.train[:2], *OPAQUE.train[2:]))


@pytest.mark.parametrize(
    ("dataset", "kind", "message"),
    [
        (FEW_MASKS, "masks", "masks needs nearly all training images .*, but only 2 are; cut out"),
        (BALL, "points", "points needs a point cloud, and the dataset names none that may be used"),
    ],
)
def test_missing_masks_and_clouds_are_refused(dataset, kind, message):
    with pytest.raises(UserError, match=f"^init.start: {message}"):
        start_of(config(start=kind), dataset)


@pytest.mark.parametrize(
    ("init", "message"),
    [
        ({"start": "masks", "point_cloud": "a.ply"}, "init.point_cloud must be null where init.st"),
        ({"start": "points", "half_extent": 1.0}, "init.half_extent must be null where init.start"),
    ],
)
def test_contradictory_starts_are_refused(init, message):
    with pytest.raises(ValueError, match=message):
        config(**init)


@pytest.mark.slow
def test_the_real_lego_starts_on_its_hull(lego_folder):
    dataset = load(lego_folder, image_size=100)
    start = start_of(config(num_points=3000), dataset)
    assert 2000 < len(start.means) <= 3000
    shown = np.mean([opaque_at(view, start.means.astype(float)) for view in dataset.train])
    assert shown > 0.999
    # Yellow more than blue.
    assert start.colors[:, 0].mean() > 1.5 * start.colors[:, 2].mean()
