"""Sizes of images, extents of scenes, and the Gaussians that a fit starts from."""

import math
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.datasets import dataset_of, edit, load, refusal, view_at

from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.datasets.folders import GUIDE
from drgs.datasets.images import downscale
from drgs.datasets.viewpoints import focus_of
from drgs.initialization.start import (
    initial_gaussians,
    mean_squared_neighbour_distance,
    start_of,
)
from drgs.initialization.start_box import points_in_view


# Either layout
def test_missing_folder_is_an_error_with_the_download_command(tmp_path):
    folder = tmp_path / "none"
    assert refusal(folder, source="our server") == (
        f"data.path: there is no folder {folder}; say where it is (--data DIR), or get it from our "
        "server"
    )
    assert refusal(folder) == (
        f"data.path: there is no folder {folder}; say where it is (--data DIR)"
    )


def test_folder_of_unknown_layout_is_refused(tmp_path):
    assert refusal(tmp_path) == (
        f"{tmp_path}: neither transforms_train.json nor transforms.json is there, nor a model of "
        f"COLMAP in sparse/0 with its photographs in images; see {GUIDE}"
    )


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        (np.full((2, 2), 51, np.uint8), 0.2),
        (np.full((2, 2), 13107, np.uint16), 0.2),
        (np.full((2, 2, 2), (51, 255), np.uint8), 0.2),
    ],
    ids=["grey", "grey16", "grey-alpha"],
)
def test_grey_images_become_rgb(photographs, pixels, expected):
    def change(meta):
        del meta["w"], meta["h"]

    edit(photographs / "transforms.json", change)
    iio.imwrite(photographs / "images" / "01.png", pixels)
    image = load(photographs).train[0].image
    assert image.shape == (2, 2, 3)
    np.testing.assert_allclose(image, expected, rtol=1e-6)


def test_image_size_scales_images_and_intrinsics_together(photographs):
    full, half = load(photographs), load(photographs, image_size=4)
    a, b = full.train[0], half.train[0]
    assert (b.width, b.height, b.image.shape) == (4, 3, (3, 4, 3))
    np.testing.assert_allclose(b.K[:2], a.K[:2] / 2)
    assert "4x3" in half.description


def test_images_are_never_enlarged(photographs):
    assert load(photographs, image_size=100).train[0].width == 8


@pytest.mark.parametrize("shape", [(6, 8), (7, 9), (5, 11)])
def test_downscaling_averages_over_each_pixels_area(shape):
    image = np.random.default_rng(1).random((*shape, 3)).astype(np.float32)
    actual = downscale(image, 4)
    height, width = actual.shape[:2]
    assert (height, width) == (round(shape[0] * 4 / shape[1]), 4)
    # Each source pixel repeated until old and new pixel edges coincide, then plain means.
    repeated = image.astype(np.float64).repeat(height, axis=0).repeat(width, axis=1)
    blocks = repeated.reshape(height, shape[0], width, shape[1], 3)
    np.testing.assert_allclose(actual, blocks.mean(axis=(1, 3)), rtol=1e-6)


@given(st.integers(1, 12), st.integers(1, 12), st.integers(1, 12))
def test_downscaling_keeps_a_constant_image(height, width, new_width):
    actual = downscale(np.full((height, width, 3), 0.7, np.float32), new_width)
    assert actual.shape[1] == min(width, new_width)
    np.testing.assert_allclose(actual, 0.7, rtol=1e-6)


def test_scaling_a_composite_equals_compositing_scaled_premultiplied_colours(blender):
    folder, images = blender
    actual = load(folder, image_size=3, background=(0.25, 0.5, 0.75)).train[0].image
    pixels = images["train", 0].astype(np.float64) / 255
    pixels[..., :3] *= pixels[..., 3:]
    small = pixels.reshape(2, 2, 3, 2, 4).mean(axis=(1, 3))
    expected = small[..., :3] + np.array([0.25, 0.5, 0.75]) * (1 - small[..., 3:])
    np.testing.assert_allclose(actual, expected, atol=5e-7)


