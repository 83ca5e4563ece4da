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


def config(**init):
    return FitConfig(data={"path": "unused"}, init={"num_points": 300} | init)


@pytest.fixture(scope="module")
def masks():
    return dataset_of_images(images_of(sphere(0.8), 12))


@pytest.fixture(scope="module")
def opaque(masks):
    return with_alpha(masks, np.ones_like)


def with_alpha(dataset, change):
    return replace(
        dataset, train=tuple(replace(view, alpha=change(view.alpha)) for view in dataset.train)
    )


@pytest.fixture
def cloud(tmp_path):
    positions = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    write_points(tmp_path / "cloud.ply", positions, np.full((50, 3), 51, np.uint8))
    return tmp_path / "cloud.ply"


def refusal(dataset, **init):
    with pytest.raises(UserError) as error:
        start_of(config(**init), dataset)
    return str(error.value)


def test_fit_with_alpha_images_starts_on_the_visual_hull(masks):
    for kind in ("auto", "masks"):
        start = start_of(config(start=kind), masks)
        assert start.description == f"{len(start.means)} points on the hull of 12 masks, coloured"
        assert 200 < len(start.means) <= 300
        assert np.abs(np.linalg.norm(start.means, axis=1) - 0.8).max() < 0.25
        assert np.abs(start.colors - colors_at(start.means)).mean() < 0.05


@pytest.mark.slow
def test_starting_gaussians_have_the_colours_opacity_and_scale(masks):
    start = start_of(config(), masks)
    g = initial_gaussians(config(opacity=0.3, scale=0.5), masks)
    whole = initial_gaussians(config(), masks)
    np.testing.assert_array_equal(g.means, start.means)
    np.testing.assert_allclose(0.5 + SH_C0 * g.sh0[:, 0], start.colors, atol=1e-6)
    np.testing.assert_allclose(g.opacities, 0.3, rtol=1e-6)
    np.testing.assert_allclose(g.scales, 0.5 * whole.scales, rtol=1e-6)
    squared = ((g.means[:, None] - g.means[None]) ** 2).sum(axis=2)
    nearest = np.sort(squared, axis=1)[:, 1:4].mean(axis=1)
    np.testing.assert_allclose(whole.scales[:, 0], np.sqrt(nearest), rtol=1e-4)


def test_fit_without_masks_starts_at_random(opaque, masks):
    plain = with_alpha(masks, lambda _: None)
    expected = np.random.default_rng(0).uniform(-1.3, 1.3, (300, 3))
    for dataset, kind in ((opaque, "auto"), (plain, "auto"), (masks, "random")):
        start = start_of(config(start=kind), dataset)
        np.testing.assert_array_equal(start.means, expected)
        assert start.colors is None
        assert start.description == "300 random points in [-1.3, 1.3]^3"


def test_explicit_box_or_cloud_takes_precedence_over_masks(masks, cloud):
    assert "random points in [-1, 1]^3" in start_of(config(half_extent=1.0), masks).description
    start = start_of(config(point_cloud=cloud), masks)
    assert start.description == f"the points of {cloud}"
    np.testing.assert_allclose(start.colors, 0.2)


def test_masks_take_precedence_over_the_cloud_of_the_dataset(masks, opaque, cloud):
    of_masks, of_opaque = (replace(d, point_cloud=cloud) for d in (masks, opaque))
    assert "on the hull" in start_of(config(), of_masks).description
    assert start_of(config(), of_opaque).description == f"the points of {cloud}"
    assert start_of(config(start="points"), of_masks).description == f"the points of {cloud}"
    assert "random points in" in start_of(config(start="random"), of_opaque).description


def test_masks_are_carved_within_the_given_box(masks):
    start = start_of(config(start="masks", half_extent=0.7), masks)
    assert len(start.means) > 100 and np.abs(start.means).max() <= 0.7


@pytest.mark.parametrize("distance", [DISTANCE, 0.01 * DISTANCE])
def test_unknown_box_is_derived_from_the_cameras(masks, distance):
    scale = distance / DISTANCE

    def scaled(view):
        pose = view.camera_to_world.copy()
        pose[:3, 3] *= scale
        return replace(view, camera_to_world=pose)

    dataset = replace(masks, train=tuple(map(scaled, masks.train)), start_half_extent=None)
    start = start_of(config(), dataset)
    assert len(start.means) > 150
    assert np.abs(np.linalg.norm(start.means / scale, axis=1) - 0.8).max() < 0.25


def test_masks_without_a_hull_are_reported_and_not_used(masks, opaque):
    nothing = with_alpha(masks, np.zeros_like)
    for kind in ("auto", "masks"):
        start = start_of(config(start=kind), nothing)
        reason = "the masks of 12 images have no hull to start from"
        assert start.description == f"300 random points in [-1.3, 1.3]^3 ({reason})"


def test_missing_masks_and_clouds_are_refused(masks, opaque):
    few = replace(opaque, train=(*masks.train[:2], *opaque.train[2:]))
    assert refusal(few, start="masks") == (
        "init.start: masks needs nearly all training images to be transparent where there is "
        "nothing, from cameras that stand still, but only 2 are; cut out what is to be fitted, or "
        "set init.start=auto"
    )
    assert refusal(masks, start="points") == (
        "init.start: points needs a point cloud, and the dataset names none that may be used "
        "(ply_file_path, data.ignore_points); give init.point_cloud, or set init.start=auto"
    )


@pytest.mark.parametrize(
    ("init", "message"),
    [
        ({"start": "masks", "point_cloud": "a.ply"}, "init.point_cloud must be null where init.st"),
        ({"start": "random", "point_cloud": "a.ply"}, "init.point_cloud must be null where init."),
        ({"start": "points", "half_extent": 1.0}, "init.half_extent must be null where init.start"),
        ({"start": "hull"}, "auto"),
        ({"scale": 0.0}, "greater than or equal to 0.001"),
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
