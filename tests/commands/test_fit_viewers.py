"""Results of a fit with ``--view``, and Gaussians for viewers that render otherwise.

The page itself is tested in ``tests/viewer``.
"""

import json
import os
import socket
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from unittest.mock import Mock

import numpy as np
import pytest
from support.commands import assert_ends_well
from support.fit_command import (
    VALUES,
    assert_fit_refused,
    assert_fits,
    run_fit,
    without_images,
    write_project,
)
from support.folders import contents
from support.render_command import run as render
from support.small_capture import HEIGHT, WIDTH, blobs, decibels, double, photograph, pose_around

from drgs.config.load import load_config
from drgs.datasets import load_dataset
from drgs.fit import __main__ as fit
from drgs.fit import fit_folder
from drgs.fit import live_view as training_viewer
from drgs.fit.live_view import TrainingViewer, unless_ended
from drgs.gaussians.parameters import Gaussians
from drgs.live_page.frames import FrameRequest, ViewerCamera
from drgs.live_page.scheduler import RenderRequests
from drgs.results.folder import (
    EARLIER_FOR_VIEWERS,
    GAUSSIANS,
    METRICS,
    OWN_GAUSSIANS,
    own_gaussians,
    remove_run,
    viewer_gaussians,
)

EYE = ViewerCamera(pose_around(0.4, 0.3), 40.0, 4.0)


@pytest.fixture
def viewer_page(monkeypatch):
    """Makes ``--view`` a page, without a server, that asks for more with each image.

    Its user ends the fit after 4 iterations.
    """
    server = ModuleType("drgs.live_page.server")
    server.run_server = lambda *_: nullcontext("server")
    server.url = lambda _: "http://here"
    monkeypatch.setitem(sys.modules, "drgs.live_page.server", server)
    monkeypatch.setitem(sys.modules, "viser", ModuleType("viser"))
    monkeypatch.setattr("drgs.fit.live_view.PROGRESS_SECONDS", 0.0)
    without_images(monkeypatch)
    screen = Mock()

    def watch(server, trainer, length):
        queue = RenderRequests()

        def ask(*_):
            queue.put(1, FrameRequest(EYE, WIDTH, HEIGHT + screen.show.call_count % 2))

        screen.show.side_effect = ask
        screen.show_progress.side_effect = lambda t, *_: t.iteration == 4 and queue.end()
        ask()
        length = unless_ended(length, queue)
        return TrainingViewer(queue, screen), length

    monkeypatch.setattr(training_viewer, "watch", watch)
    return screen


def files_of(out):
    """The bytes of what does not tell the time."""
    paths = (p for p in out.rglob("*") if p.is_file() and p.suffix in (".ply", ".png"))
    return {path.relative_to(out): path.read_bytes() for path in paths}


@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, True])
def test_ending_early_leaves_a_finished_fit(tmp_path, viewer_page, monkeypatch, killed):
    """Also if it is killed before its results are written, and resumed."""
    config, out = write_project(tmp_path), tmp_path / "out"
    with monkeypatch.context() as patch:
        if killed:
            patch.setattr(fit_folder, "write_images", Mock(side_effect=KeyboardInterrupt))
        outcome = run_fit(config, "--out", out, "--view")
        assert outcome.returncode == (130 if killed else 0)
        assert "live view: http://here" in outcome.stdout
        assert ("5 iterations in" in outcome.stdout) != killed
    viewer_page.refuse.assert_not_called()
    viewer_page.show_end.assert_called_once_with(5)
    assert viewer_page.show.call_count == 5
    assert ("finished" in assert_fits("--resume", out).stdout) != killed
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["iterations"] == metrics["config"]["stop_after"] == 5
    assert load_config(out / "config.yml").last_iteration == 5
    assert not (out / "checkpoint.npz").exists()
    assert_fits(out / "config.yml", "--out", tmp_path / "again")
    assert files_of(tmp_path / "again") == files_of(out)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--view-port", "8080"), "--view-port: needs --view"),
        (("--view", "--view-port", "0"), "--view-port: must be a whole number >= 1, got 0"),
        (("--view", "--view-port", "65536"), "--view-port: must be at most 65,535"),
    ],
)
def test_wrong_options_are_refused(tmp_path, arguments, message):
    pytest.importorskip("viser", reason="viser is not installed (the extra viewer)")
    assert_fit_refused(write_project(tmp_path), *arguments, folder=tmp_path, message=message)


def test_occupied_port_is_refused(tmp_path):
    pytest.importorskip("viser", reason="viser is not installed (the extra viewer)")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        words = (write_project(tmp_path), "--view", "--view-port", port)
        message = f"--view-port {port}: cannot listen at 127.0.0.1: Address already in use"
        assert_fit_refused(*words, folder=tmp_path, message=message)


def test_missing_extra_is_reported_with_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    message = "--view: needs viser, which is not installed; pip install 'drgs[viewer]'"
    assert_fit_refused(write_project(tmp_path), "--view", folder=tmp_path, message=message)


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


