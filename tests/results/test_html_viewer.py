"""``viewer.html``, as text: what a browser makes of it is in ``test_viewer_in_browser.py``."""

import base64
import gzip
import hashlib
import json
import re
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.html_page import HtmlPage
from support.small_capture import FOCUS, RADIUS, blobs, make_dataset, pose_around

from drgs.cameras.viewpoints import pinhole
from drgs.config.approximations import Approximations
from drgs.core.errors import UserError, UserNote
from drgs.gaussians.parameters import Gaussians
from drgs.results import html_viewer as viewer
from drgs.results.html_viewer import DisplaySettings, InitialView, viewer_page
from drgs.results.refined_cameras import write_views

SHIPPED = resources.files("drgs.results").joinpath("supersplat_viewer")
MANIFEST = json.loads(SHIPPED.joinpath("MANIFEST.json").read_text())

FITTED = Approximations(low_pass=0.1, antialiased=True)
TITLE = '<i>"ü" & </script>'


def gaussians_of(page, path) -> Gaussians:
    path.write_bytes(gzip.decompress(base64.b64decode(HtmlPage(page.decode()).texts["splats"])))
    return Gaussians.load(path)


COLOR = (0.1, 0.2, 0.3)


def write(folder, dataset):
    viewer.write_viewer(folder, dataset, DisplaySettings(blobs(), FITTED))


@pytest.fixture(scope="module")
def initial_view():
    return InitialView.from_views(make_dataset().train, blobs())


@pytest.fixture(scope="module")
def page(initial_view):
    return viewer_page(TITLE, DisplaySettings(blobs(), FITTED), initial_view, COLOR)


def test_shipped_files_have_the_pinned_versions_with_all_changes_and_licences(page):
    files = {entry.name: entry.read_bytes() for entry in SHIPPED.iterdir()}
    assert files.keys() - {"MANIFEST.json"} == MANIFEST["sha256"].keys()
    for name, digest in MANIFEST["sha256"].items():
        assert hashlib.sha256(files[name]).hexdigest() == digest, name
    code, text = gzip.decompress(files["viewer.js.gz"]).decode(), files["LICENSE"].decode()
    for package in MANIFEST["packages"]:
        assert f'"{package["version"]}"' in code
        assert f"{package['name']} {package['version']}\n" in text
    assert text.count("Permission is hereby granted, free of charge") == len(MANIFEST["packages"])
    assert text in page.decode()
    for change in MANIFEST["changes"]:
        lines = [line.strip() for line in change["new"].splitlines()]
        assert all(line in code for line in lines) and change["old"] not in code


def test_page_has_no_external_references_and_connects_nowhere(page):
    parsed = HtmlPage(page.decode())
    assert parsed.texts["title"].strip() == f"{TITLE}: Gaussian splats"
    assert parsed.tags.count("script") == 4
    assert parsed.references == ["data:,"]  # the icon
    policy = re.search(rb'Content-Security-Policy" content="([^"]*)"', page)[1].decode()
    allowed = {name: values for name, *values in map(str.split, policy.split(";"))}
    assert allowed["default-src"] == ["'none'"] and "connect-src" not in allowed
    assert {v for values in allowed.values() for v in values} == {
        *("'none'", "'unsafe-inline'", "data:", "blob:")
    }


def test_page_contains_gaussians_in_axes_of_the_first_camera(page, initial_view, tmp_path):
    """Their means in the camera's axes: y is up on the page, which turns files by 180 degrees."""
    scene = json.loads(HtmlPage(page.decode()).texts["scene"])
    assert (scene["lowPass"], scene["antialiased"]) == (pytest.approx(0.1), True)
    assert scene["settings"]["background"]["color"] == [0.1, 0.2, 0.3]
    found = gaussians_of(page, tmp_path / "a.ply")
    (first,) = scene["settings"]["cameras"]
    back = np.array(first["initial"]["position"])
    assert first["initial"]["target"] == [0, 0, 0] and np.linalg.norm(back) == pytest.approx(3)
    right = np.cross([0, 1, 0], back)
    axes = [v / np.linalg.norm(v) for v in (right, np.cross(right, back), -back)]  # OpenCV's
    seen = (found.means * [-1, -1, 1] - back) @ np.transpose(axes)
    camera = initial_view.camera
    expected = (blobs().means - camera.center) @ camera.camera_to_world[:3, :3]
    scale = 3 / RADIUS
    order = np.argsort(seen[:, 2]), np.argsort(expected[:, 2])
    # 10 bits and more of a box of 1.2 scene units.
    np.testing.assert_allclose(seen[order[0]], scale * expected[order[1]], atol=1.2 / 1023)
    sizes = blobs().log_scales[order[1]] + np.log(scale)
    np.testing.assert_allclose(found.log_scales[order[0]], sizes, atol=2e-3)  # 10 bits of ln 4
    assert scene["tangents"] == pytest.approx([np.tan(0.35), np.tan(0.35) * 24 / 32])