def test_extent_is_1_1_times_the_largest_distance_from_the_centroid():
    views = [view_at(c, (0, 0, 0)) for c in [(3, 0, 0), (0, 3, 0), (0, 0.1, 6)]]
    # Centroid (1, 1.0333, 2); the farthest is the third.
    expected = 1.1 * math.dist((1, 3.1 / 3, 2), (0, 0.1, 6))
    assert dataset_of(views).extent == pytest.approx(expected)


def test_extent_is_1_if_all_cameras_share_a_centre():
    views = [view_at((1, 2, 3), (0, 0, 0)), view_at((1, 2, 3), (5, 0, 0))]
    assert dataset_of(views).extent == 1


# Starting points
def config(**sections):
    return FitConfig(data={"path": "unused"}, **sections)


def test_random_points_fill_the_reference_box_and_depend_on_the_seed_only(blender):
    dataset = load(blender[0])
    a = initial_gaussians(config(init={"num_points": 2000}), dataset)
    b = initial_gaussians(config(init={"num_points": 2000}), dataset)
    c = initial_gaussians(config(init={"num_points": 2000}, seed=1), dataset)
    np.testing.assert_array_equal(a.means, b.means)
    assert not np.array_equal(a.means, c.means)
    assert np.abs(a.means).max() <= 1.3
    # The largest of 6000 uniform numbers falls short of 1.3 by 1.3 / 6000 on average.
    assert np.abs(a.means).max() > 1.3 * (1 - 20 / 6000)


def test_starting_gaussians_have_the_reference_values(blender):
    g = initial_gaussians(config(init={"num_points": 50, "opacity": 0.2}), load(blender[0]))
    assert g.num_gaussians == 50
    assert g.sh_degree == 3
    np.testing.assert_allclose(g.opacities, 0.2, rtol=1e-6)
    np.testing.assert_array_equal(g.quats, np.tile([1, 0, 0, 0], (50, 1)))
    assert not g.sh0.any()  # grey: colour is SH + 0.5
    assert not g.shN.any()
    np.testing.assert_array_equal(g.log_scales, g.log_scales[:, :1].repeat(3, axis=1))


def test_scales_are_the_rms_distance_to_the_three_nearest_points():
    points = np.random.default_rng(0).random((40, 3))
    squared = ((points[:, None] - points[None]) ** 2).sum(-1)
    expected = np.sort(squared, axis=1)[:, 1:4].mean(axis=1)
    np.testing.assert_allclose(mean_squared_neighbour_distance(points), expected, rtol=1e-12)


def points_file(path, rgb=None, positions=None):
    """A PLY of 4 points at the corners of a unit tetrahedron's bounding cube."""
    from plyfile import PlyData, PlyElement

    if positions is None:
        positions = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    names = "xyz" if rgb is None else ["x", "y", "z", "red", "green", "blue"]
    rows = [tuple(p) + (tuple(rgb) if rgb else ()) for p in positions]
    kinds = [(name, "u1" if len(name) > 1 else "f4") for name in names]
    vertex = PlyElement.describe(np.array(rows, kinds), "vertex")
    PlyData([vertex]).write(str(path))
    return path


def test_a_point_cloud_gives_positions_colours_and_scales(tmp_path):
    path = points_file(tmp_path / "p.ply", rgb=(255, 0, 51))
    g = initial_gaussians(
        config(init={"point_cloud": path}, model={"sh_degree": 1}), dataset_of([])
    )
    assert (g.num_gaussians, g.sh_degree) == (4, 1)
    # Colour 0.5 + C0 sh0, C0 = sqrt(1 / (4 pi)).
    colors = 0.5 + math.sqrt(1 / (4 * math.pi)) * g.sh0[:, 0]
    np.testing.assert_allclose(colors, np.tile([1, 0, 0.2], (4, 1)), atol=2e-7)
    # Neighbours of the corner at distance 1, 1, 1; of the others at 1, sqrt(2), sqrt(2).
    np.testing.assert_allclose(g.scales[0], 1, rtol=1e-6)
    np.testing.assert_allclose(g.scales[1:], math.sqrt(5 / 3), rtol=1e-6)


