"""``fit --tensorboard``: the file is read here by its format, record for record."""

import csv
import json
import struct
import sys

import pytest
from support.commands import run_in_process
from support.fit_command import (
    assert_fit_refused,
    assert_fits,
    stop_after,
    without_images,
    write_project,
)

from drgs import fit
from drgs.results.files import EVENTS, HISTORY, TENSORBOARD

COLUMNS = {
    "loss": "loss",
    "PSNR/training_view": "psnr",
    "PSNR/test_views": "test_psnr",
    "Gaussians": "num_gaussians",
    "learning_rate/means": "means_lr",
}

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


def events_of(out):
    """The file's version; and by tag the values over the iterations, in their order."""
    from tensorboardX.proto.event_pb2 import Event

    first, *others = (Event.FromString(r) for r in records((out / EVENTS).read_bytes()))
    curves, times = {}, [event.wall_time for event in others]
    for event in others:
        for value in event.summary.value:
            curves.setdefault(value.tag, []).append((event.step, value.simple_value))
    assert times == sorted(times)
    return first.file_version, curves


def curves_of_history(out):
    with (out / HISTORY).open() as file:
        rows = list(csv.DictReader(file))
    return {
        tag: [(int(row["iteration"]), float(row[column])) for row in rows if row[column]]
        for tag, column in COLUMNS.items()
    }


def assert_agree(out):
    version, curves = events_of(out)
    expected = curves_of_history(out)
    assert version == "brain.Event:2" and curves.keys() == expected.keys()
    for tag, curve in expected.items():
        assert [step for step, _ in curves[tag]] == [step for step, _ in curve]
        # history.csv has six digits, the events have single precision.
        assert [v for _, v in curves[tag]] == pytest.approx([v for _, v in curve], rel=1e-5)


@pytest.mark.slow
@needs_tensorboardx
def test_curves_match_the_history_and_logging_does_not_change_the_fit(tmp_path):
    config = write_project(tmp_path)
    assert_fits(config, "--out", tmp_path / "with", "--tensorboard")
    assert_fits(config, "--out", tmp_path / "without")
    assert_agree(tmp_path / "with")
    name = "point_cloud.ply"
    assert (tmp_path / "with" / name).read_bytes() == (tmp_path / "without" / name).read_bytes()
    assert not (tmp_path / "without" / TENSORBOARD).exists()
    assert EVENTS in json.loads((tmp_path / "with" / ".drgs-fit.json").read_text())["files"]


@pytest.mark.slow
@needs_tensorboardx
def test_resumed_fit_continues_the_curve_and_another_fit_replaces_it(tmp_path, monkeypatch):
    config, out = write_project(tmp_path), tmp_path / "out"
    with monkeypatch.context() as patch:
        without_images(patch)
        stop_after(patch, 5)  # behind the checkpoint of 4
        assert run_in_process(fit.main, config, "--out", out, "--tensorboard").returncode == 130
    steps = [step for step, _ in events_of(out)[1]["loss"]]
    assert steps == [1, 2, 3, 4, 5]
    assert_fits("--resume", out, "--tensorboard")
    assert_agree(out)
    assert_fits(config, "--out", out, "--overwrite")
    assert not (out / TENSORBOARD).exists()


@pytest.mark.slow
@needs_tensorboardx
def test_foreign_file_in_the_folder_is_kept(tmp_path):
    config, out = write_project(tmp_path), tmp_path / "out"
    assert_fits(config, "--out", out, "--tensorboard")
    (out / TENSORBOARD / "mine.txt").write_text("mine")
    arguments = (config, "--out", out, "--overwrite")
    assert_fit_refused(*arguments, folder=tmp_path, message="tensorboard/mine.txt")


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
