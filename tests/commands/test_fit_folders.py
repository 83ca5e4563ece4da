"""Folders of ``drgs.fit``: what others wrote stays, and a fit goes on wherever it is moved to."""

import json
import shutil

import numpy as np
import pytest
import yaml
from support.commands import assert_ends_well, assert_refused
from support.fit_command import (
    ITERATIONS,
    assert_fit_refused,
    assert_fits,
    run_fit,
    stop_after,
    without_images,
    write_project,
)
from support.folders import contents, visible
from support.small_capture import blobs

from drgs import render
from drgs.config.load import load_config
from drgs.results.folder import continue_run

POINTS = "out/point_cloud.ply"


@pytest.fixture(scope="module")
def projects(tmp_path_factory):
    """The folders of a project whose fit has ended, and of one whose fit was stopped."""
    with pytest.MonkeyPatch.context() as patched:
        without_images(patched)
        folder = tmp_path_factory.mktemp("projects")
        for name in ("ended", "stopped"):
            (folder / name).mkdir()
            config = write_project(folder / name)
            if name == "stopped":
                stop_after(patched, 5)
            outcome = run_fit(config, "--out", folder / name / "out")
            assert outcome.returncode == (130 if name == "stopped" else 0), outcome.stderr
    return folder


@pytest.fixture
def ended(projects, tmp_path):
    return copied(projects / "ended", tmp_path)


@pytest.fixture
def stopped(projects, tmp_path):
    return copied(projects / "stopped", tmp_path)


def copied(project, folder):
    """The project, as if it had been made in ``folder``."""
    project = shutil.copytree(project, folder / project.name)
    path = project / "out" / "config.yml"
    values = yaml.safe_load(path.read_text())
    values["data"]["path"] = str(project / "data")
    values["output"]["dir"] = str(project / "out")
    path.write_text(yaml.safe_dump(values, sort_keys=False))
    return project


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    without_images(monkeypatch)


def assert_as_uninterrupted(folder, projects):
    assert (folder / POINTS).read_bytes() == (projects / "ended" / POINTS).read_bytes()
    assert visible(folder / "out") == visible(projects / "ended" / "out")
    rows = (folder / "out" / "history.csv").read_text().splitlines()
    assert len(rows) == ITERATIONS + 1


# ----------------------------------------------------------------------------------------------
# Files of others
# ----------------------------------------------------------------------------------------------


def test_foreign_configuration_is_kept(tmp_path):
    """Whether it is the one to be fitted, or another; also with --overwrite."""
    config = write_project(tmp_path)
    config = config.rename(tmp_path / "config.yml")
    text = config.read_text()
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "config.yml").write_text(f"# by hand\n{text.replace('path: data', 'path: ../data')}")
    for file in (config, mine / "config.yml"):
        message = (
            f"{mine / 'config.yml'}: would be replaced, and was not written by a fit, or changed"
        )
        assert_fit_refused(file, "--out", mine, folder=tmp_path, message=message)
        message = f"{mine}: must hold nothing but a run to be replaced, got config.yml; move"
        assert_fit_refused(file, "--out", mine, "--overwrite", folder=tmp_path, message=message)
    arguments = (config, "--out", tmp_path)
    for options, expected in (([], "would be replaced"), (["--budget", 60], "new or empty")):
        assert_fit_refused(*arguments, *options, folder=tmp_path, message=expected)


@pytest.mark.slow
def test_configuration_written_by_a_fit_can_be_fitted_in_place(ended, projects):
    (ended / "again").mkdir()
    shutil.copy(ended / "out" / "config.yml", ended / "again")
    arguments = (ended / "again" / "config.yml", "--data", ended / "data")
    assert_fits(*arguments, "--out", ended / "again")
    expected = (projects / "ended" / POINTS).read_bytes()
    assert (ended / "again" / "point_cloud.ply").read_bytes() == expected


def test_configuration_edited_before_the_first_checkpoint_is_kept(stopped):
    (stopped / "out" / "checkpoint.npz").unlink()
    path = stopped / "out" / "config.yml"
    path.write_text(f"# by hand\n{path.read_text()}")
    arguments = (stopped / "a.yml", "--out", stopped / "out")
    assert_fit_refused(
        *arguments, "--set", "seed=7", folder=stopped, message=f"{path}: would be replaced"
    )
    text = path.read_text()
    continue_run(stopped / "out", load_config(stopped / "out" / "config.yml"))
    assert path.read_text() == text


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["notes.txt", "renders/mine.png", "renders/test/mine.png", "side_by_side/.mine"]
)
@pytest.mark.parametrize("recorded", [True, False])
def test_foreign_files_are_not_removed_with_a_run(ended, name, recorded):
    out = ended / "out"
    if not recorded:
        (out / ".drgs-fit.json").unlink()
    (out / name).parent.mkdir(exist_ok=True)
    (out / name).write_text("mine")
    message = f"must hold nothing but a run to be replaced, got {name}; move that away"
    arguments = (ended / "a.yml", "--out", out, "--overwrite")
    assert_fit_refused(*arguments, folder=ended, message=message)
    if name == "notes.txt" and recorded:
        (out / name).unlink()
        assert_fits(*arguments)


