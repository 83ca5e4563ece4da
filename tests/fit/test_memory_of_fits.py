"""Memory of a fit is estimated before it starts; a fit that needs too much is refused."""

import json
import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
from PIL import Image
from support.small_capture import FOCUS, pose_around

from drgs.cameras.viewpoints import CameraMotion, between_opencv_and_opengl, pinhole
from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.datasets.types import Dataset, LazyImage, View
from drgs.fit import memory
from drgs.training.losses import target_bytes
from drgs.training.parallel.communicator import Communicator

GB = 10**9


def dataset_of(width, height, count, channels=3):
    """Views around the origin whose photographs nobody reads."""

    def view(index):
        pose = pose_around(2 * np.pi * 0.618 * index, 0.5)
        pose[:3, 3] -= FOCUS
        camera = pinhole(f"v{index}", pose, width, height, 40.0)
        image = LazyImage((height, width, 3), None, width * height * channels)
        return View(**vars(camera), image=image)

    views = tuple(view(index) for index in range(count + 2))
    return Dataset(views[2:], views[:2], "test", (1.0, 1.0, 1.0), 1.3, "")


def config_of(start, most, **changes):
    values = {"data.path": ".", "init.num_points": start, "densify.max_gaussians": most}
    config = FitConfig(data={"path": "."}, densify={"strategy": "adc"})
    return with_changes(config, values | changes)


def estimated(config, dataset, scale=1.0, processes=1):
    return memory.estimate(config, dataset, config.init.num_points, scale, processes)


@pytest.mark.parametrize(
    ("size", "start", "most", "views", "measured_mb"),
    [
        (100, 5_000, 10_000, 10, 271),
        (400, 50_000, 100_000, 20, 728),
        (800, 50_000, 100_000, 10, 1044),
        (1000, 50_000, 100_000, 10, 1407),
        pytest.param(1000, 150_000, 300_000, 6, 2105, marks=pytest.mark.slow),
    ],
)
def test_estimates_are_what_was_measured(size, start, most, views, measured_mb):
    """Peaks of resident memory, MiB, of fits that grew to their cap, with all targets kept."""
    peak = estimated(config_of(start, most), dataset_of(size, size, views))
    expected = peak.required_bytes + target_bytes(size, size) * views
    assert expected / 2**20 == pytest.approx(measured_mb, rel=0.18)


def test_photographs_count_as_they_are_kept():
    """They are kept as bytes, and as numbers at a width where these take less."""
    config, pixels = config_of(1000, 1000), 300 * 200 * 12
    dataset = dataset_of(300, 200, 10)
    assert estimated(config, dataset).photographs == 3 * pixels
    assert estimated(config, dataset, scale=0.9).photographs == 3 * pixels
    assert estimated(config, dataset, scale=0.25).photographs == pytest.approx(12 / 16 * pixels)


def test_each_time_of_a_shutter_counts():
    config, dataset = config_of(1000, 1000), dataset_of(60, 40, 3)
    first = dataset.train[0]
    blurred = replace(first, motion=CameraMotion(first.camera_to_world, "global", 10))
    blurred = replace(dataset, train=(blurred, *dataset.train[1:]))
    once, often = (estimated(config, data) for data in (dataset, blurred))
    assert often.image > 3 * once.image
    assert often.gaussians == once.gaussians


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"densify.max_gaussians": 5000}, 5000),
        ({"densify.max_gaussians": 900}, 1000),  # those of the start cloud stay
        ({"iterations": 400}, 1000),  # no change before
        ({"iterations": 700}, 4000),  # after 600 and 700
        ({"iterations": 700, "densify.adc.split_count": 3}, 9000),
        ({"densify.stop": 700}, 2000),
        ({"densify.start": 29_000, "densify.stop": 29_050}, 1000),
    ],
)
def test_a_population_grows_to_its_cap_if_there_is_time(changes, expected):
    config = config_of(500, 10**6, **changes)
    assert memory.max_num_gaussians(config, 1000) == expected


@pytest.fixture
def available(monkeypatch):
    """Sets how much memory a fit may take."""
    monkeypatch.setattr(memory, "resident_memory", lambda: 0)

    def set_to(count):
        available = math.ceil(count / memory.USABLE_SHARE)
        monkeypatch.setattr(memory, "available_memory", lambda: available)

    return set_to


def room(config, dataset):
    return memory.room_for_targets(config, dataset, config.init.num_points, Communicator())


def test_targets_get_what_is_left(available):
    config, dataset = config_of(1000, 1000), dataset_of(100, 100, 20)
    peak = estimated(config, dataset)
    for left, expected in ((0, 0), (10**6, 10**6), (9 * GB, 9 * GB)):
        available(1.15 * peak.required_bytes + left)
        assert room(config, dataset) == pytest.approx(expected, abs=10)


