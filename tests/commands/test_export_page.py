"""``drgs.export --format html``: a page of a fit, or of a file."""

import base64
import gzip
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from support.commands import assert_ends_well
from support.small_capture import blobs, make_dataset

from drgs import export
from drgs.gaussians.parameters import Gaussians
from drgs.results.refined_cameras import write_views

FITTED_WITH = {"antialiased": True, "low_pass": 0.1}


@pytest.fixture
def fit(tmp_path):
    """A folder as a fit leaves it: more Gaussians of its own than for viewers."""
    folder = tmp_path / "run"
    folder.mkdir()
    configure(folder, FITTED_WITH)
    replace(blobs(30), rendered_with=FITTED_WITH).save(folder / "point_cloud.ply")
    blobs(20).save(folder / "point_cloud_viewers.ply")
    write_views(folder / "views.json", make_dataset())
    return folder


def configure(folder, model):
    data = {"path": "photographs", "background": [0.25, 0.5, 0.75]}
    (folder / "config.yml").write_text(yaml.safe_dump({"data": data, "model": model}))


def exported(what, out, *options):
    """Return the command's output, the page's scene and its Gaussians."""
    outcome = assert_ends_well(export.main, what, "--out", out, *options)
    page = out.read_text("utf-8")
    scene, splats = (re.search(rf'id="{name}">([^<]*)<', page)[1] for name in ("scene", "splats"))
    model = out.with_suffix(".ply")
    model.write_bytes(gzip.decompress(base64.b64decode(splats)))
    return outcome.stdout, page, json.loads(scene), Gaussians.load(model)


@pytest.mark.parametrize("order", ["center", "pixel"])
def test_page_of_a_fit_shows_its_own_gaussians_if_the_page_supports_them(fit, tmp_path, order):
    configure(fit, {**FITTED_WITH, "order": order})
    said, page, scene, gaussians = exported(fit, tmp_path / "a.html")
    is_own = order == "center"
    name, count = ("point_cloud.ply", 30) if is_own else ("point_cloud_viewers.ply", 20)
    assert said.splitlines()[0] == f"{fit}/{name}: {count} Gaussians"
    assert "note" not in said and gaussians.num_gaussians == count
    expected = (0.1, True) if is_own else (0.3, False)
    assert (scene["lowPass"], scene["antialiased"]) == (pytest.approx(expected[0]), expected[1])
    assert scene["settings"]["background"]["color"] == [0.25, 0.5, 0.75]
    assert "<title>run: Gaussian splats</title>" in page


@pytest.mark.parametrize("options", [(), ("--up", 0, 0, 1)])
def test_file_is_shown_as_a_whole_with_z_up(fit, tmp_path, options):
    what = fit / "point_cloud.ply" if not options else fit
    _, _, scene, gaussians = exported(what, tmp_path / "a.html", *options)
    heights = np.sort(-gaussians.means[:, 1])
    expected = np.sort(blobs(30).means[:, 2])
    correlation = np.corrcoef(heights, expected)[0, 1]
    assert correlation > 0.9999  # rounded to 10 bits
    black = scene["settings"]["background"]["color"] == [0, 0, 0]
    assert black == (not options)
