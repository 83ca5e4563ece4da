"""``fit --view``: what the command leaves; the page itself is tested in ``tests/live``."""

import json
import socket
import sys
from contextlib import contextmanager
from types import ModuleType
from unittest.mock import Mock

import pytest
from support.fit_command import (
    assert_fit_refused,
    assert_fits,
    run_fit,
    without_images,
    write_project,
)
from support.small_capture import HEIGHT, WIDTH, pose_around

from drgs.config.load import load_config
from drgs.training import fit_folder
from drgs.viewer import training_viewer
from drgs.viewer.frames import FrameRequest, ViewerCamera
from drgs.viewer.scheduler import RenderRequests
from drgs.viewer.training_viewer import EarlyStop, TrainingViewer

EYE = ViewerCamera(pose_around(0.4, 0.3), 40.0, 4.0)


class Screen:
    """Somebody who asks for more with each image, and for an end at an iteration."""

    def __init__(self, queue, end_at):
        self.queue, self.end_at, self.shown = queue, end_at, 0

    def show(self, client, request, frame, is_whole):
        self.shown += 1
        self.queue.put(1, FrameRequest(EYE, WIDTH, HEIGHT + self.shown % 2))

    def show_progress(self, trainer, history, total):
        if trainer.iteration == self.end_at:
            self.queue.end()

    def refuse(self, client, reason):
        raise AssertionError(reason)

    def show_end(self, iterations):
        self.iterations = iterations


@pytest.fixture
def viewer_page(monkeypatch):
    """Makes ``--view`` a page for the screen above, without a server."""

    @contextmanager
    def run_server(*arguments):
        yield "server"

    server = ModuleType("drgs.viewer.server")
    server.run_server, server.url, server.ADDRESS = run_server, lambda _: "http://here", "127.0.0.1"
    monkeypatch.setitem(sys.modules, "drgs.viewer.server", server)
    monkeypatch.setitem(sys.modules, "viser", ModuleType("viser"))
    monkeypatch.setattr("drgs.viewer.training_viewer.PROGRESS_SECONDS", 0.0)

    def attach_viewer(end_at=None):
        screens = []

        def watch(server, trainer, dataset, length):
            queue = RenderRequests()
            screens.append(Screen(queue, end_at))
            queue.put(1, FrameRequest(EYE, WIDTH, HEIGHT))
            length = EarlyStop(length, queue)
            return TrainingViewer(queue, screens[0], dataset, length), length

        monkeypatch.setattr(training_viewer, "watch", watch)
        return screens

    without_images(monkeypatch)
    return attach_viewer


def files_of(out):
    """The bytes of what does not tell the time."""
    paths = (p for p in out.rglob("*") if p.is_file() and p.suffix in (".ply", ".png"))
    return {path.relative_to(out): path.read_bytes() for path in paths}


@pytest.mark.slow
def test_results_have_the_same_bytes_with_and_without_a_viewer(tmp_path, viewer_page):
    config, screens = write_project(tmp_path), viewer_page()
    outcome = assert_fits(config, "--out", tmp_path / "watched", "--view")
    assert "look on at http://here" in outcome.stdout
    assert screens[0].shown == screens[0].iterations == 8
    assert_fits(config, "--out", tmp_path / "alone")
    assert files_of(tmp_path / "watched") == files_of(tmp_path / "alone")
    first, second = ((tmp_path / n / "config.yml").read_text() for n in ("watched", "alone"))
    assert first.replace("watched", "alone") == second


@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, True])
def test_ending_early_leaves_a_finished_fit(tmp_path, viewer_page, monkeypatch, killed):
    """Also if it is killed before its results are written, and resumed."""
    config, out = write_project(tmp_path), tmp_path / "out"
    viewer_page(end_at=4)
    with monkeypatch.context() as patch:
        if killed:
            patch.setattr(fit_folder, "write_images", Mock(side_effect=KeyboardInterrupt))
        outcome = run_fit(config, "--out", out, "--view")
        assert outcome.returncode == (130 if killed else 0)
        assert ("5 iterations in" in outcome.stdout) != killed
    assert ("finished" in assert_fits("--resume", out).stdout) != killed
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["iterations"] == metrics["config"]["iterations"] == 5
    assert load_config(out / "config.yml").iterations == 5
    assert not (out / "checkpoint.npz").exists()
    assert_fits(out / "config.yml", "--out", tmp_path / "again")
    assert files_of(tmp_path / "again") == files_of(out)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--view-port", "8080"), "--view-port: needs --view"),
        (("--view-address", "::1"), "--view-address: needs --view"),
        (("--view", "--view-port", "0"), "--view-port: must be a whole number >= 1, got 0"),
        (("--view", "--view-port", "65536"), "--view-port: must be at most 65,535"),
        (("--view", "--view-address", "192.0.2.1"), "192.0.2.1: cannot listen at 192.0.2.1"),
        (("--view", "--view-address", "no address"), "no address: cannot listen at no address"),
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
