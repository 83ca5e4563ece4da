"""``fit --tensorboard``: the file is read here by its format, record for record."""

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

from drgs.results.files import EVENTS, HISTORY, TENSORBOARD

needs_tensorboardx = pytest.mark.skipif(
    "not __import__('importlib.util').util.find_spec('tensorboardX')",
    reason="tensorboardX is not installed (the extra tensorboard)",
)


@pytest.fixture(autouse=True)
def no_images(monkeypatch):
    without_images(monkeypatch)


def checksum(data):
    """CRC-32C, bit by bit (RFC 3720, appendix B.4), masked as TensorFlow's record format has it."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def records(data):
    """Return records of TensorFlow's format: a length, its checksum, the data, its checksum."""
    while data:
        (length, of_length), data = struct.unpack("<QI", data[:12]), data[12:]
        record, (of_record,) = data[:length], struct.unpack("<I", data[length : length + 4])
        data = data[length + 4 :]
        assert of_length == checksum(struct.pack("<Q", length))
        assert of_record == checksum(record)
        yield record


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

    first, *others = (Event.FromString(r) for r in records((out / EVENTS).read_bytes()))
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
@needs_tensorboardx
def test_curves_match_the_history_and_logging_does_not_change_the_fit(tmp_path):
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
@needs_tensorboardx
def test_resumed_fit_continues_the_curve_and_another_fit_replaces_it(tmp_path, monkeypatch):
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
    assert_fit_refused(
        config,
        "--tensorboard",
        folder=tmp_path,
        message="--tensorboard: needs tensorboardX, which is not installed; "
        "pip install 'drgs[tensorboard]'",
    )
