"""Photographs on disk, read ahead of the training loop: the fit of photographs in memory."""

import errno
import json
import os
import threading
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import imageio.v3 as iio
import numpy as np
import pytest
from support import small_capture as capture
from support.datasets import load, load_noting
from support.fit_command import VALUES, assert_fits, run_fit, write_project

from drgs import train
from drgs.cameras.viewpoints import between_opencv_and_opengl
from drgs.core.errors import UserError
from drgs.datasets import images
from drgs.datasets.images import DiskStore, is_on_disk
from drgs.fit import memory
from drgs.training.steps import NUM_AHEAD, view_of
from drgs.training.trainer import Trainer

PLANES = ("image", "alpha", "mask", "depth")


def write_photographs(folder: Path, channels=3, dtype=np.uint8, extras=False) -> Path:
    """Noise of 64 x 48 px, transparent in a corner if it can be; extras: masks and depths."""
    rng, frames = np.random.default_rng(5), []
    folder.mkdir()
    for index in range(8):
        pixels = rng.integers(0, np.iinfo(dtype).max, (48, 64, channels), dtype)
        pixels[:8, :8, 3:] = 0
        name = f"{index}.png"
        iio.imwrite(folder / name, pixels[:, :, 0] if dtype == np.uint16 else pixels)
        pose = between_opencv_and_opengl(capture.pose_around(0.8 * index, 0.5)).tolist()
        frames.append({"file_path": name, "transform_matrix": pose})
        if extras and index:
            iio.imwrite(folder / f"mask{index}.png", np.uint8(255 * (pixels[:, :, 0] > 20)))
            np.save(folder / f"{index}.npy", rng.uniform(3, 5, (48, 64)))
            frames[-1] |= {"mask_path": f"mask{index}.png", "depth_file_path": f"{index}.npy"}
    meta = {"camera_angle_x": capture.FIELD_OF_VIEW, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


FORMS = {
    "as they are": ({}, {}),
    "of 16 bits": ({"dtype": np.uint16}, {}),
    "halved": ({}, {"image_size": 32}),
    "rounded to 16 bits": ({}, {"image_size": 40}),
    "numbers": ({}, {"image_size": 16}),
    "with alpha": ({"channels": 4}, {}),
    "halved, with alpha, shifted": ({"channels": 4}, {"image_size": 32, "random_background": True}),
    "masks and depths": ({"extras": True}, {"image_size": 32, "leave_out": ["2"]}),
}


def config_of(folder, in_memory, data, **sections):
    data = {"path": str(folder), "in_memory": in_memory, **data}
    common = {**VALUES, "init": {"num_points": 40, "half_extent": 0.5}, "iterations": 13}
    return {**common, **sections, "data": data}


def results_of(result):
    """Every array and number that a fit leaves, but the time."""
    state = {name: values.tobytes() for name, values in result.trainer.state().items()}
    return state, [replace(row, wall_s=0) for row in result.history]


@pytest.mark.parametrize(("made", "data"), FORMS.values(), ids=FORMS)
def test_images_are_the_same_as_from_memory(tmp_path, made, data):
    folder = write_photographs(tmp_path / "data", **made)
    kept, read = (load(folder, in_memory=in_memory, **data) for in_memory in (True, False))
    for view, from_disk in zip((*kept.train, *kept.test), (*read.train, *read.test), strict=True):
        assert is_on_disk(from_disk) and not is_on_disk(view)
        for here, there in zip(
            images.shift_pixels(view), images.shift_pixels(from_disk), strict=True
        ):
            small = images.smaller_view(there, 2)
            assert is_on_disk(there) and is_on_disk(small)
            for name in PLANES:
                expected, found = getattr(here, name), getattr(there, name)
                if expected is not None:
                    assert (found.nbytes, found.shape) == (0, expected.shape)
                    assert np.asarray(found).tobytes() == np.asarray(expected).tobytes()


SLOW_FITS = {
    "halved, with alpha, shifted": {},
    "masks and depths": {"loss": {"depth_weight": 0.5}, "coarse": [{"until": 6, "factor": 2}]},
    "as they are": {"optimizer": {"views_per_step": 4}},
}


@pytest.mark.slow
@pytest.mark.parametrize("form", SLOW_FITS)
def test_fits_have_the_same_bytes_as_from_memory(tmp_path, form):
    made, data = FORMS[form]
    folder = write_photographs(tmp_path / "data", **made)
    configs = [config_of(folder, kind, data, **SLOW_FITS[form]) for kind in (True, False)]
    in_memory, on_disk = (results_of(train(config)) for config in configs)
    assert in_memory == on_disk


@pytest.mark.slow
def test_a_thread_reads_views_in_the_order_of_the_fit_and_few_ahead(tmp_path, monkeypatch):
    folder = write_photographs(tmp_path / "data")
    photographs = {iio.imread(file).tobytes(): int(file.stem) for file in folder.glob("*.png")}
    read, done, original = [], [], DiskStore._read

    def record(*arguments):
        pixels = original(*arguments)
        read.append((photographs[pixels.tobytes()], threading.current_thread(), len(done)))
        return pixels

    def begin_step(self):
        if not done:
            read.clear()
        return begin(self)

    begin = Trainer._begin_step
    monkeypatch.setattr(DiskStore, "_read", record)
    monkeypatch.setattr(Trainer, "_begin_step", begin_step)
    config = config_of(folder, False, {}, seed=2)  # no view comes twice among three
    result = train(config, callback=lambda report: done.append(report.iteration) and None)
    views = [int(view.name) for view in result.trainer.dataset.train]
    order = [views[view_of(i, len(views), result.trainer.config.seed)] for i in range(1, 14)]
    assert [index for index, _, _ in read] == order
    assert {thread.name for _, thread, _ in read} == {"read-ahead_0"}
    assert all(k - num_done <= NUM_AHEAD for k, (_, _, num_done) in enumerate(read))
    assert not any(view._ahead for view in result.trainer.views)  # what was read is freed


@pytest.mark.slow
def test_a_fit_from_memory_continues_from_disk(tmp_path, monkeypatch):
    """A checkpoint belongs to the photographs, wherever they are."""
    out, step = tmp_path / "out", Trainer.step
    words = write_project(tmp_path), "--out", out, "--set", "output.report=false"

    def interrupt(self):
        if self.iteration == 5:
            raise UserError("stopped")
        return step(self)

    monkeypatch.setattr(Trainer, "step", interrupt)
    assert run_fit(*words, "--set", "data.in_memory=true").returncode == 2
    monkeypatch.setattr(Trainer, "step", step)
    on_disk = "--set", "data.in_memory=false"
    assert "continues at iteration 4" in assert_fits(*words, *on_disk).stdout
    assert "this fit is finished" in assert_fits(*words).stdout


def test_photographs_that_take_more_than_half_of_the_memory_are_on_disk(tmp_path, monkeypatch):
    folder = write_photographs(tmp_path / "data")
    needed = 8 * 64 * 48 * 3
    monkeypatch.setattr(images, "available_memory", lambda: 2 * needed)
    assert not is_on_disk(load(folder).train[0])
    monkeypatch.setattr(images, "available_memory", lambda: 2 * needed - 1)
    dataset, notes = load_noting(folder)
    assert is_on_disk(dataset.train[0])
    assert notes == [
        f"{folder}: 8 photographs take 73.7 kB, and 147 kB of memory are available: they are read "
        "from disk"
    ]
    assert not is_on_disk(load(folder, in_memory=True).train[0])
    no_disk(monkeypatch)  # as before there was this choice
    assert not is_on_disk(load(folder).train[0])


def no_disk(monkeypatch):
    monkeypatch.setenv("TMPDIR", "/nowhere")


def full_disk(monkeypatch):
    monkeypatch.setattr(images.shutil, "disk_usage", lambda _: Mock(free=1000))


def failing_file(monkeypatch, method, error):
    """A temporary file with a method that fails."""
    file = Mock(**{"seek.return_value": 0, f"{method}.side_effect": error})
    monkeypatch.setattr(images.tempfile, "TemporaryFile", lambda **_: file)


def full_while_writing(monkeypatch):
    failing_file(monkeypatch, "write", OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))


