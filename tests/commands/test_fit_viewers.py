"""``point_cloud_viewers.ply``: Gaussians for viewers that render otherwise than the fit."""

import json
import sys

import mitsuba as mi
import numpy as np
import pytest
from support.commands import assert_ends_well
from support.fit_command import (
    VALUES,
    assert_fits,
    without_images,
    write_project,
)
from support.folders import contents
from support.render_command import run as render
from support.small_capture import decibels
from support.small_fits import double, photograph

from drgs import fit
from drgs.config.load import load_config
from drgs.datasets import load_dataset
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, make_sensors, render_views
from drgs.results.files import GAUSSIANS, GAUSSIANS_FOR_VIEWERS, METRICS
from drgs.results.folder import remove_run

FITTED_WITH = {"antialiased": True, "low_pass": 0.1}


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """The folder of a fit whose approximations are not those of viewers."""
    folder = tmp_path_factory.mktemp("viewers")
    config = write_project(folder, model={**VALUES["model"], **FITTED_WITH})
    with pytest.MonkeyPatch.context() as patch:
        without_images(patch)
        outcome = assert_fits(config, "--out", folder / "out", "--threads", 1)
    return folder / "out", outcome


def test_both_files_record_their_approximations(fitted):
    out, _ = fitted
    native, other = (Gaussians.load(out / name) for name in (GAUSSIANS, GAUSSIANS_FOR_VIEWERS))
    assert native.rendered_with == FITTED_WITH
    assert other.rendered_with == {"antialiased": False, "low_pass": 0.3}
    assert native.num_gaussians == other.num_gaussians and (native.means != other.means).any()


def test_metrics_include_what_viewers_show(fitted, tmp_path):
    """The float64 reference renders as viewers do."""
    out, outcome = fitted
    metrics = json.loads((out / METRICS).read_text())
    dataset = load_dataset(load_config(out / "config.yml").data)
    gaussians = double(Gaussians.load(out / GAUSSIANS_FOR_VIEWERS))
    scores = []
    for view in dataset.test:
        seen = photograph(gaussians, view, np.array(dataset.background))
        scores.append(decibels(np.clip(seen.image, 0, 1), np.asarray(view.image)))
    found = metrics["viewers"]
    assert found["psnr"] == pytest.approx(np.mean(scores), abs=1e-3)
    assert (found["split"], found["num_views"]) == ("test", 2)
    assert f"{GAUSSIANS_FOR_VIEWERS}: PSNR {found['psnr']:.2f} dB" in outcome.stdout

    render(out / GAUSSIANS_FOR_VIEWERS, "--scene", out / "config.yml", "--out", tmp_path)
    again = json.loads((tmp_path / METRICS).read_text())
    assert again["mean"]["psnr"] == found["psnr"]


def test_plugin_renders_the_file_like_the_fit(fitted):
    """To the last bit: by its name alone, and by the scene that the trainer has."""
    out, _ = fitted
    config = load_config(out / "config.yml")
    dataset = load_dataset(config.data)
    scene = make_scene(Gaussians.load(out / GAUSSIANS), config.model, dataset.background)
    (expected,) = render_views(scene, dataset.test[:1])
    integrator = {"type": "splats", "filename": str(out / GAUSSIANS), "near": 0.2}
    integrator |= {"background": list(dataset.background), "srgb_primitives": False}
    (sensor,) = make_sensors(dataset.test[:1])
    by_name = mi.render(mi.load_dict({"type": "scene", "integrator": integrator}), sensor=sensor)
    np.testing.assert_array_equal(np.clip(np.array(by_name), 0, 1), expected)


@pytest.mark.slow
def test_resumed_fit_gives_the_same_bytes(fitted, tmp_path, monkeypatch):
    """Stopped when its iterations are done, with what is for viewers still to come."""
    out, _ = fitted
    config = write_project(tmp_path, model={**VALUES["model"], **FITTED_WITH})
    without_images(monkeypatch)
    with monkeypatch.context() as broken:
        broken.setattr("drgs.training.viewers.for_viewers", lambda *_: sys.exit(7))
        with pytest.raises(SystemExit):
            fit.main([str(config), "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out" / GAUSSIANS_FOR_VIEWERS).exists()
    assert_ends_well(fit.main, "--resume", tmp_path / "out")
    for name in (GAUSSIANS, GAUSSIANS_FOR_VIEWERS):
        assert (tmp_path / "out" / name).read_bytes() == (out / name).read_bytes()
    remove_run(tmp_path / "out")
    assert contents(tmp_path / "out") == {}


def test_fit_with_viewer_approximations_writes_one_file(tmp_path, monkeypatch):
    without_images(monkeypatch)
    monkeypatch.delitem(sys.modules, "drgs.training.viewers", raising=False)
    monkeypatch.delitem(sys.modules, "drgs.effects.smoothing", raising=False)
    assert_fits(write_project(tmp_path), "--out", tmp_path / "out")
    assert not (tmp_path / "out" / GAUSSIANS_FOR_VIEWERS).exists()
    assert "viewers" not in json.loads((tmp_path / "out" / METRICS).read_text())
    assert not {"drgs.training.viewers", "drgs.effects.smoothing"} & set(sys.modules)
    assert Gaussians.load(tmp_path / "out" / GAUSSIANS).rendered_with is None
