"""Start boxes: which one follows from the data, and which are refused as no camera sees them."""

import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.datasets import dataset_of, edit, load, load_noting, put, view_at
from support.photographs import write_points

from drgs.config.schema import FitConfig, InitConfig
from drgs.core.constants import SH_C0
from drgs.core.errors import UserError
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.start import description_of_start, initial_gaussians, start_of
from drgs.initialization.start_box import start_box_of

REFERENCE_CENTERS = [(4.03, 0, 0), (0, 4.03, 0), (-4.03, 0, 0), (0, -4.03, 0.1)]


def config(**sections):
    return FitConfig(data={"path": "unused"}, **sections)


def views_from(target=(0, 0, 0), scale=1.0):
    """Cameras that look at ``target``, all of it scaled."""
    target = np.array(target, float)
    return [view_at(scale * (target + c), scale * target) for c in np.array(REFERENCE_CENTERS)]


@pytest.fixture
def cloud(tmp_path):
    positions = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    write_points(tmp_path / "cloud.ply", positions, np.full((50, 3), 200, np.uint8))
    return tmp_path / "cloud.ply"


def test_reference_box_is_used_for_cameras_of_the_reference_layout():
    box = start_box_of(InitConfig(), dataset_of(views_from(), 1.3))
    assert (box.center == 0).all() and box.half_extent == 1.3


@pytest.mark.parametrize(("scale", "target"), [(100, (0, 0, 0)), (0.01, (0, 0, 0)), (1, (9, 5, 7))])
def test_otherwise_the_box_is_scaled_and_moved_to_the_focus(scale, target):
    dataset = dataset_of(views_from(target, scale), 1.3)
    box = start_box_of(InitConfig(), dataset)
    np.testing.assert_allclose(box.center, scale * np.array(target), atol=0.05 * scale)
    # Views of 40 px with a focal length of 40 px see half a unit to each side at distance 1.
    assert box.half_extent == pytest.approx(0.9 * 0.5 * 4.03 * scale, rel=0.02)
    points = initial_gaussians(config(init={"num_points": 500}), dataset).means
    assert np.abs(points - box.center).max() <= box.half_extent * (1 + 1e-6)


@pytest.mark.parametrize("half_extent", [0.3, 1.3, 10.0])
def test_given_box_in_view_or_around_the_cameras_is_used(half_extent):
    init = {"half_extent": half_extent, "num_points": 99}
    means = initial_gaussians(config(init=init), dataset_of(views_from())).means
    assert 0.9 * half_extent < np.abs(means).max() <= half_extent


@pytest.mark.parametrize(
    ("target", "scale", "half_extent", "message"),
    [
        ((50, 0, 0), 1, 1.3, "(around (50, 0, 0), from 4.03 away), but only 1 of 4 have it in the"),
        ((0, 0, 1.6), 1, 0.4, "but only 0 of 4 have it in the middle of their images; set init.ha"),
        ((0, 0, 0), 100, 1.3, "from 403 away), but it covers only 0.39 % of an image (the "),
    ],
    ids=["outside", "at the edge", "tiny"],
)
def test_box_that_views_do_not_show_is_refused(target, scale, half_extent, message):
    dataset = dataset_of(views_from(target, scale))
    start = f"init.half_extent: the start box [-{half_extent}, {half_extent}]^3 must be what the ca"
    with pytest.raises(UserError, match=rf"^{re.escape(start)}.*{re.escape(message)}"):
        initial_gaussians(config(init={"half_extent": half_extent}), dataset)


def test_cloud_in_another_coordinate_system_is_refused(cloud):
    dataset = dataset_of(views_from((30, 30, 30)))
    message = (
        rf"^{cloud}: must hold what the cameras .* only 0 of 4 have any of its 50 points in the"
    )
    with pytest.raises(UserError, match=message):
        initial_gaussians(config(init={"point_cloud": cloud}), dataset)


def test_point_cloud_of_the_dataset_is_the_start(photographs, cloud):
    put(photographs / "transforms.json", "ply_file_path", "cloud.ply")
    dataset = load(photographs)
    assert dataset.point_cloud == cloud
    assert initial_gaussians(config(), dataset).num_gaussians == 50
    shown = description_of_start(resolve_defaults(config(), dataset), start_of(config(), dataset))
    assert shown.startswith(f"starts from the points of {cloud}; near plane at")
    few = {"num_points": 30}
    assert initial_gaussians(config(init={"half_extent": 2.0, **few}), dataset).num_gaussians == 30
    ignoring = load(photographs, ignore_points=True)
    assert initial_gaussians(config(init=few), ignoring).num_gaussians == 30


def test_missing_point_cloud_falls_back_to_random_points(photographs):
    put(photographs / "transforms.json", "ply_file_path", "gone.ply")
    dataset, (note,) = load_noting(photographs)
    assert dataset.point_cloud is None
    assert note.endswith("not there: 1 of 1 point cloud (gone.ply); the fit starts without")


def test_black_points_are_coloured_from_the_images(tmp_path):
    """Some pipelines write points without colours."""
    positions = np.random.default_rng(0).uniform(-1, 1, (9, 3))
    write_points(tmp_path / "black.ply", positions, np.zeros((9, 3), np.uint8))
    given = config(init={"point_cloud": tmp_path / "black.ply"})
    views = [replace(view, image=view.image + 0.75) for view in views_from()]
    g = initial_gaussians(given, dataset_of(views))
    np.testing.assert_allclose(0.5 + SH_C0 * g.sh0, 0.75, rtol=1e-6)
    assert not initial_gaussians(given, dataset_of([])).sh0.any()  # grey: colour is SH + 0.5


@pytest.mark.parametrize(("mode", "background"), [("RGB", "black"), ("RGBA", "white")])
def test_the_background_follows_from_the_images(photographs, mode, background):
    file = photographs / "images" / "03.png"
    Image.open(file).convert(mode).save(file)
    dataset = load(photographs)
    assert resolve_defaults(config(), dataset).data.background == background
    given = FitConfig(data={"path": "unused", "background": "white"})
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


def test_near_plane_beyond_the_focus_is_refused():
    message = (
        r"^model.near must be less than half of the distance .*, 0.0403, got 0.2; model.near=nul"
    )
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