def read_only(monkeypatch):
    def refuse(**_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(images.tempfile, "TemporaryFile", refuse)


def little_memory(monkeypatch):
    monkeypatch.setattr(images, "available_memory", lambda: 10_000)


def nothing(monkeypatch):
    pass


REFUSED = {
    "no disk": (no_disk, {}, "/nowhere: cannot write photographs", "No such file or directory"),
    "full disk": (full_disk, {}, ": 8 photographs take 18.4 kB there", "1 kB are free; set TMPDIR"),
    "full while writing": (full_while_writing, {}, "cannot write photographs", "free some space"),
    "read-only": (read_only, {}, "cannot write photographs", "folder that you may write to"),
    "memory": (
        *(little_memory, {"in_memory": True}),
        *("8 photographs take 18.4 kB of memory", "set data.in_memory=false or a smaller"),
    ),
    "a word": (nothing, {"in_memory": "yes"}, "in_memory", "must be true or false, got 'yes'"),
    "a number": (nothing, {"in_memory": 2_000}, "in_memory", "must be true or false, got 2000"),
}


@pytest.mark.parametrize(("prepare", "data", "place", "remedy"), REFUSED.values(), ids=REFUSED)
def test_refused_before_the_fit(tmp_path, monkeypatch, prepare, data, place, remedy):
    folder = write_photographs(tmp_path / "data")
    prepare(monkeypatch)
    values = config_of(folder, False, {"image_size": 16, **data})
    with pytest.raises(UserError) as error:
        train(values)
    assert place in str(error.value) and remedy in str(error.value), error.value


def test_a_fit_that_is_refused_for_its_photographs_can_have_them_on_disk(tmp_path, monkeypatch):
    dataset = load(write_photographs(tmp_path / "data"), in_memory=True)
    config, needed = Mock(), memory.FitMemory(10**9, 5 * 10**8, 0)
    monkeypatch.setattr(memory, "estimate", lambda *_, **__: needed)
    monkeypatch.setattr(memory, "max_num_gaussians", lambda *_: 10)
    refused = memory._refusal(config, dataset, 10, needed, 10**9, 1)
    assert "available memory; set data.in_memory=false" in refused
    on_disk = load(tmp_path / "data", in_memory=False)
    assert "in_memory" not in memory._refusal(config, on_disk, 10, needed, 10**9, 1)
