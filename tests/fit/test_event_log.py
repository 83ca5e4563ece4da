"""``fit --tensorboard``: its curves are those of the history."""

import csv
import json
import struct
import sys

import numpy as np
import pytest
from support.fit_command import (
    assert_fit_refused,
    assert_fits,
    run_fit,
    stop_after,
    without_images,
    write_project,
)

from drgs.results.folder import EVENTS, HISTORY, TENSORBOARD


@pytest.fixture(autouse=True)
def no_images(monkeypatch):
    without_images(monkeypatch)


@pytest.fixture
def tensorboardx():
    pytest.importorskip("tensorboardX", reason="the extra tensorboard is not installed")


COLUMNS = {
    "loss": "loss",
    "PSNR/training_view": "psnr",
    "PSNR/test_views": "test_psnr",
    "Gaussians": "num_gaussians",
    "learning_rate/means": "means_lr",
}


def curves_of(out):
    """Return [(iteration, value)] by tag."""
    from tensorboardX.proto.event_pb2 import Event

    # Records of TensorFlow's format: a length (8 bytes) and its checksum, the data and its own.
    data, events = (out / EVENTS).read_bytes(), []
    while data:
        end = 12 + struct.unpack("<Q", data[:8])[0]
        events.append(Event.FromString(data[12:end]))
        data = data[end + 4 :]
    first, *others = events
    assert first.file_version == "brain.Event:2"
    times = [event.wall_time for event in others]
    assert times == sorted(times)
    curves = {}
    for event in others:
        for value in event.summary.value:
            curves.setdefault(value.tag, []).append((event.step, value.simple_value))
    return curves


def assert_curves_match_the_history(out):
    curves = curves_of(out)
    with (out / HISTORY).open() as file:
        rows = list(csv.DictReader(file))
    assert curves.keys() == COLUMNS.keys()
    for tag, column in COLUMNS.items():
        expected = [(int(row["iteration"]), float(row[column])) for row in rows if row[column]]
        # history.csv has six digits, the events have single precision.
        np.testing.assert_allclose(curves[tag], expected, rtol=1e-5)


@pytest.mark.slow
def test_curves_match_the_history_and_logging_does_not_change_the_fit(tmp_path, tensorboardx):
    config, out = write_project(tmp_path), tmp_path / "with"
    assert_fits(config, "--out", out, "--tensorboard")
    assert_fits(config, "--out", tmp_path / "without")
    assert_curves_match_the_history(out)
    clouds = [(tmp_path / name / "point_cloud.ply").read_bytes() for name in ("with", "without")]
    assert clouds[0] == clouds[1]
    assert not (tmp_path / "without" / TENSORBOARD).exists()
    assert EVENTS in json.loads((out / ".drgs-fit.json").read_text())["files"]
    (out / TENSORBOARD / "mine.txt").write_text("mine")
    arguments = (config, "--out", out, "--overwrite")
    assert_fit_refused(*arguments, folder=tmp_path, message="tensorboard/mine.txt")


@pytest.mark.slow
def test_resumed_fit_continues_the_curve_and_another_fit_replaces_it(
    tmp_path, monkeypatch, tensorboardx
):
    config, out = write_project(tmp_path), tmp_path / "out"
    with monkeypatch.context() as patch:
        stop_after(patch, 5)  # after the checkpoint of 4
        assert run_fit(config, "--out", out, "--tensorboard").returncode == 130
    assert [step for step, _ in curves_of(out)["loss"]] == [1, 2, 3, 4, 5]
    assert_fits("--resume", out, "--tensorboard")
    assert_curves_match_the_history(out)
    assert_fits(config, "--out", out, "--overwrite")
    assert not (out / TENSORBOARD).exists()


def test_missing_extra_is_reported_with_what_to_install(tmp_path, monkeypatch):
    config = write_project(tmp_path)
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    message = "--tensorboard: needs tensorboardX, which is not installed; "
    message += "pip install 'drgs[tensorboard]'"
    assert_fit_refused(config, "--tensorboard", folder=tmp_path, message=message)
