"""Files of an earlier version are read as that version did.

``references/earlier_version`` was made by the version of November 2026, before classes and
functions were renamed: a fit stopped after 50 of 80 iterations (``config.yml``,
``checkpoint.npz``), its final ``point_cloud.ply``, and an image of that file by ``scene.xml``;
since then, a surface hides splats by the depths of their peaks where these order them. In folders
of fits, files have changed their names.
"""

import shutil

import mitsuba as mi
import numpy as np
import pytest
import yaml
from conftest import REPOSITORY
from support.fit_command import ITERATIONS, VALUES, assert_fits, without_images, write_project
from support.folders import contents, to_earlier_layout, visible
from support.openexr import read_exr
from support.small_capture import make_dataset, write_dataset

from drgs.config.load import load_config
from drgs.core import adam
from drgs.export.source import load_source
from drgs.gaussians.parameters import Gaussians
from drgs.io.ply import Ply
from drgs.results.folder import own_gaussians
from drgs.results.model import load_model
from drgs.results.refined_cameras import training_cameras

EARLIER_VERSION = REPOSITORY / "tests" / "references" / "earlier_version"

ROUNDING = 1e-4
"""Relative: instructions of other processors round differently, and 30 iterations follow."""


@pytest.mark.slow
def test_a_checkpoint_is_continued(tmp_path, monkeypatch):
    """Steps of that version were Adam's own."""
    monkeypatch.setattr(adam, "NesterovAdam", adam.LeanAdam)
    out, data = tmp_path / "out", tmp_path / "data"
    out.mkdir()
    for name in ("config.yml", "checkpoint.npz"):
        shutil.copy(EARLIER_VERSION / name, out / name)
    write_dataset(data, make_dataset(train=3, test=2))
    assert_fits("--resume", out, "--data", data)
    after, header = Ply().read(own_gaussians(out))
    expected, earlier_header = Ply().read(EARLIER_VERSION / "point_cloud.ply")
    assert header == earlier_header and after.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_allclose(after[name], values, ROUNDING, ROUNDING, err_msg=name)


def test_configurations_and_images_of_scenes_stay_the_same():
    values = yaml.safe_load((EARLIER_VERSION / "config.yml").read_text())
    loaded = load_config(EARLIER_VERSION / "config.yml").model_dump(mode="json")
    assert values.pop("extensions") == {}
    removed = {"init": ["scale"], "loss": ["window", "sigma"], "optimizer": ["epsilon"]}
    removed = {**removed, "prune": ["method", "opacity", "opacity_rate"]}
    sections = {**values, "prune": values["densify"]["prune"]}
    assert all(sections[section].pop(name) for section in removed for name in removed[section])
    assert loaded["init"].pop("gaussians") is None and loaded["init"].pop("sky") is True
    assert loaded["output"].pop("small_file") is None
    newer = [loaded["data"].pop(key) for key in ("leave_out", "in_memory")]
    assert [*newer, loaded["densify"].pop("remove_floaters")] == [[], None, True]
    newer = [loaded["colors"].pop(f"{name}_lr") for name in ("vignetting", "response")]
    assert [*newer, loaded.pop("stop_after")] == [None] * 3
    assert values["optimizer"].pop("means_lr_aims") == values["densify"].pop("stop_aims") == []
    assert loaded == values
    image = mi.render(mi.load_file(str(EARLIER_VERSION / "scene.xml")), seed=0)
    np.testing.assert_allclose(image, read_exr(EARLIER_VERSION / "scene.exr"), ROUNDING, ROUNDING)


def test_folders_with_earlier_names_are_read_and_continued(tmp_path, monkeypatch):
    """The own Gaussians are rendered, the others exported; continued, both folders are equal."""
    without_images(monkeypatch)
    model = {**VALUES["model"], "antialiased": True, "low_pass": 0.1}
    now, earlier = tmp_path / "now", tmp_path / "earlier"
    project = write_project(tmp_path, model=model, cameras={"optimise": True})
    assert_fits(project, "--out", now)
    own, for_viewers = (Gaussians.load(now / f"point_cloud{end}.ply") for end in ("_drgs", ""))
    assert own.rendered_with == {"antialiased": True, "low_pass": 0.1}
    shutil.copytree(now, earlier)
    to_earlier_layout(earlier)
    assert "point_cloud_viewers.ply" in visible(earlier) > {"point_cloud.ply", "cameras.json"}
    poses = []
    for out in (now, earlier):
        np.testing.assert_array_equal(load_model(out).gaussians.means, own.means)
        np.testing.assert_array_equal(load_source(out).gaussians.means, for_viewers.means)
        poses.append([view.camera_to_world for view in training_cameras(out, own.origin)])
        assert_fits("--resume", out, "--set", f"iterations={ITERATIONS + 2}")
    np.testing.assert_array_equal(*poses)
    assert visible(now) == visible(earlier)
    for name, content in contents(now).items():
        if name.endswith(("cameras.json", ".ply")):
            assert (earlier / name).read_bytes() == content != b"", name
    assert_fits(project, "--out", earlier, "--overwrite")
    assert visible(now) == visible(earlier)
