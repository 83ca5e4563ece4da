"""Commands and the plugin show a fit in Earth-centred coordinates like one at the origin."""

import json
import re
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import yaml
from support.commands import assert_ends_well
from support.render_command import WHITE, assert_shows, run, sensor, write_scene
from support.small_capture import (
    FIELD_OF_VIEW,
    FOCUS,
    HEIGHT,
    WIDTH,
    blobs,
    make_dataset,
    pose_around,
    write_dataset,
)
from support.small_capture import view as small_view

from drgs import export
from drgs.core.errors import UserNote
from drgs.datasets import load_dataset
from drgs.gaussians.parameters import Gaussians
from drgs.results.files import VIEWS
from drgs.results.refined_cameras import write_views

PLACE = np.array([4.2e6, 1.7e5, -4.78e6])
ORIGIN = (4200001.0, 169999.0, -4779998.0)
"""Origin of the Gaussians, which differs from that of the dataset."""


@pytest.fixture(scope="module")
def far(tmp_path_factory):
    """A folder as a fit leaves it, whose world is at ``PLACE``."""
    folder = tmp_path_factory.mktemp("far")
    dataset = make_dataset()
    views = {n: tuple(v.with_offset(PLACE) for v in getattr(dataset, n)) for n in ("train", "test")}
    write_dataset(folder / "data", replace(dataset, **views))
    means = (blobs().means + (PLACE - ORIGIN)).astype(np.float32)
    (folder / "run").mkdir()
    replace(blobs(), means=means, origin=ORIGIN).save(folder / "run" / "point_cloud.ply")
    config = {"data": {"path": str(folder / "data"), "background": "white"}}
    (folder / "run" / "config.yml").write_text(yaml.safe_dump(config))
    write_views(folder / "run" / VIEWS, load_dataset(folder / "data"))
    return folder / "run"


def test_cameras_of_files_and_by_hand_are_in_world_coordinates(far, tmp_path):
    run(far, "--out", tmp_path)
    for camera in make_dataset().test:
        assert_shows(tmp_path / f"{camera.name}.png", camera, WHITE)
    run(far, "--camera", far / VIEWS, "--out", tmp_path / "file")
    assert json.loads((far / VIEWS).read_text())["origin"] == list(
        load_dataset(far.parent / "data").origin
    )
    for index, camera in enumerate(make_dataset().train):
        assert_shows(tmp_path / "file" / f"camera_{index}.png", camera, WHITE)
    pose = pose_around(1.0, 0.4)
    place, target = (PLACE + point for point in (pose[:3, 3], FOCUS))
    hand = ["--fov", np.degrees(FIELD_OF_VIEW), "--size", WIDTH, HEIGHT, "--out", tmp_path / "hand"]
    run(far, "--origin", *place, "--target", *target, *hand)
    assert_shows(tmp_path / "hand" / "camera.png", small_view("a", pose, None), WHITE)


def test_exports_keep_the_origin_and_crop_in_world_coordinates(far, tmp_path):
    whole, half = tmp_path / "whole.glb", tmp_path / "half.ply"
    assert_ends_well(export.main, far, "--out", whole, "--up", 0, 0, 1)
    read = Gaussians.load(whole)
    assert read.origin == ORIGIN
    expected = blobs().means + PLACE
    np.testing.assert_allclose(read.means + np.array(ORIGIN), expected, rtol=0, atol=1e-5)
    low, high = PLACE - 100, PLACE + np.array([FOCUS[0], 100, 100])
    assert_ends_well(export.main, far, "--out", half, "--crop", *low, *high)
    assert Gaussians.load(half).num_gaussians == np.count_nonzero(blobs().means[:, 0] <= FOCUS[0])
    assert_ends_well(export.main, far, "--format", "html", "--out", tmp_path / "page.html")


def test_plugin_renders_relative_to_the_origin_and_notes_it(far, tmp_path):
    pose = pose_around(1.0, 0.4)
    path = write_scene(tmp_path, sensor(pose))
    expected = np.array(mi.render(mi.load_file(str(path))))
    (tmp_path / "model.ply").write_bytes((far / "point_cloud.ply").read_bytes())
    pose[:3, 3] += PLACE - ORIGIN
    numbers = " ".join(repr(float(v)) for v in (pose @ np.diag([-1, -1, 1, 1])).ravel())
    text = re.sub("<lookat[^>]*>", f'<matrix value="{numbers}"/>', path.read_text())
    path.write_text(text)
    with pytest.warns(UserNote, match=r"relative to \(4200001, 169999, -4779998\); place sensors"):
        scene = mi.load_file(str(path))
    # Positions relative to the origin are rounded once more.
    np.testing.assert_allclose(np.array(mi.render(scene)), expected, rtol=0, atol=1e-3)
