"""Extents of scenes, start boxes, and the Gaussians that a fit starts from."""

import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.datasets import dataset_of, edit, load, load_noting, put, view_at, write_points
from support.formats import gaussians_within_ranges

from drgs.cameras.viewpoints import focus_of, panorama
from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig, InitConfig
from drgs.core.constants import SH_C0
from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.start import (
    description_of_start,
    initial_gaussians,
    mean_squared_neighbour_distance,
    start_of,
)
from drgs.initialization.start_box import points_in_view, start_box_of

TETRAHEDRON = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)


def config(**sections):
    return FitConfig(**{"data": {"path": "unused"}, **sections})


def gaussians_of(dataset, **sections):
    return initial_gaussians(config(**sections), dataset)


def points_file(path, positions, color=(255, 0, 51)):
    write_points(path, positions, np.tile(np.uint8(color), (len(positions), 1)))
    return path


@pytest.mark.parametrize(
    ("centers", "extent"),
    [
        # Centroid (1, 1.0333, 2); the farthest is the third.
        ([(3, 0, 0), (0, 3, 0), (0, 0.1, 6)], 1.1 * math.dist((1, 3.1 / 3, 2), (0, 0.1, 6))),
        ([(1, 2, 3), (1, 2, 3)], 1),
    ],
)
def test_extent_is_1_1_times_the_largest_distance_from_the_centroid(centers, extent):
    dataset = dataset_of([view_at(center, (0, 0, 0)) for center in centers])
    assert dataset.extent == pytest.approx(extent)
    one = replace(dataset, train=dataset.train[:1], test=dataset.test[1:])
    assert one.extent == pytest.approx(extent)  # of all cameras


def test_random_points_fill_the_reference_box_and_depend_on_the_seed_only(blender):
    dataset = load(blender[0])
    g = gaussians_of(dataset, init={"num_points": 2000, "opacity": 0.2})
    other = gaussians_of(dataset, init={"num_points": 2000}, seed=1)
    assert not np.array_equal(g.means, other.means)
    # The largest of 6000 uniform numbers falls short of 1.3 by 1.3 / 6000 on average.
    assert 1.3 * (1 - 20 / 6000) < np.abs(g.means).max() <= 1.3
    assert (g.num_gaussians, g.sh_degree) == (2000, 3)
    np.testing.assert_allclose(g.opacities, 0.2, rtol=1e-6)
    np.testing.assert_array_equal(g.quats, np.tile([1, 0, 0, 0], (2000, 1)))
    assert not g.sh0.any() and not g.shN.any()  # grey: colour is SH + 0.5
    np.testing.assert_array_equal(g.log_scales, g.log_scales[:, :1].repeat(3, axis=1))


def test_scales_are_the_rms_distance_to_the_three_nearest_points():
    points = np.random.default_rng(0).random((40, 3))
    squared = ((points[:, None] - points[None]) ** 2).sum(-1)
    expected = np.sort(squared, axis=1)[:, 1:4].mean(axis=1)
    np.testing.assert_allclose(mean_squared_neighbour_distance(points), expected, rtol=1e-12)


def test_a_point_cloud_gives_positions_colours_and_scales(tmp_path):
    path = points_file(tmp_path / "p.ply", TETRAHEDRON)
    g = gaussians_of(dataset_of([]), init={"point_cloud": path}, model={"sh_degree": 1})
    assert (g.num_gaussians, g.sh_degree) == (4, 1)
    np.testing.assert_array_equal(g.means, TETRAHEDRON)
    np.testing.assert_allclose(0.5 + SH_C0 * g.sh0[:, 0], [[1, 0, 0.2]] * 4, atol=2e-7)
    # Neighbours of the corner at distance 1, 1, 1; of the others at 1, sqrt(2), sqrt(2).
    np.testing.assert_allclose(g.scales[0], 1, rtol=1e-6)
    np.testing.assert_allclose(g.scales[1:], math.sqrt(5 / 3), rtol=1e-6)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_coinciding_points_keep_a_positive_scale(tmp_path, unit):
    positions = np.concatenate([[(1, 2, 3)] * 4, np.random.default_rng(0).normal(size=(95, 3))])
    size = np.median(np.linalg.norm(positions - np.median(positions, axis=0), axis=1))
    path = points_file(tmp_path / "p.ply", unit * positions)
    g = gaussians_of(dataset_of([]), init={"point_cloud": path})
    np.testing.assert_allclose(g.scales[:4], 2.5e-4 * size * unit, rtol=1e-5)


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        (TETRAHEDRON[:3], "at least 4 points, got 3"),
        (TETRAHEDRON[[0] * 4], "its 4 points must not all be the same"),
        (np.eye(9)[:, :3], "must hold at most densify.max_gaussians (8) points, got 9"),
    ],
)
def test_a_point_cloud_of_the_wrong_size_is_refused(tmp_path, positions, message):
    path = points_file(tmp_path / "p.ply", positions)
    with pytest.raises(UserError) as error:
        gaussians_of(dataset_of([]), init={"point_cloud": path}, densify={"max_gaussians": 8})
    assert str(error.value).startswith(f"{path}: {message}")


