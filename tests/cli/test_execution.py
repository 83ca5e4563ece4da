"""``--threads`` and ``--debug`` of the commands."""

import platform
import sys
from unittest.mock import Mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.commands import run_in_process
from support.fit_command import assert_fits, run_fit, without_images, write_project
from support.folders import visible
from support.small_capture import blobs

from drgs.cli.execution import execution_settings
from drgs.core.errors import UserError
from drgs.gaussians.parameters import Gaussians
from drgs.render import __main__ as render
from drgs.render import images
from drgs.training.trainer import Trainer

DEBUG = dr.JitFlag.Debug


@pytest.fixture(autouse=True)
def settings_are_restored():
    before = dr.flag(DEBUG), dr.thread_count(), sys.gettrace(), sys.stderr
    yield
    assert (dr.flag(DEBUG), dr.thread_count(), sys.gettrace(), sys.stderr) == before


def read_beyond_the_end():
    dr.eval(dr.gather(mi.UInt32, mi.UInt32(1, 2, 3), mi.UInt32(0, 7)))


def write_beyond_the_end():
    array = mi.Float(1, 2, 3)
    dr.scatter(array, mi.Float(5, 6), mi.UInt32(0, 9))
    dr.eval(array)


def test_settings_hold_within_the_block():
    """Dr.Jit notes the lines that operations come from by a trace function."""
    before = sys.gettrace()

    def trace(*_):
        return None

    sys.settrace(trace)
    try:
        for threads, debug in ((None, False), (1, True), (dr.thread_count() + 1, False)):
            with execution_settings(threads, debug):
                assert dr.flag(DEBUG) == debug
                assert (sys.gettrace() is trace) != debug
                assert dr.thread_count() == threads or threads is None
        assert sys.gettrace() is trace
    finally:
        sys.settrace(before)


@pytest.mark.parametrize(
    ("access", "line", "report"),
    [
        (read_beyond_the_end, 1, "drjit.gather(): out-of-bounds read from position 7 in an array"),
        (write_beyond_the_end, 2, "drjit.scatter(): out-of-bounds write to position 9 in an array"),
    ],
)
def test_out_of_range_access_is_reported(capsys, access, line, report):
    with (
        pytest.raises(UserError) as error,
        execution_settings(threads=None, debug=True) as check_ranges,
    ):
        check_ranges()
        access()
        with pytest.raises(UserError, match="out-of-bounds"):
            check_ranges()  # before the end
    line += access.__code__.co_firstlineno
    assert str(error.value).startswith(f"--debug: {report} of size 3. (test_execution.py:{line}); ")
    assert report in capsys.readouterr().err  # at once, where it happened
    with pytest.raises(ZeroDivisionError), execution_settings(threads=None, debug=True):
        access()
        1 / 0  # noqa: B018


@pytest.mark.skipif(
    (platform.libc_ver()[0], platform.machine()) != ("glibc", "x86_64"),
    reason="the mode is only known there",
)
@pytest.mark.parametrize("count", [1, 2, 5])
def test_denormals_are_flushed_on_any_number_of_threads(count):
    with execution_settings(threads=count, debug=False):
        for size in (1, 64, 1_000_000):
            small, smaller = dr.opaque(mi.Float, 1e-30, size), dr.opaque(mi.Float, 1e-10, size)
            assert np.all(np.array(small * smaller) == 0)
    # The calling thread's own mode is given back.
    assert np.float32(1e-30) * np.float32(1e-10) > 0


def test_refused_number_of_threads_is_a_user_error(monkeypatch):
    refuse = Mock(side_effect=[RuntimeError("Resource temporarily unavailable"), None])
    monkeypatch.setattr(dr, "set_thread_count", refuse)
    with (
        pytest.raises(UserError, match=r"--threads 100000: .*: Resource temporarily"),
        execution_settings(threads=100_000, debug=False),
    ):
        pass


def after_each_step(monkeypatch, act):
    step = Trainer.step
    monkeypatch.setattr(Trainer, "step", lambda trainer: (step(trainer), act(trainer))[0])


@pytest.mark.slow
def test_fit_with_range_checks_gives_the_same_bytes_or_stops(tmp_path, monkeypatch):
    """Across a change of the population, of the SH degree, and an opacity reset."""
    without_images(monkeypatch)
    config = write_project(tmp_path, iterations=3, output={"checkpoint_every": 1})
    flags = []
    after_each_step(monkeypatch, lambda trainer: flags.append(dr.flag(DEBUG)))
    for name, options in (("plain", []), ("checked", ["--debug", "--threads", "1"])):
        outcome = assert_fits(config, "--out", tmp_path / name, *options)
        assert "out-of-bounds" not in outcome.stderr
    assert flags == [False] * 3 + [True] * 3
    assert Gaussians.load(tmp_path / "plain" / "point_cloud.ply").num_gaussians > 40
    for name in ("point_cloud.ply", "renders/test/r_0.png"):
        plain, checked = ((tmp_path / run / name).read_bytes() for run in ("plain", "checked"))
        assert plain == checked, name

    after_each_step(monkeypatch, lambda t: t.iteration == 2 and read_beyond_the_end())
    message = "error: --debug: drjit.gather(): out-of-bounds read from position 7"
    outcome, out = run_fit(config, "--out", tmp_path / "out", "--debug"), tmp_path / "out"
    assert outcome.returncode == 2 and message in outcome.stderr
    assert visible(out) == {"checkpoint.npz", "config.yml"}
    assert np.load(out / "checkpoint.npz")["trainer.iteration"] == 1


def test_render_fails_after_out_of_range_access(tmp_path, monkeypatch):
    blobs().save(tmp_path / "blobs.ply")
    monkeypatch.setattr(images, "render_cameras", lambda *_: [read_beyond_the_end()])
    words = (tmp_path / "blobs.ply", "--origin", 0, -4, 1, "--out", tmp_path / "out", "--debug")
    message = "--debug: drjit.gather(): out-of-bounds read from position 7"
    outcome = run_in_process(render.main, *words)
    assert outcome.returncode == 2 and f"error: {message}" in outcome.stderr