def test_modified_results_are_not_removed(ended):
    (ended / "out" / "history.csv").write_text("with remarks")
    arguments = (ended / "a.yml", "--out", ended / "out", "--overwrite")
    assert_fit_refused(*arguments, folder=ended, message="got history.csv; move")


def test_existing_user_image_is_kept(stopped):
    (stopped / "out" / "renders" / "test").mkdir(parents=True)
    (stopped / "out" / "renders" / "test" / "r_1.png").symlink_to(
        stopped / "data" / "test" / "r_1.png"
    )
    message = "out: holds renders/test/r_1.png, which this command would replace"
    assert_fit_refused("--resume", stopped / "out", folder=stopped, message=message)


def test_record_of_a_finished_fit_lists_every_file(ended):
    files = json.loads((ended / "out" / ".drgs-fit.json").read_text())["files"]
    assert set(files) == visible(ended / "out") - {"config.yml"}
    assert all(files.values())


# ----------------------------------------------------------------------------------------------
# Changed data
# ----------------------------------------------------------------------------------------------


def edit(folder, change, split="train"):
    """Change the parsed frames of a split."""
    path = folder / f"transforms_{split}.json"
    values = json.loads(path.read_text())
    change(values["frames"])
    path.write_text(json.dumps(values))


def another_image(folder, split="train"):
    shutil.copy(folder / split / "r_0.png", folder / split / "r_1.png")


def resize_training_images(folder):
    """Return other sizes for all training images."""
    from PIL import Image

    for path in (folder / "train").iterdir():
        with Image.open(path) as image:
            image.resize((16, 12)).save(path)


def moved_camera(frames):
    frames[2]["transform_matrix"][0][3] += 1e-3


def masked(folder):
    from PIL import Image

    Image.new("L", (32, 24), 255).save(folder / "mask.png")
    edit(folder, lambda frames: frames[0].update(mask_path="mask.png"))


CHANGES = {
    "training view r_1 is missing": lambda data: edit(data, lambda frames: frames.pop(1)),
    "training view r_9 is new": lambda data: (
        shutil.copy(data / "train" / "r_0.png", data / "train" / "r_9.png"),
        edit(data, lambda frames: frames.append({**frames[0], "file_path": "train/r_9"})),
    ),
    "the training views are in another order": lambda data: edit(data, list.reverse),
    "the image of training view r_1": another_image,
    "the size (32x24, now 16x12) of training view r_0, the image of training view r_0, the size "
    "(32x24, now 16x12) of training view r_1 and 3 more": resize_training_images,
    "the camera of training view r_2": lambda data: edit(data, moved_camera),
    "the mask of training view r_0": masked,
    "the image of test view r_1": lambda data: another_image(data, "test"),
}


@pytest.mark.slow
@pytest.mark.parametrize("text", CHANGES)
def test_fit_with_changed_data_is_not_continued(stopped, text):
    CHANGES[text](stopped / "data")
    out, data = stopped / "out", stopped / "data"
    for arguments in (["--resume", out], [stopped / "a.yml", "--out", out]):
        message = f"checkpoint.npz: belongs to other data than {data}: {text}; give the folder"
        assert_fit_refused(*arguments, folder=stopped, message=message)


@pytest.mark.slow
def test_rewritten_identical_images_are_the_same_data(stopped, projects):
    for path in (stopped / "data").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes())
    assert "continues at iteration 4" in assert_fits("--resume", stopped / "out").stdout
    assert_as_uninterrupted(stopped, projects)


# ----------------------------------------------------------------------------------------------
# Moved
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("by", ["resume", pytest.param("same command", marks=pytest.mark.slow)])
def test_moved_project_is_continued(stopped, projects, tmp_path, by):
    moved = stopped.rename(tmp_path / "after")
    arguments = ["--resume", moved / "out"]
    if by == "same command":
        arguments = [moved / "a.yml", "--out", moved / "out"]
    outcome = assert_fits(*arguments)
    note = f"data.path: {stopped / 'data'} is not there any more; taken from {moved / 'data'}\n"
    assert (note in outcome.stdout) == (by == "resume")
    assert "continues at iteration 4" in outcome.stdout
    assert_as_uninterrupted(moved, projects)


def test_moved_data_is_reported(stopped, projects, tmp_path):
    (stopped / "data").rename(tmp_path / "elsewhere")
    message = f"data.path: there is no folder {stopped / 'data'}; say where it is (--data DIR)"
    assert_fit_refused("--resume", stopped / "out", folder=stopped, message=message)
    assert_fits("--resume", stopped / "out", "--data", tmp_path / "elsewhere")
    assert_as_uninterrupted(stopped, projects)


