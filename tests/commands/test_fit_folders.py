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
from drgs.core.folders import sole_writer
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


def test_foreign_configuration_is_kept(tmp_path):
    """Whether it is the one to be fitted, or another; also with --overwrite."""
    config = write_project(tmp_path).rename(tmp_path / "config.yml")
    mine = tmp_path / "mine"
    mine.mkdir()
    text = config.read_text().replace("path: data", "path: ../data")
    (mine / "config.yml").write_text(f"# by hand\n{text}")
    replaced = "config.yml: would be replaced, and was not written by a fit, or changed"
    for words, message in (
        ((config, "--out", mine), replaced),
        ((mine / "config.yml", "--out", mine), replaced),
        ((config, "--out", mine, "--overwrite"), "to be replaced, got config.yml; move"),
        ((mine / "config.yml", "--out", mine, "--overwrite"), "replaced, got config.yml; move"),
        ((config, "--out", tmp_path), "would be replaced"),
        ((config, "--out", tmp_path, "--budget", 60), "new or empty"),
    ):
        assert_fit_refused(*words, folder=tmp_path, message=message)


def test_configuration_edited_before_the_first_checkpoint_is_kept(stopped):
    (stopped / "out" / "checkpoint.npz").unlink()
    path = stopped / "out" / "config.yml"
    text = f"# by hand\n{path.read_text()}"
    path.write_text(text)
    words = (stopped / "a.yml", "--out", stopped / "out", "--set", "seed=7")
    assert_fit_refused(*words, folder=stopped, message=f"{path}: would be replaced")
    continue_run(stopped / "out", load_config(path))
    assert path.read_text() == text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["history.csv", "renders/test/mine.png"])
def test_files_that_are_not_a_fits_are_not_removed(ended, name):
    """Whether the fit has recorded its files or, as by earlier versions, not."""
    out = ended / "out"
    (out / name).write_text("with remarks")
    words, message = (ended / "a.yml", "--out", out, "--overwrite"), f"got {name}; move"
    assert_fit_refused(*words, folder=ended, message=message)
    (out / ".drgs-fit.json").unlink()
    if name == "history.csv":
        assert_fits(*words)
    else:
        assert_fit_refused(*words, folder=ended, message=message)


def test_existing_user_image_is_kept(stopped):
    test = stopped / "out" / "renders" / "test"
    test.mkdir(parents=True)
    (test / "r_1.png").symlink_to(stopped / "data" / "test" / "r_1.png")
    message = "out: holds renders/test/r_1.png, which this command would replace"
    assert_fit_refused("--resume", stopped / "out", folder=stopped, message=message)


def test_record_of_a_finished_fit_lists_every_file(ended):
    files = json.loads((ended / "out" / ".drgs-fit.json").read_text())["files"]
    assert set(files) == visible(ended / "out") - {"config.yml"}
    assert all(files.values())


MESSAGE = "out: another command is writing to this folder; wait until it has ended, or choose an"


@pytest.mark.slow
def test_folder_in_use_by_another_fit_is_refused(stopped):
    """Whether it is resumed, replaced or begun again; afterwards it goes on."""
    out = stopped / "out"
    same = (stopped / "a.yml", "--out", out)
    with sole_writer(out):
        for words in (same, ("--resume", out), (*same, "--overwrite")):
            assert_fit_refused(*words, folder=stopped, message=MESSAGE)
    assert_fits("--resume", out)


def replace_an_image(data):
    shutil.copy(data / "train" / "r_0.png", data / "train" / "r_1.png")


@pytest.mark.slow
def test_fit_with_changed_data_is_not_continued(stopped, projects):
    out, data = stopped / "out", stopped / "data"
    image = (data / "train" / "r_1.png").read_bytes()
    replace_an_image(data)
    message = f"checkpoint.npz: belongs to other data than {data}: the image of training view r_1;"
    for words in (["--resume", out], [stopped / "a.yml", "--out", out]):
        assert_fit_refused(*words, folder=stopped, message=message)
    (data / "train" / "r_1.png").write_bytes(image)
    assert "continues at iteration 4" in assert_fits("--resume", out).stdout
    assert_as_uninterrupted(stopped, projects)


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


def test_other_and_moved_data_are_reported(stopped, projects, tmp_path):
    shutil.copytree(stopped / "data", tmp_path / "other")
    replace_an_image(tmp_path / "other")
    words = ("--resume", stopped / "out", "--data", tmp_path / "other")
    message = f"belongs to other data than {tmp_path / 'other'}: the image of training view r_1;"
    assert_fit_refused(*words, folder=stopped, message=message)
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
    folder, words = tmp_path / "data", ["--out", tmp_path / "out"]
    for setting in ("iterations=2", "output.report=false", "output.save_renders=false"):
        words += ["--set", setting]
    first = assert_fits(folder, *words).stdout.splitlines()[0]
    assert first.startswith(
        "no configuration is given, so that it follows from the folder: cut-out"
    )
    assert "2 iterations" in first
    used = load_config(tmp_path / "out" / "config.yml")
    assert used.data.path == folder and used.data.type == "nerf_synthetic"
    twice = [folder, "--data", folder, "--out", tmp_path / "b"]
    assert_fit_refused(*twice, folder=tmp_path, message=f"--data: {folder} is a folder already")