def test_coinciding_points_keep_a_positive_scale(tmp_path):
    positions = np.concatenate([[(1, 2, 3)] * 4, np.random.default_rng(0).normal(size=(95, 3))])
    size = np.median(np.linalg.norm(positions - np.median(positions, axis=0), axis=1))
    for unit in (1e-6, 1.0, 1e6):
        path = points_file(tmp_path / "p.ply", positions=unit * positions)
        g = initial_gaussians(config(init={"point_cloud": path}), dataset_of([]))
        np.testing.assert_allclose(g.scales[:4], 2.5e-4 * size * unit, rtol=1e-5)


def test_a_point_cloud_of_the_wrong_size_is_refused(tmp_path):
    path = points_file(tmp_path / "p.ply", positions=[(0, 0, 0)] * 3)
    with pytest.raises(UserError, match=r"p.ply: at least 4 points, got 3"):
        initial_gaussians(config(init={"point_cloud": path}), dataset_of([]))
    path = points_file(tmp_path / "p.ply", positions=[(0, 0, 0)] * 4)
    with pytest.raises(UserError, match=r"p.ply: its 4 points must not all be the same"):
        initial_gaussians(config(init={"point_cloud": path}), dataset_of([]))
    path = points_file(tmp_path / "p.ply", positions=[(0, 0, i) for i in range(9)])
    with pytest.raises(UserError) as error:
        initial_gaussians(
            config(init={"point_cloud": path}, densify={"max_gaussians": 8}), dataset_of([])
        )
    assert str(error.value) == (
        f"{path}: must hold at most densify.max_gaussians (8) points, got 9"
    )


def test_focus_is_the_point_that_cameras_look_at():
    target = np.array([1.0, -2.0, 0.5])
    centers = [(5, 0, 0), (0, 6, 1), (4, 3, 2)]
    focus, distance = focus_of([view_at(center, target) for center in centers])
    np.testing.assert_allclose(focus, target, atol=1e-12)
    assert distance == pytest.approx(np.median([math.dist(c, target) for c in centers]))


def test_points_in_view_are_visible_and_not_close_to_a_camera():
    views = [view_at(c, (1, 0, 0)) for c in [(5, 0, 0), (4, 2, 0), (4, -2, 1)]]
    points = points_in_view(views, 500, np.random.default_rng(0))
    assert points.shape == (500, 3)
    seen = np.zeros(500, bool)
    for view in views:
        camera = (points - view.center) @ view.camera_to_world[:3, :3]
        pixel = camera @ view.K.T
        with np.errstate(divide="ignore"):
            pixel = pixel[:, :2] / pixel[:, 2:]
        inside = (pixel >= 0) & (pixel <= [view.width, view.height])
        seen |= inside.all(axis=1) & (camera[:, 2] > 0)
        assert np.linalg.norm(points - view.center, axis=1).min() >= 0.25 * focus_of(views)[1]
    assert seen.all()


def test_half_of_the_points_in_view_are_uniform_in_inverse_distance():
    centers = [(4, 0, 0), (-4, 0, 0), (0, 4, 0), (0, -4, 0), (0, 0.1, 4), (0, 0.1, -4)]
    views = [replace(view_at(c, (0, 0, 0)), fx=5.0, fy=5.0) for c in centers]  # they see all of it
    focus, distance = focus_of(views)
    points = points_in_view(views, 4000, np.random.default_rng(0))
    nearness = distance / np.abs(points - focus).max(axis=1)
    behind = nearness[nearness < 1]
    assert 0.45 < len(behind) / len(points) < 0.65  # parts of the cube are too near to a camera
    assert behind.min() >= 0.1
    # A fraction of 4/9 of 2,000 varies by 0.011 (one sigma).
    assert np.mean(behind < 0.5) == pytest.approx((0.5 - 0.1) / (1 - 0.1), abs=0.05)


