"""Files that differ between processes are refused."""

import shutil
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from support import parallel_processes
from support.datasets import edit, load
from support.small_capture import make_dataset, write_dataset

from drgs.core.errors import UserError
from drgs.fit.fingerprint import fingerprint_of
from drgs.gaussians.parameters import Gaussians
from drgs.io.images import write_png

SETTINGS = (
    "iterations=8",
    "init.num_points=40",
    "init.half_extent=0.5",
    "densify.budget.gaussians=60",
    "optimizer.views_per_step=2",
    "output.report=false",
    "output.save_renders=false",
)


@pytest.fixture
def agreement():
    pytest.importorskip("mpi4py", reason="the extra mpi is not installed")
    from drgs.fit import inputs as agreement

    return agreement


@pytest.fixture
def copies(tmp_path):
    """Folders with copies of the photographs, in which the first process starts, and the second.

    Paths in a configuration are absolute; those of the photographs begin with the current folder
    (Linux). The second process renders r_1.
    """
    first, second = tmp_path / "first", tmp_path / "second"
    write_dataset(first, make_dataset(train=3, test=2))

    def move(meta):
        for frame in meta["frames"]:
            frame["file_path"] = f"/proc/self/cwd/{frame['file_path']}"

    for split in ("train", "test"):
        edit(first / f"transforms_{split}.json", move)
    shutil.copytree(first, second)
    return first, second


def fitted(copies, out, size=2):
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    words = ["-m", "drgs.fit", copies[0], "--out", out, *settings]
    return parallel_processes.run(size, words, cwd=copies[0], on_second=f"cd {copies[1]}")


@pytest.mark.slow
def test_photographs_may_differ_only_where_another_process_reads_them(copies, tmp_path):
    """Rank 0 alone reads test photographs."""
    for name in ("train/r_0.png", "train/r_2.png", "test/r_0.png", "test/r_1.png"):
        shutil.copy(copies[1] / "train" / "r_1.png", copies[1] / name)
    status, _, errors = fitted(copies, tmp_path / "two")
    assert status == 0, errors
    assert fitted(copies, tmp_path / "one", 1)[0] == 0
    one, two = ((tmp_path / name / "point_cloud.ply").read_bytes() for name in ("one", "two"))
    assert one == two
    shutil.copy(copies[0] / "train" / "r_0.png", copies[1] / "train" / "r_1.png")
    status, _, errors = fitted(copies, tmp_path / "out")
    assert (status, errors.count("error: ")) == (2, 1), errors
    assert errors.startswith(f"process 1: error: {copies[0]}: not the same on ")
    assert "process 0: /proc/self/cwd/train/r_1.png; all processes" in errors
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda frames: None, ""),
        (lambda frames: frames[0]["transform_matrix"][0].__setitem__(3, 9), "camera of training"),
        (lambda frames: frames.pop(0), "training view r_0 is missing"),
        (lambda frames: frames.reverse(), "training views are in another order"),
    ],
)
def test_views_are_compared_with_rank_0(agreement, copies, monkeypatch, change, message):
    monkeypatch.chdir(copies[0])
    first = fingerprint_of(load(copies[0])).model_copy(update={"test": []})
    comm = SimpleNamespace(broadcast_text=lambda text: first.to_bytes().decode())
    edit(copies[0] / "transforms_train.json", lambda meta: change(meta["frames"]))
    refused = pytest.raises(UserError, match=f"not the same on .* for process 0: .*{message}")
    with refused if message else nullcontext():
        agreement.check_views(comm, load(copies[0]), {"r_1"}, copies[0])


@pytest.mark.slow
def test_images_of_different_files_are_refused(tmp_path):
    """A different background is refused; then a different model with the same background."""
    here, there, out = (tmp_path / name for name in ("first", "second", "out"))
    knot = Gaussians.load(parallel_processes.REPOSITORY / "scenes" / "shapes" / "knot.ply")
    for folder, shade in ((here, 0), (there, 9)):
        folder.mkdir()
        knot.save(folder / "model.ply")
        write_png(folder / "behind.png", np.full((4, 4, 3), shade / 255))
    words = ["model.ply", "--origin", 0, -3, 2, "--background", "behind.png", "--out", out]

    def errors_of_rendering(expected_status, count):
        command = ["-m", "drgs.render", *words]
        status, _, errors = parallel_processes.run(2, command, cwd=here, on_second=f"cd {there}")
        assert (status, errors.count("error: ")) == (expected_status, count), errors
        return errors

    start = "process 1: error: {}: not the same on "
    assert errors_of_rendering(2, 1).startswith(start.format("behind.png"))
    shutil.copy(here / "behind.png", there)
    replace(knot, means=knot.means + 0.01).save(there / "model.ply")
    errors = errors_of_rendering(2, 1)
    assert errors.startswith(start.format("model.ply"))
    assert "process 0: means; all processes" in errors
    assert not out.exists()
    shutil.copy(here / "model.ply", there)
    assert not errors_of_rendering(0, 0)


def test_other_versions_are_refused(agreement):
    mi.set_variant("llvm_ad_rgb")
    own = agreement.versions()
    assert own["the vector width"] in ("4", "8", "16")
    agreement.check_versions(own)
    for name in own:
        with pytest.raises(
            UserError, match=f"{name} must be the same everywhere.* got {own[name]}"
        ):
            agreement.check_versions({**own, name: "another"})