def test_first_camera_is_nearest_to_the_orbit_start():
    """At their mean height, in the direction that most of them have."""
    azimuths = [(0.9, 0.2), (1.0, 0.6), (1.1, 0.4), (1.2, 0.4), (1.3, 0.4), (1.4, 0.1)]
    views = [pinhole("", pose_around(*angles), 32, 24, 40.0) for angles in azimuths]
    found = InitialView.from_views(views, blobs())
    start = found.orbit.viewpoints(1, 32, 24, 40.0)[0].center
    distances = [np.linalg.norm(view.center - start) for view in views]
    assert found.camera is views[int(np.argmin(distances))]
    np.testing.assert_allclose(found.target, FOCUS, atol=1e-6)


def test_view_without_cameras_shows_all_gaussians():
    up = Rotation.from_euler("xyz", [30, 50, 0], degrees=True).apply([0, 0, 1])
    camera = InitialView.from_gaussians(blobs(), up).camera
    seen = (blobs().means - camera.center) @ camera.camera_to_world[:3, :3]
    tangents = np.abs(seen[:, :2] / seen[:, 2:])
    assert (tangents < np.tan(np.radians(40) / 2)).mean() > 0.95
    assert camera.camera_to_world[:3, 0] @ up == pytest.approx(0, abs=1e-9)


def test_page_of_numbers_it_cannot_show_or_that_is_too_large_is_not_written(
    initial_view, tmp_path, monkeypatch
):
    wrong = blobs()
    wrong.sh0[3, 0, 1] = np.nan
    assert viewer.shows_as_fitted(FITTED)
    assert not viewer.shows_as_fitted(replace(FITTED, order="pixel"))
    with pytest.raises(UserError, match="sh0 of Gaussian 3 must be finite"):
        viewer_page(TITLE, DisplaySettings(wrong, FITTED), initial_view, COLOR)
    monkeypatch.setattr(viewer, "MAX_PAGE_BYTES", viewer.estimate_page_bytes(30, 1) - 1)
    note = r"viewer\.html: not written, as it would have about 0 MB.*export .* --format html"
    with pytest.warns(UserNote, match=note):
        write(tmp_path, make_dataset())
    assert not (tmp_path / "viewer.html").exists()
    assert viewer.seconds_of_page(30, 1) == 0 < viewer.seconds_of_page(29, 0)


def test_first_view_uses_refined_cameras(tmp_path):
    """All of them twice as far away: what is walked around is half as large on the page."""
    dataset, sizes = make_dataset(), []
    far = [
        replace(view, camera_to_world=np.block([[view.camera_to_world[:, :3], end[:, None]]]))
        for view in dataset.train
        for end in [np.append(2 * view.center - FOCUS, 1)]
    ]
    for folder in (tmp_path / "given", tmp_path / "refined"):
        folder.mkdir()
        config = {"data": {"path": "data"}, "cameras": {"optimise": folder.name == "refined"}}
        (folder / "config.yml").write_text(yaml.safe_dump(config))
        write_views(folder / "refined_cameras.json", replace(dataset, train=far))
        write(folder, dataset)
        found = gaussians_of((folder / "viewer.html").read_bytes(), tmp_path / "a.ply")
        sizes.append(np.ptp(found.means, axis=0))
    np.testing.assert_allclose(sizes[0], 2 * sizes[1], rtol=0.01)  # 10 bits of a box