def test_metrics_include_what_viewers_show(fitted, tmp_path):
    """Both files record their approximations; the float64 reference renders as viewers do."""
    out, outcome = fitted
    native, other = (Gaussians.load(out / name) for name in (OWN_GAUSSIANS, GAUSSIANS))
    assert native.rendered_with == FITTED_WITH
    assert other.rendered_with == {"antialiased": False, "low_pass": 0.3}
    assert native.num_gaussians == other.num_gaussians and (native.means != other.means).any()
    metrics = json.loads((out / METRICS).read_text())
    dataset = load_dataset(load_config(out / "config.yml").data)
    scores = []
    for view in dataset.test:
        seen = photograph(double(other), view, np.array(dataset.background))
        scores.append(decibels(np.clip(seen.image, 0, 1), np.asarray(view.image)))
    found = metrics["viewers"]
    assert found["psnr"] == pytest.approx(np.mean(scores), abs=1e-3)
    assert (found["split"], found["num_views"]) == ("test", 2)
    assert f"{GAUSSIANS}: PSNR {found['psnr']:.2f} dB" in outcome.stdout

    render(out / GAUSSIANS, "--scene", out / "config.yml", "--out", tmp_path)
    again = json.loads((tmp_path / METRICS).read_text())
    assert again["mean"]["psnr"] == found["psnr"]


@pytest.mark.slow
def test_resumed_fit_gives_the_same_bytes(fitted, tmp_path, monkeypatch):
    """Stopped when its iterations are done, with what is for viewers still to come."""
    out, _ = fitted
    config = write_project(tmp_path, model={**VALUES["model"], **FITTED_WITH})
    without_images(monkeypatch)
    with monkeypatch.context() as broken:
        broken.setattr("drgs.fit.session.for_viewers", lambda *_: sys.exit(7))
        with pytest.raises(SystemExit):
            fit.main([str(config), "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out" / GAUSSIANS).exists()
    assert_ends_well(fit.main, "--resume", tmp_path / "out")
    for name in (GAUSSIANS, OWN_GAUSSIANS):
        assert (tmp_path / "out" / name).read_bytes() == (out / name).read_bytes()
    remove_run(tmp_path / "out")
    assert contents(tmp_path / "out") == {}


def test_fit_with_viewer_approximations_writes_one_file(tmp_path, monkeypatch):
    without_images(monkeypatch)
    monkeypatch.delitem(sys.modules, "drgs.fit.viewers_fit", raising=False)
    monkeypatch.delitem(sys.modules, "drgs.effects.smoothing", raising=False)
    assert_fits(write_project(tmp_path), "--out", tmp_path / "out")
    assert not (tmp_path / "out" / OWN_GAUSSIANS).exists()
    assert "viewers" not in json.loads((tmp_path / "out" / METRICS).read_text())
    assert not {"drgs.fit.viewers_fit", "drgs.effects.smoothing"} & set(sys.modules)
    assert Gaussians.load(tmp_path / "out" / GAUSSIANS).rendered_with is None


OWN, FOR_VIEWERS = (replace(blobs(2), rendered_with={"low_pass": p}) for p in (0.1, 0.3))
BOTH = replace(OWN, rendered_with=None)
FOLDERS = {
    "empty": {},
    "one file": {GAUSSIANS: BOTH},
    "two files": {GAUSSIANS: FOR_VIEWERS, OWN_GAUSSIANS: OWN},
    "earlier version": {GAUSSIANS: OWN, EARLIER_FOR_VIEWERS: FOR_VIEWERS},
}


@pytest.mark.parametrize("after", ["one file", "two files"])
@pytest.mark.parametrize("before", FOLDERS)
def test_files_are_of_their_kind_at_every_moment(tmp_path, monkeypatch, before, after):
    for name, each in FOLDERS[before].items():
        each.save(tmp_path / name)

    def checked(step):
        def call(*arguments, **options):
            for read, kind in ((own_gaussians, OWN), (viewer_gaussians, FOR_VIEWERS)):
                if (path := read(tmp_path)).exists():
                    shown = Gaussians.load(path).rendered_with
                    assert shown in (None, kind.rendered_with)
            return step(*arguments, **options)

        return call

    monkeypatch.setattr(os, "replace", checked(os.replace))
    monkeypatch.setattr(Path, "unlink", checked(Path.unlink))
    files = FOLDERS[after]
    fit_folder.write_gaussians(tmp_path, files.get(OWN_GAUSSIANS, BOTH), files[GAUSSIANS])
    assert {*os.listdir(tmp_path)} == {*files}
    for name, each in files.items():
        assert Gaussians.load(tmp_path / name).rendered_with == each.rendered_with


def test_a_small_file_is_written_and_measured(tmp_path, monkeypatch):
    without_images(monkeypatch)
    monkeypatch.setattr("drgs.fit.viewers_fit.ROUNDED_ITERATIONS", 2)
    config, out = write_project(tmp_path), tmp_path / "out"
    printed = assert_fits(config, "--out", out, "--set", "output.small_file=sog")
    found = json.loads((out / METRICS).read_text())["small_file"]
    assert found["bytes"] == (out / "point_cloud.sog").stat().st_size
    assert f"PSNR {found['psnr']:.2f} dB" in printed.stdout
    read = Gaussians.load(out / "point_cloud.sog")
    assert read.num_gaussians == Gaussians.load(out / GAUSSIANS).num_gaussians
    remove_run(out)
    assert contents(out) == {}


@pytest.mark.parametrize(
    ("name", "reason"), [("ply", "must be one of sog"), ("sogg", "must be one of sog, or null")]
)
def test_other_small_files_are_refused_before_the_fit(tmp_path, name, reason):
    config = write_project(tmp_path)
    options = ("--out", tmp_path / "out", "--set", f"output.small_file={name}")
    assert_fit_refused(config, *options, folder=tmp_path, message=f"output.small_file: {reason}")
