"""``--threads`` and ``--debug`` of the commands."""

import platform
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.fit_command import write_scene
from support.folders import visible
from support.small_capture import blobs
from support.viewer_rendering import VIEWER_RENDERING

from drgs import fit, render
from drgs.cli.execution import execution_settings
from drgs.core.errors import UserError
from drgs.gaussians.parameters import Gaussians
from drgs.training import fit_folder
from drgs.training.trainer import Trainer

DEBUG = dr.JitFlag.Debug


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


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


# ----------------------------------------------------------------------------------------------
# Context manager
# ----------------------------------------------------------------------------------------------


def test_range_checks_are_on_only_within_the_block_and_if_enabled():
    for debug in (False, True):
        with execution_settings(threads=None, debug=debug):
            assert dr.flag(DEBUG) == debug
        assert not dr.flag(DEBUG)


def test_trace_function_of_a_debugger_is_restored():
    def trace(*_):
        return None

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        with execution_settings(threads=None, debug=True):
            assert sys.gettrace() is not trace  # Dr.Jit notes the lines that operations come from
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


def test_error_of_the_block_is_not_replaced_by_a_report():
    with pytest.raises(ZeroDivisionError), execution_settings(threads=None, debug=True):
        read_beyond_the_end()
        1 / 0  # noqa: B018


def test_number_of_threads_is_set_within_the_block():
    before = dr.thread_count()
    for count in (1, before + 1):
        with execution_settings(threads=count, debug=False):
            assert dr.thread_count() == count
        assert dr.thread_count() == before


def denormal_product(count):
    """1e-40, where denormal numbers are kept; computed by Dr.Jit."""
    small, smaller = dr.opaque(mi.Float, 1e-30, count), dr.opaque(mi.Float, 1e-10, count)
    return np.array(small * smaller)


@pytest.mark.skipif(
    (platform.libc_ver()[0], platform.machine()) != ("glibc", "x86_64"),
    reason="the mode is only known there",
)
@pytest.mark.parametrize("count", [1, 2, 5])
def test_denormals_are_flushed_on_any_number_of_threads(count):
    with execution_settings(threads=count, debug=False):
        for size in (1, 64, 1_000_000):
            assert np.all(denormal_product(size) == 0)
    # The calling thread's own mode is given back.
    assert np.float32(1e-30) * np.float32(1e-10) > 0


def test_refused_number_of_threads_is_a_user_error(monkeypatch):
    set_thread_count = dr.set_thread_count

    def refuse(count):
        if count == 100_000:
            raise RuntimeError("Resource temporarily unavailable")
        set_thread_count(count)

    monkeypatch.setattr(dr, "set_thread_count", refuse)
    with (
        pytest.raises(UserError, match=r"--threads 100000: .*: Resource temporarily"),
        execution_settings(threads=100_000, debug=False),
    ):
        pass


# ----------------------------------------------------------------------------------------------
# In the commands
# ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    write_scene(
        folder,
        model={"sh_degree": 1, "sh_increase_every": 2, **VIEWER_RENDERING},
        densify={
            "start": 1,
            "stop": 4,
            "every": 2,
            "strategy": "adc",
            "adc": {"reset_every": 3, "grad_threshold": 1e-6},
        },
        iterations=3,
        output={"checkpoint_every": 1},
    )
    blobs().save(folder / "blobs.ply")
    return folder


@pytest.fixture
def step_callbacks(monkeypatch):
    """Calls of ``Trainer.step`` call these, with the trainer, when they are done."""
    acts, step = [], Trainer.step

    def step_and_act(trainer):
        report = step(trainer)
        for act in acts:
            act(trainer)
        return report

    monkeypatch.setattr(Trainer, "step", step_and_act)
    monkeypatch.setattr(fit_folder, "write_results", lambda *arguments: None)
    return acts


def fails(capsys, command, *arguments):
    with pytest.raises(SystemExit) as exit_info:
        command.main([str(argument) for argument in arguments])
    assert exit_info.value.code == 2
    return capsys.readouterr().err


@pytest.mark.slow
def test_fit_with_range_checks_gives_the_same_bytes(scene, tmp_path, step_callbacks, capsys):
    """Across a change of the population, of the SH degree, and an opacity reset."""
    flags = []
    step_callbacks.append(lambda trainer: flags.append(dr.flag(DEBUG)))
    for name, options in (("plain", []), ("checked", ["--debug", "--threads", "1"])):
        fit.main([str(scene / "a.yml"), "--out", str(tmp_path / name), *options])
    assert flags == [False] * 3 + [True] * 3
    assert "out-of-bounds" not in capsys.readouterr().err
    assert Gaussians.load(tmp_path / "plain" / "point_cloud.ply").num_gaussians > 40
    for name in ("point_cloud.ply", "renders/test/r_0.png"):
        plain, checked = ((tmp_path / run / name).read_bytes() for run in ("plain", "checked"))
        assert plain == checked, name


@pytest.mark.slow
def test_fit_stops_at_out_of_range_access_and_keeps_the_last_checkpoint(
    scene, tmp_path, step_callbacks, capsys
):
    step_callbacks.append(lambda trainer: trainer.iteration == 2 and read_beyond_the_end())
    out = tmp_path / "out"
    message = fails(capsys, fit, scene / "a.yml", "--out", out, "--debug").splitlines()[-1]
    assert message.startswith("error: --debug: drjit.gather(): out-of-bounds read from position 7")
    assert visible(out) == {"checkpoint.npz", "config.yml"}
    assert np.load(out / "checkpoint.npz")["trainer.iteration"] == 1


def test_render_gives_the_same_bytes_with_range_checks(scene, tmp_path, monkeypatch, capsys):
    flags, render_views = [], render.render_views

    def render_and_note(*arguments):
        for image in render_views(*arguments):
            flags.append(dr.flag(DEBUG))
            yield image

    monkeypatch.setattr(render, "render_views", render_and_note)
    for name, options in (("plain", ()), ("checked", ("--debug", "--threads", "1"))):
        camera = ("--origin", "0", "-4", "1", "--size", "32", "24", "--out", tmp_path / name)
        render.main([str(a) for a in (scene / "blobs.ply", *camera, *options)])
    assert flags == [False, True]
    assert "out-of-bounds" not in capsys.readouterr().err
    plain, checked = ((tmp_path / run / "camera.png").read_bytes() for run in ("plain", "checked"))
    assert plain == checked


def test_render_fails_after_out_of_range_access(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(render, "render_cameras", lambda *_: [read_beyond_the_end()])
    camera = ("--origin", "0", "-4", "1", "--out", tmp_path / "out")
    message = fails(capsys, render, scene / "blobs.ply", *camera, "--debug").splitlines()[-1]
    assert message.startswith("error: --debug: drjit.gather(): out-of-bounds read from position 7")


@pytest.mark.parametrize("command", [fit, render])
@pytest.mark.parametrize(
    ("count", "message"),
    [
        ("0", "argument --threads: must be a whole number >= 1, got 0"),
        ("-2", "argument --threads: must be a whole number >= 1, got -2"),
        ("two", "argument --threads: must be a whole number >= 1, got two"),
        (
            "4294967296",
            "argument --threads: must be at most 4,096 (no machine has more",
        ),
    ],
)
def test_invalid_numbers_of_threads_are_refused(scene, tmp_path, capsys, command, count, message):
    what = scene / ("a.yml" if command is fit else "blobs.ply")
    arguments = (what, "--out", tmp_path / "out", "--threads", count)
    errors = fails(capsys, command, *arguments)
    assert message in errors and errors.count("\n") == 1
    assert not (tmp_path / "out").exists()