def test_focus_is_the_point_that_cameras_look_at():
    target, centers = (1.0, -2.0, 0.5), [(5, 0, 0), (0, 6, 1), (4, 3, 2)]
    focus, distance = focus_of([view_at(center, target) for center in centers])
    np.testing.assert_allclose(focus, target, atol=1e-12)
    assert distance == pytest.approx(np.median([math.dist(c, target) for c in centers]))


def test_points_in_view_are_visible_and_not_close_to_a_camera():
    views = [view_at(c, (1, 0, 0)) for c in [(5, 0, 0), (4, 2, 0), (4, -2, 1)]]
    points = points_in_view(views, 500, np.random.default_rng(0))
    assert points.shape == (500, 3)
    seen = np.zeros(500, bool)
    for view in views:
        x, y, depth = view.K @ view.camera_to_world[:3, :3].T @ (points - view.center).T
        inside = (x >= 0) & (x <= view.width * depth) & (y >= 0) & (y <= view.height * depth)
        seen |= inside & (depth > 0)
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


REFERENCE_CENTERS = np.array([(4.03, 0, 0), (0, 4.03, 0), (-4.03, 0, 0), (0, -4.03, 0.1)])


def views_from(target=(0, 0, 0), scale=1.0):
    """Cameras that look at ``target``, all of it scaled."""
    target = np.array(target, float)
    return [view_at(scale * (target + c), scale * target) for c in REFERENCE_CENTERS]


@pytest.fixture
def cloud(tmp_path):
    return points_file(tmp_path / "cloud.ply", np.random.default_rng(0).uniform(-1, 1, (50, 3)))


@pytest.mark.parametrize(("scale", "target"), [(100, (0, 0, 0)), (0.01, (0, 0, 0)), (1, (9, 5, 7))])
def test_box_of_other_cameras_than_the_reference_is_scaled_and_moved(scale, target):
    reference = start_box_of(InitConfig(), dataset_of(views_from(), 1.3))
    assert (reference.center == 0).all() and reference.half_extent == 1.3
    dataset = dataset_of(views_from(target, scale), 1.3)
    box = start_box_of(InitConfig(), dataset)
    np.testing.assert_allclose(box.center, scale * np.array(target), atol=0.05 * scale)
    # Views of 40 px with a focal length of 40 px see half a unit to each side at distance 1.
    assert box.half_extent == pytest.approx(0.9 * 0.5 * 4.03 * scale, rel=0.02)
    points = gaussians_of(dataset, init={"num_points": 500}).means
    assert np.abs(points - box.center).max() <= box.half_extent * (1 + 1e-6)


@pytest.mark.parametrize("half_extent", [0.3, 1.3, 10.0])
def test_given_box_in_view_or_around_the_cameras_is_used(half_extent):
    init = {"half_extent": half_extent, "num_points": 99}
    means = gaussians_of(dataset_of(views_from()), init=init).means
    assert 0.9 * half_extent < np.abs(means).max() <= half_extent


PARALLEL = [view_at((5, y, 0), (0, y, 0)) for y in range(3)]
OUTWARD = [view_at(c, 2 * np.array(c)) for c in [(1, 0, 0), (0, 1, 0), (-1, -1, 1)]]
FAR, EDGE = views_from((50, 0, 0)), views_from((0, 0, 1.6))