@pytest.mark.slow
def test_point_cloud_moved_with_the_data_is_found(tmp_path, monkeypatch):
    config = write_project(tmp_path, init={"point_cloud": "data/points.ply"})
    blobs().save(tmp_path / "data" / "points.ply")
    with monkeypatch.context() as patched:
        stop_after(patched, 2)
        assert run_fit(config, "--out", tmp_path / "out").returncode == 130
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    assert_fits("--resume", tmp_path / "out", "--data", tmp_path / "elsewhere")
    found = load_config(tmp_path / "out" / "config.yml")
    assert found.init.point_cloud == tmp_path / "elsewhere" / "points.ply"


@pytest.mark.slow
def test_path_may_be_edited_by_hand(stopped, projects, tmp_path):
    (stopped / "data").rename(tmp_path / "elsewhere")
    path = stopped / "out" / "config.yml"
    values = yaml.safe_load(path.read_text())
    values["data"]["path"] = str(tmp_path / "elsewhere")
    text = f"# moved to elsewhere\n{yaml.safe_dump(values)}"
    path.write_text(text)
    assert_fits("--resume", stopped / "out")
    assert path.read_text() == text
    assert_as_uninterrupted(stopped, projects)


def test_different_data_is_refused_by_content(stopped, tmp_path):
    shutil.copytree(stopped / "data", tmp_path / "other")
    another_image(tmp_path / "other")
    arguments = ("--resume", stopped / "out", "--data", tmp_path / "other")
    message = f"belongs to other data than {tmp_path / 'other'}: the image of training view r_1;"
    assert_fit_refused(*arguments, folder=stopped, message=message)


def test_finished_fit_stays_finished_without_its_data(ended, tmp_path):
    before = contents(ended)
    for options in ([], ["--data", tmp_path]):
        outcome = assert_fits("--resume", ended / "out", *options)
        assert "this fit is finished" in outcome.stdout
    assert contents(ended) == before


def test_moved_fit_without_a_record_is_continued(stopped, projects, tmp_path):
    """And its files have fewer values."""
    out = stopped.rename(tmp_path / "after") / "out"
    with np.load(out / "checkpoint.npz") as file:
        arrays = dict(file)
    for name in ("config", "config_before"):
        config = json.loads(str(arrays[name]))
        del config["model"]["smoothing"]
        arrays[name] = np.array(json.dumps(config, sort_keys=True))
    np.savez(out / "checkpoint.npz", **arrays)
    values = yaml.safe_load((out / "config.yml").read_text())
    del values["model"]["smoothing"]
    (out / "config.yml").write_text(yaml.safe_dump(values, sort_keys=False))
    outcome = assert_fits("--resume", out)
    assert "continues at iteration 4" in outcome.stdout
    assert_as_uninterrupted(out.parent, projects)


def test_orbit_needs_only_the_folder_of_a_fit(ended, tmp_path):
    """Neither its data nor a path to it; the images are those of the cameras of the data."""
    orbit = ("--orbit", 2, "--out")
    arguments = (ended / "out", "--data", ended / "data", *orbit, tmp_path / "by data")
    assert_ends_well(render.main, *arguments)
    (ended / "out").rename(tmp_path / "alone")
    shutil.rmtree(ended)
    assert_ends_well(render.main, tmp_path / "alone", *orbit, tmp_path / "orbit")
    assert contents(tmp_path / "orbit") == contents(tmp_path / "by data")
    views = json.loads((tmp_path / "alone" / "views.json").read_text())["frames"]
    assert [view["file_path"] for view in views] == ["r_0", "r_1", "r_2"]


def test_views_of_a_moved_project_are_rendered(ended, tmp_path):
    moved = ended.rename(tmp_path / "moved")
    outcome = assert_ends_well(render.main, moved / "out", "--out", tmp_path / "renders")
    assert f"taken from {moved / 'data'}" in outcome.stdout
    (moved / "data").rename(tmp_path / "elsewhere")
    message = "there is no folder /"
    arguments = (moved / "out", "--out", tmp_path / "b")
    assert_refused(render.main, *arguments, folder=tmp_path, message=message)


def test_folder_is_fitted_without_a_configuration(tmp_path):
    write_project(tmp_path)
    folder, few = tmp_path / "data", ["--set", "iterations=2", "--set", "output.report=false"]
    few += ["--set", "output.save_renders=false", "--out", tmp_path / "out"]
    outcome = run_fit(folder, *few)
    assert outcome.returncode == 0, outcome.stderr
    first = outcome.stdout.splitlines()[0]
    assert first.startswith(
        "no configuration is given, so that it follows from the folder: cut-out"
    )
    assert "2 iterations" in first
    used = load_config(tmp_path / "out" / "config.yml")
    assert used.data.path == folder and used.data.type == "nerf_synthetic"
    twice = [folder, "--data", folder, "--out", tmp_path / "b"]
    assert_fit_refused(*twice, folder=tmp_path, message=f"--data: {folder} is a folder already")
