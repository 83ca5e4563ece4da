"""Folders of ``drgs.fit``: what others wrote stays, and a fit goes on wherever it is moved to.

It also goes on whenever it was killed. The clock of a fit with a budget is replaced: it ends
after an iteration that is given.
"""

import json
import os
import shutil
from functools import partial
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import yaml
from support.commands import assert_ends_well
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

from drgs.config.load import load_config
from drgs.core.folders import sole_writer
from drgs.fit import session
from drgs.render import __main__ as render
from drgs.results.folder import continue_run

POINTS = "out/point_cloud.ply"

LAST = 7  # iteration after which the clock ends a fit

RESULTS = {
    *("config.yml", "point_cloud.ply", "history.csv", "density.csv", "views.json"),
    *("cameras.json", "metrics.json", "report.html"),
    *(f"{kind}/test/r_{i}.png" for kind in ("renders", "side_by_side") for i in range(2)),
}

BUDGET = ("--budget", "60s")


class Killed(BaseException):
    """An exception that no code handles."""


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
    copy = shutil.copytree(project, folder / project.name)
    path = copy / "out" / "config.yml"
    path.write_text(path.read_text().replace(str(project), str(copy)))
    return copy


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """No time is spent on plans and reports."""
    without_images(monkeypatch)

    plan = partial(SimpleNamespace, reasons="planned", chosen=Mock(), end=0.0)
    monkeypatch.setattr(session, "plan_fit", lambda config, *_: plan(config=config))
    monkeypatch.setattr(session, "rehearse", lambda *_, **__: (Mock(), 1.0))
    monkeypatch.setattr(session, "deadline", lambda *_: lambda trainer: trainer.iteration < LAST)


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


@pytest.mark.slow
def test_folder_in_use_by_another_fit_is_refused(stopped):
    """Whether it is resumed, replaced or begun again; afterwards it goes on."""
    out, message = stopped / "out", "out: another command is writing to this folder; wait until"
    same = (stopped / "a.yml", "--out", out)
    with sole_writer(out):
        for words in (same, ("--resume", out), (*same, "--overwrite")):
            assert_fit_refused(*words, folder=stopped, message=message)
    assert_fits("--resume", out)


@pytest.mark.slow
def test_fit_with_other_or_missing_data_is_not_continued(stopped, projects, tmp_path):
    out, data = stopped / "out", stopped / "data"
    other = shutil.copytree(data, tmp_path / "other")
    image = (data / "train" / "r_1.png").read_bytes()
    for folder in (data, other):
        shutil.copy(folder / "train" / "r_0.png", folder / "train" / "r_1.png")
    message = "checkpoint.npz: belongs to other data than {}: the image of training view r_1;"
    for words in (("--resume", out), (stopped / "a.yml", "--out", out)):
        assert_fit_refused(*words, folder=stopped, message=message.format(data))
    words = ("--resume", out, "--data", other)
    assert_fit_refused(*words, folder=stopped, message=message.format(other))
    (data / "train" / "r_1.png").write_bytes(image)
    data.rename(tmp_path / "elsewhere")
    message = f"data.path: there is no folder {data}; say where it is (--data DIR)"
    assert_fit_refused("--resume", out, folder=stopped, message=message)
    outcome = assert_fits("--resume", out, "--data", tmp_path / "elsewhere")
    assert "continues at iteration 4" in outcome.stdout
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


def test_earlier_result_is_kept(ended, tmp_path):
    """Even without its data, and if the fit that replaces it cannot begin."""
    before, out, config = contents(ended), ended / "out", ended / "a.yml"
    recorded = json.loads((out / ".drgs-fit.json").read_text())["files"]
    assert recorded.keys() == visible(out) - {"config.yml"} and all(recorded.values())
    (ended / "data").rename(tmp_path / "data")
    for words in (("--resume", out), ("--resume", out, "--data", tmp_path)):
        assert "this fit is finished" in assert_fits(*words).stdout
    (tmp_path / "data").rename(ended / "data")
    assert "this fit is finished" in assert_fits(config, "--out", out).stdout
    assert contents(ended) == before
    (ended / "data" / "transforms_train.json").write_text("{")
    message = "transforms_train.json: not valid JSON"
    assert_fit_refused(config, "--out", out, "--overwrite", folder=ended, message=message)


def test_orbit_needs_only_the_folder_of_a_fit(ended, tmp_path):
    """Neither its data nor a path to it; views of a moved project are rendered by its data."""
    orbit = ("--orbit", 2, "--out")
    moved = ended.rename(tmp_path / "moved")
    outcome = assert_ends_well(render.main, moved / "out", "--out", tmp_path / "renders")
    assert f"taken from {moved / 'data'}" in outcome.stdout
    assert_ends_well(render.main, moved / "out", *orbit, tmp_path / "by data")
    (moved / "out").rename(tmp_path / "alone")
    shutil.rmtree(moved)
    assert_ends_well(render.main, tmp_path / "alone", *orbit, tmp_path / "orbit")
    assert contents(tmp_path / "orbit") == contents(tmp_path / "by data")
    views = json.loads((tmp_path / "alone" / "views.json").read_text())["frames"]
    assert [view["file_path"] for view in views] == ["r_0", "r_1", "r_2"]


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


# A fit that ends at any moment, before or behind any file that it puts in place, goes on


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return write_project(tmp_path_factory.mktemp("project"))


def run_crashing_fit(moment, behind, *arguments):
    """Run a fit that is ended at the replacement of a file, before or behind it.

    moment: which, by number; None: none. Returns whether it got so far, and the names of what was
    put in place until then.
    """
    replace, names = os.replace, []

    def replace_or_crash(temporary, path):
        names.append(os.path.basename(path))
        is_here = len(names) - 1 == moment
        if is_here and not behind:
            raise Killed
        replace(temporary, path)
        if is_here:
            raise Killed

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(os, "replace", replace_or_crash)
        try:
            assert_fits(*arguments)
        except Killed:
            return True, names
    return False, names