REFUSED_BOXES = [
    (PARALLEL, None, "whose optical axes are parallel; "),
    (OUTWARD, None, "which look away from each other; "),
    (PARALLEL[:1], None, "one training camera, which does not tell how far away"),
    (list(map(panorama, PARALLEL)), None, "panoramas, which look in all directions; set init.half"),
    (FAR, 1.3, "(around (50, 0, 0), from 4.03 away), but only 1 of 4 have it in the"),
    (EDGE, 0.4, "but only 0 of 4 have it in the middle of their images; set init.ha"),
]


@pytest.mark.parametrize(("views", "half_extent", "reason"), REFUSED_BOXES)
def test_box_that_cameras_do_not_determine_or_show_is_refused(views, half_extent, reason):
    start = "no start box can be derived from "
    if half_extent is not None:
        start = f"the start box [-{half_extent}, {half_extent}]^3 must be what the ca"
    with pytest.raises(UserError) as error:
        gaussians_of(dataset_of(views), init={"half_extent": half_extent})
    message = str(error.value)
    assert message.startswith(f"init.half_extent: {start}") and reason in message


def test_cloud_in_another_coordinate_system_is_refused(cloud):
    dataset = dataset_of(views_from((30, 30, 30)))
    with pytest.raises(UserError, match=rf"^{cloud}: .* only 0 of 4 have any of its 50 points in"):
        gaussians_of(dataset, init={"point_cloud": cloud})


def test_point_cloud_of_the_dataset_is_the_start_if_it_is_there(photographs, cloud):
    put(photographs / "transforms.json", "ply_file_path", "cloud.ply")
    dataset = load(photographs)
    assert dataset.point_cloud == cloud
    assert gaussians_of(dataset).num_gaussians == 50
    shown = description_of_start(resolve_defaults(config(), dataset), start_of(config(), dataset))
    assert shown.startswith(f"starts from the points of {cloud}; near plane at")
    init = {"half_extent": 2.0, "num_points": 30}
    assert gaussians_of(dataset, init=init).num_gaussians == 30
    ignoring = load(photographs, ignore_points=True)
    assert gaussians_of(ignoring, init={"num_points": 30}).num_gaussians == 30
    cloud.unlink()
    dataset, (note,) = load_noting(photographs)
    assert dataset.point_cloud is None
    assert note.endswith("not there: 1 of 1 point cloud (cloud.ply); the fit starts without")


def test_black_points_are_coloured_from_the_images(tmp_path):
    """Some pipelines write points without colours."""
    positions = np.random.default_rng(0).uniform(-1, 1, (9, 3))
    init = {"point_cloud": points_file(tmp_path / "black.ply", positions, (0, 0, 0))}
    views = [replace(view, image=view.image + 0.75) for view in views_from()]
    g = gaussians_of(dataset_of(views), init=init)
    np.testing.assert_allclose(0.5 + SH_C0 * g.sh0, 0.75, rtol=1e-6)
    assert not gaussians_of(dataset_of([]), init=init).sh0.any()  # grey: colour is SH + 0.5


@pytest.mark.parametrize(("mode", "background"), [("RGB", "black"), ("RGBA", "white")])
def test_the_background_follows_from_the_images(photographs, mode, background):
    file = photographs / "images" / "03.png"
    Image.open(file).convert(mode).save(file)
    dataset = load(photographs)
    assert resolve_defaults(config(), dataset).data.background == background
    given = config(data={"path": "unused", "background": "white"})
    assert resolve_defaults(given, dataset).data.background == "white"


@pytest.mark.parametrize(
    ("scale", "near"), [(1, 0.2), (1.5, 0.2), (1000, 200), (1e-9, 1e-9), (1e12, 1e9)]
)
def test_the_near_plane_follows_from_the_cameras_and_is_recorded(scale, near):
    dataset = dataset_of(views_from(scale=scale))
    decided = resolve_defaults(config(), dataset)
    assert decided.model.near == near
    assert resolve_defaults(decided, dataset) == decided
    given = resolve_defaults(config(model={"near": 1e-9}), dataset)
    assert given.model.near == 1e-9
    message = r"^model.near must be less than half of .*, 0.0403, got 0.2; model.near=null"
    with pytest.raises(UserError, match=message):
        resolve_defaults(config(model={"near": 0.2}), dataset_of(views_from(scale=0.01)))