def test_processes_share_gaussians_and_the_memory_of_their_machine(available):
    """Four of them, on two machines: a quarter of the Gaussians, in half of a machine."""
    config, dataset = config_of(10_000, 10**6), dataset_of(400, 400, 20)
    comm = Mock(size=4, num_on_machine=2, collective=lambda check: check())
    alone, shared = estimated(config, dataset), estimated(config, dataset, processes=4)
    assert shared.gaussians == pytest.approx(alone.gaussians / 4, abs=1)
    assert shared.image == alone.image
    assert shared.required_bytes < alone.required_bytes / 1.5
    available(2.1 * shared.required_bytes)
    memory.room_for_targets(config, dataset, 10_000, comm)
    available(1.9 * shared.required_bytes)
    with pytest.raises(UserError, match=r"a process of the fit needs .* for 1/4 of 1,000,000"):
        memory.room_for_targets(config, dataset, 10_000, comm)


@pytest.mark.slow
def test_advised_number_of_gaussians_fits_and_a_quarter_more_does_not(available):
    config, dataset = config_of(10_000, 10**6), dataset_of(400, 400, 20)
    available(GB)
    with pytest.raises(UserError, match=r"^memory: the fit needs about 2\.") as error:
        room(config, dataset)
    message = str(error.value)
    assert ", and may take 1 GB, nine tenths of the available memory; set " in message
    fewer = int(message.partition("densify.max_gaussians=")[2].split()[0])
    room(config_of(10_000, fewer), dataset)
    with pytest.raises(UserError):
        room(config_of(10_000, fewer * 5 // 4), dataset)


def test_smaller_images_are_advised_where_they_help_and_else_fewer_views(available):
    config, dataset = config_of(10_000, 10_000), dataset_of(5376, 3024, 4)
    available(3 * GB)
    with pytest.raises(UserError, match=r"memory; set data\.image_size=") as error:
        room(config, dataset)
    width = int(str(error.value).rpartition("image_size=")[2])
    peak = estimated(config, dataset, scale=width / 5376)
    assert 2 * GB < peak.required_bytes < 3 * GB
    config, dataset = config_of(1000, 1000), dataset_of(20, 20, 4)
    available(100_000_000)
    message = r"^memory: the fit needs about .* available memory; use fewer views and Gaussians$"
    with pytest.raises(UserError, match=message):
        room(config, dataset)


MEASURED = """
import sys
from drgs.fit import __main__ as fit
from drgs.fit import memory, session
peaks, rooms, estimate, room = [], [], memory.estimate, session.room_for_targets
memory.estimate = lambda *a, **k: peaks.append(estimate(*a, **k)) or peaks[-1]
session.room_for_targets = lambda *a: rooms.append(room(*a)) or rooms[-1]
fit.main(sys.argv[1:])
expected = peaks[0].required_bytes + min(rooms[0], TARGET_BYTES)
# What getrusage says may be the peak of the process that started this one.
status = dict(line.split(":") for line in open("/proc/self/status"))
print("peak", expected, 1024 * int(status["VmHWM"].split()[0]))
"""


def write_photographs(folder, size, count):
    """JPEGs of waves, from around the origin, in nerfstudio's layout."""
    folder.mkdir()
    y, x = np.mgrid[:size, :size]
    frames = []
    for index, view in enumerate(dataset_of(size, size, count - 2).train):
        wave = (127 + 100 * np.sin(x / 7 + index) * np.cos(y / 9)).astype(np.uint8)
        Image.fromarray(wave).convert("RGB").save(folder / f"{index}.jpg")
        pose = between_opencv_and_opengl(view.camera_to_world)
        frames.append({"file_path": f"{index}.jpg", "transform_matrix": pose.tolist()})
    values = {"camera_angle_x": math.radians(40), "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "start", "views", "in_memory"),
    [(100, 5_000, 12, True), (400, 30_000, 20, True), (800, 5_000, 30, False)],
)
def test_the_peak_of_a_fit_is_within_a_quarter_of_the_estimate(
    tmp_path, run_python, size, start, views, in_memory
):
    """Results written: the whole command, in a process of its own, with twice as many Gaussians."""
    write_photographs(tmp_path / "data", size, views)
    adc = {"grad_threshold": 1e-12, "white_background_reset": None}
    schedule = {"start": 2, "every": 3, "stop": 26, "max_gaussians": 2 * start}
    config = {
        "data": {"path": str(tmp_path / "data"), "in_memory": in_memory},
        "init": {"num_points": start, "half_extent": 1.3},
        "densify": {"strategy": "adc", "adc": adc, **schedule},
        "model": {"sh_increase_every": 1},
        "iterations": 30,
    }
    (tmp_path / "a.yml").write_text(yaml.safe_dump(config))
    arguments = ["a.yml", "--out", "out"]
    of_targets = in_memory * views * target_bytes(size, size)  # else none stay
    script = f"import sys; sys.argv[1:] = {arguments}; TARGET_BYTES = {of_targets}\n{MEASURED}"
    done = run_python(script, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    _, expected, peak = next(x for x in done.stdout.splitlines() if x.startswith("peak ")).split()
    assert int(peak) == pytest.approx(int(expected), rel=0.25)