def assert_done(out):
    """All is there and nothing else, and ``config.yml`` says what was done."""
    assert visible(out) - {"plan.txt"} == RESULTS
    rows = (out / "history.csv").read_text().splitlines()
    assert len(rows) == load_config(out / "config.yml").last_iteration + 1


@pytest.mark.slow
@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("budget", [(), BUDGET], ids=["plain", "budget"])
def test_fit_killed_at_any_file_resumes(config, tmp_path, budget, behind):
    """Also behind the last file."""
    _, names = run_crashing_fit(None, False, config, "--out", tmp_path / "whole", *budget)
    assert_done(tmp_path / "whole")
    for moment in range(len(names)):
        out, again = tmp_path / f"{moment}", tmp_path / f"again {moment}"
        was_killed, names = run_crashing_fit(moment, behind, config, "--out", out, *budget)
        assert was_killed
        if (out / "config.yml").is_file():
            outcome = assert_fits("--resume", out)
            is_finished = "metrics.json" in (names if behind else names[:-1])
            assert ("this fit is finished" in outcome.stdout) == is_finished, names
            if "history.csv" in names and not is_finished and not budget:  # results, once more
                assert f"continues at iteration {ITERATIONS}\n" in outcome.stdout
                for name in RESULTS - {"history.csv", "metrics.json", "config.yml"}:
                    expected = (tmp_path / "whole" / name).read_bytes()
                    assert (out / name).read_bytes() == expected, name
        else:
            assert_fits(config, "--out", out, *budget)
        assert_done(out)
        assert_fits(out / "config.yml", "--out", again)
        for name in ("point_cloud.ply", "renders/test/r_1.png"):
            assert (out / name).read_bytes() == (again / name).read_bytes(), name


@pytest.mark.slow
def test_half_removed_run_is_not_finished(config, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert_fits(config, "--out", out)
    unlink, removed = os.unlink, []

    def unlink_two(path, *arguments, **options):
        if len(removed) == 2:
            raise Killed
        removed.append(os.path.basename(path))
        unlink(path, *arguments, **options)

    with monkeypatch.context() as patched, pytest.raises(Killed):
        patched.setattr(os, "unlink", unlink_two)
        run_fit(config, "--out", out, "--overwrite")
    assert removed[0] == "metrics.json"
    assert "this fit is finished" not in assert_fits(config, "--out", out).stdout
    assert_done(out)


# A fit that has ended goes on


def test_a_fit_that_has_ended_goes_on_from_its_gaussians(ended):
    out, before = ended / "out", (ended / "out" / "history.csv").read_text().splitlines()
    more = f"iterations={2 * ITERATIONS}"
    outcome = assert_fits("--resume", out, "--set", more)
    assert f" Gaussians of {out / 'point_cloud.ply'}; near plane" in outcome.stdout
    assert f"goes on after {ITERATIONS} iterations with the rates of a fit of" in outcome.stdout
    rows = (out / "history.csv").read_text().splitlines()
    assert rows[: len(before)] == before and len(rows) == 2 * ITERATIONS + 1
    config = yaml.safe_load((out / "config.yml").read_text())
    assert config["iterations"] == 2 * ITERATIONS and config["init"]["gaussians"] is None
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["iterations"] == 2 * ITERATIONS
    assert "this fit is finished" in assert_fits("--resume", out, "--set", more).stdout
    path = out / "config.yml"  # or the number in the configuration is changed
    text = path.read_text().replace(f"iterations: {2 * ITERATIONS}\n", "iterations: 20\n")
    path.write_text(text)
    assert "goes on after" in assert_fits("--resume", out).stdout
    assert len((out / "history.csv").read_text().splitlines()) == 21


def test_what_a_fit_does_not_go_on_with_is_refused(stopped, ended):
    refused = {
        (stopped, "iterations=99"): "has not ended yet; leave it out",
        (ended, "seed=7"): "--set iterations=N alone goes on",
        (ended, "iterations=x"): "iterations must be an integer, got 'x'",
    }
    for (folder, text), message in refused.items():
        words = "--resume", folder / "out", "--set", text
        assert_fit_refused(*words, folder=folder, message=message)
    (ended / "out" / "metrics.json").write_text("[]")
    message = "metrics.json: must be what a fit wrote, got something else; remove it, and resume"
    assert_fit_refused("--resume", ended / "out", folder=ended, message=message)


@pytest.mark.slow
@pytest.mark.parametrize("behind", [False, True])
def test_a_fit_that_goes_on_may_be_killed_at_any_file(config, tmp_path, behind):
    """Metrics in the folder are those of the Gaussians there, or gone."""
    first = tmp_path / "first"
    assert_fits(config, "--out", first)
    before = (first / "point_cloud.ply").read_bytes()
    for moment in range(100):
        out = tmp_path / str(moment)
        shutil.copytree(first, out)
        more = ("--resume", out, "--set", f"iterations={2 * ITERATIONS}")
        was_killed, _ = run_crashing_fit(moment, behind, *more)
        if (out / "metrics.json").is_file():
            done = json.loads((out / "metrics.json").read_text())["iterations"]
            is_earlier = (out / "point_cloud.ply").read_bytes() == before
            assert done == (1 if is_earlier else 2) * ITERATIONS, moment
        if not was_killed:
            break
        has_ended = (out / "metrics.json").is_file()  # or the fit goes on as it was told before
        assert_fits(*(more if has_ended else more[:2]))
        assert_done(out)
        assert load_config(out / "config.yml").last_iteration == 2 * ITERATIONS
    assert moment > 10