def test_description_of_random_points_states_their_extent():
    dataset = dataset_of([view_at(c, (1, 0, 0)) for c in [(5, 0, 0), (1, 4, 0), (1, -4, 0)]])
    start = start_of(config(init={"num_points": 99}), dataset)
    assert start.description == (
        "99 random points that the cameras see, part of them about within 4 of (1, 0, 0), the "
        "others up to 10 times as far"
    )


def test_half_extent_overrides_the_default_box(blender):
    g = initial_gaussians(config(init={"half_extent": 0.25, "num_points": 99}), load(blender[0]))
    assert np.abs(g.means).max() <= 0.25
    views = [view_at((5, 0, 0), (0, 0, 0)), view_at((0, 5, 0), (0, 0, 0))]
    g = initial_gaussians(config(init={"half_extent": 9.0, "num_points": 99}), dataset_of(views))
    assert 8 < np.abs(g.means).max() <= 9


@pytest.mark.parametrize(
    ("views", "reason"),
    [
        ([view_at((5, y, 0), (0, y, 0)) for y in range(3)], "whose optical axes are parallel"),
        (
            [view_at(c, 2 * np.array(c)) for c in [(1, 0, 0), (0, 1, 0), (-1, -1, 1)]],
            "which look away from each other",
        ),
    ],
    ids=["parallel", "outward"],
)
def test_cameras_that_determine_no_box_are_refused(views, reason):
    with pytest.raises(UserError) as error:
        initial_gaussians(config(), dataset_of(views))
    assert str(error.value) == (
        f"init.half_extent: no start box can be derived from the cameras, {reason}; set "
        "init.half_extent, or give a point cloud (init.point_cloud)"
    )


def test_single_camera_does_not_determine_a_box():
    with pytest.raises(UserError) as error:
        initial_gaussians(config(), dataset_of([view_at((4, 0, 0), (0, 0, 0))]))
    assert str(error.value) == (
        "init.half_extent: no start box can be derived from one training camera, which does not "
        "tell how far away it looks; set init.half_extent, or give a point "
        "cloud (init.point_cloud)"
    )


def test_starting_gaussians_can_be_written(blender, tmp_path):
    g = initial_gaussians(config(init={"num_points": 5}), load(blender[0]))
    g.save(tmp_path / "start.ply")
    assert (tmp_path / "start.ply").is_file()


# The real data
@pytest.mark.slow
def test_lego_is_read(lego_folder):
    dataset = load(lego_folder, image_size=200)
    assert (len(dataset.train), len(dataset.test), dataset.test_split) == (100, 100, "val")
    view = dataset.train[0]
    assert (view.width, view.height) == (200, 200)
    assert view.fx == pytest.approx(555.5555 / 2, rel=1e-6)
    np.testing.assert_array_equal(np.asarray(view.image)[0, 0], 1)  # background
    # All cameras of this scene look at the origin from one distance.
    focus, distance = focus_of(dataset.train)
    np.testing.assert_allclose(focus, 0, atol=1e-5)
    assert distance == pytest.approx(4.0311, abs=1e-3)


def test_fox_is_read(fox_folder):
    dataset = load(fox_folder)
    assert (len(dataset.train), len(dataset.test)) == (43, 7)
    assert (dataset.train[0].width, dataset.train[0].height) == (270, 480)
    named = dataset.train[0].lens.coefficients()
    assert named == {
        "k1": 0.0578421, "k2": -0.0805099, "p1": -0.000980296, "p2": 0.00015575
    }  # fmt: skip