@pytest.mark.slow
def test_photographs_are_downscaled_to_the_reference_width_by_default(photographs):
    for file in (photographs / "images").iterdir():
        Image.open(file).resize((2000, 4)).save(file)
    size = {"w": 2000, "h": 4, "fl_x": 2000, "fl_y": 2000}
    edit(photographs / "transforms.json", lambda meta: meta.update(size))
    assert load(photographs).train[0].width == 1600
    assert load(photographs, image_size=10_000).train[0].width == 2000


# Gaussians of a file


def ring():
    return dataset_of([view_at(c, (0, 0, 0)) for c in ((5, 0, 0), (0, 5, 0), (0, -5, 1))])


@pytest.mark.parametrize("suffix", ["ply", "spz", "glb"])
def test_a_fit_starts_from_the_gaussians_of_a_file_as_they_are(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    gaussians_within_ranges(40, degree=1).save(path)
    given = Gaussians.load(path)
    found = gaussians_of(ring(), init={"gaussians": path}, model={"sh_degree": 1})
    for name in PARAMETER_NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name), err_msg=name)
    degree_3 = gaussians_of(ring(), init={"gaussians": path}, model={"sh_degree": 3}).shN
    assert degree_3.shape == (40, 15, 3) and not degree_3[:, 3:].any()
    np.testing.assert_array_equal(degree_3[:, :3], given.shN)
    degree_0 = gaussians_of(ring(), init={"gaussians": path}, model={"sh_degree": 0})
    assert degree_0.shN.shape == (40, 0, 3)


def test_all_harmonics_and_full_images_are_used_at_once(tmp_path):
    path = tmp_path / "a.ply"
    replace(gaussians_within_ranges(40), rendered_with={"low_pass": 0.3}).save(path)
    given = config(init={"gaussians": path}, iterations=4000)
    resolved = resolve_defaults(given, ring())
    assert resolved.model.sh_increase_every == 1 and resolved.coarse == []
    assert config(iterations=4000).model.sh_increase_every == 600
    start = start_of(resolved, ring())
    assert start.description == f"the 40 Gaussians of {path}; low_pass was 0.3"
    smaller = start_of(with_changes(resolved, {"model.sh_degree": 1}), ring())
    assert "of a.ply, their harmonics cut; low" in smaller.description.replace(f"{tmp_path}/", "")


def test_gaussians_keep_their_place_where_the_data_is_far_away(tmp_path):
    given = gaussians_within_ranges(40, degree=0)
    far = replace(given, origin=(4e6, 0.0, -7.0))
    far.save(tmp_path / "a.ply")
    dataset = replace(ring(), origin=(4e6, 0.0, -5.0))
    found = gaussians_of(dataset, init={"gaussians": tmp_path / "a.ply"}, model={"sh_degree": 0})
    np.testing.assert_allclose(found.means, given.means - [0, 0, 2], atol=1e-6)
    assert found.origin == (4e6, 0.0, -5.0)


def test_points_of_a_file_of_gaussians_are_told_from_them(tmp_path):
    for suffix in ("ply", "spz"):
        gaussians_within_ranges(40, degree=0).save(tmp_path / f"a.{suffix}")
    cloud = config(init={"point_cloud": tmp_path / "a.ply"})
    assert start_of(resolve_defaults(cloud, ring()), ring()).description == (
        f"the points of {tmp_path / 'a.ply'} (their scales, rotations and opacities are not used: "
        "set init.gaussians for that), coloured"
    )
    with pytest.raises(UserError, match=r"a\.spz: holds Gaussians, no points; set init\.gaussians"):
        gaussians_of(ring(), init={"point_cloud": tmp_path / "a.spz"})
    for other in ({"start": "random"}, {"point_cloud": "b.ply"}, {"half_extent": 1.0}):
        with pytest.raises(ValueError, match=r"init\.\w+ must be \w+ with init\.gaussians, got"):
            config(init={"gaussians": "a.ply", **other})
