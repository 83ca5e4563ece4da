"""Output folders of fits: which are taken, continued, removed and refused."""

import os

import pytest
from support.folders import contents, visible

from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.results.files import METRICS, RESULTS
from drgs.results.folder import (
    FOLDERS,
    claim_output_folder,
    image_names,
    is_finished,
    load_run_config,
    remove_run,
)

IMAGES = image_names("test", ["r_0", "r_1"])


@pytest.fixture
def config(tmp_path):
    return FitConfig(data={"path": tmp_path / "data"})


@pytest.fixture
def finished(tmp_path, config):
    """The folder of a run that has written something."""
    folder = tmp_path / "out"
    claim_output_folder(folder, config, IMAGES)
    for name in ("point_cloud.ply", *IMAGES):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("result")
    return folder


def refusal(function, *arguments):
    with pytest.raises(UserError) as error:
        function(*arguments)
    return str(error.value)


def test_missing_folder_is_created_with_the_configuration(tmp_path, config):
    claim_output_folder(tmp_path / "a" / "b", config)
    assert visible(tmp_path / "a" / "b") == {"config.yml"}
    assert load_config(tmp_path / "a" / "b" / "config.yml") == config


@pytest.mark.parametrize("name", [".DS_Store", "config.yml"])
def test_folder_without_results_is_accepted(tmp_path, config, name):
    (tmp_path / name).write_text("")
    claim_output_folder(tmp_path, config)
    assert load_run_config(tmp_path) == config


def test_run_with_the_same_configuration_may_continue(finished, config):
    before = contents(finished)
    same = FitConfig(data=config.data, output={"history_every": 3})
    claim_output_folder(finished, same, IMAGES)
    assert load_run_config(finished) == same
    assert {**contents(finished), "config.yml": None} == {**before, "config.yml": None}


def test_run_with_its_last_file_and_configuration_is_finished(finished, config):
    assert not is_finished(finished, config)
    (finished / METRICS).write_text("{}")
    assert is_finished(finished, config)
    assert not is_finished(finished, FitConfig(data=config.data, seed=7))
    (finished / "config.yml").write_text("[")
    assert not is_finished(finished, config)


def test_temporary_files_of_a_killed_run_are_removed(finished, config):
    kept = {".DS_Store", ".notes.tmp.txt", "point_cloud.ply", *IMAGES}
    for name in (".checkpoint.4711.tmp.npz", "renders/.r_1.4711.tmp.png", *kept):
        (finished / name).write_text("half")
    claim_output_folder(finished, config)
    assert contents(finished).keys() == {".drgs-fit.json", "config.yml", *kept}


def test_differing_run_is_reported_with_its_differences(finished, config):
    changes = {"init": {"half_extent": 2.0}, "densify": {"every": 9}, "loss": {"sigma": 2.0}}
    other = FitConfig(data=config.data, seed=7, **changes)
    assert (
        "already holds another run, which differs in init.half_extent = None (here 2.0), "
        "loss.sigma = 1.5 (here 2.0), densify.every = 100 (here 9) and 1 more; choose"
    ) in refusal(claim_output_folder, finished, other)


def test_run_with_a_broken_configuration_is_kept(finished, config):
    (finished / "config.yml").write_text("[")
    before = contents(finished)
    refused = refusal(claim_output_folder, finished, config)
    assert "holds another run, with a config.yml that is not readable; choose" in refused
    assert "not valid YAML" in refusal(remove_run, finished)
    assert contents(finished) == before


def test_folder_with_foreign_files_is_refused(tmp_path, config):
    for name in "dbca":
        (tmp_path / name).write_text("")
    refused = refusal(claim_output_folder, tmp_path, config)
    assert "must be new or empty, got one that holds a, b, c and 1 more; choose" in refused
    assert sorted(os.listdir(tmp_path)) == ["a", "b", "c", "d"]


def test_file_in_place_of_the_folder_is_refused(tmp_path, config):
    (tmp_path / "out").write_text("mine")
    for folder, reason in (("out", "File exists"), ("out/deeper", "Not a directory")):
        refused = refusal(claim_output_folder, tmp_path / folder, config)
        assert f"{reason}; choose another folder: a part of this path is a file" in refused
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize("function", ["mkdir", "listdir"])
def test_folder_without_permission_is_refused(tmp_path, config, monkeypatch, function):
    def refuse(*arguments, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, function, refuse)
    refused = refusal(claim_output_folder, tmp_path / "out", config)
    assert "cannot be the output folder: Permission denied; choose a folder that" in refused


def test_removing_a_run_deletes_every_result(tmp_path, config):
    remove_run(tmp_path / "none")
    remove_run(tmp_path)
    claim_output_folder(tmp_path, config)
    for name in RESULTS:
        if name in FOLDERS:
            (tmp_path / name / "empty").mkdir(parents=True)
        else:
            (tmp_path / name).write_text("")
    remove_run(tmp_path)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("is_recorded", [True, False])
def test_folder_in_place_of_a_result_is_not_removed(finished, is_recorded):
    if not is_recorded:
        (finished / ".drgs-fit.json").unlink()
    (finished / "curves.png").mkdir()
    before = contents(finished)
    assert "got curves.png" in refusal(remove_run, finished, IMAGES)
    assert contents(finished) == before


def test_foreign_files_are_never_removed(finished):
    (finished / "notes.txt").write_text("mine")
    before = contents(finished)
    message = "must hold nothing but a run to be replaced, got notes.txt; move that away"
    assert message in refusal(remove_run, finished)
    assert contents(finished) == before
    (finished / "config.yml").unlink()
    message = "is not the output folder of a fit: it has no config.yml"
    assert message in refusal(remove_run, finished)


def test_a_folder_without_a_run_cannot_be_continued(tmp_path):
    message = "is not the output folder of a fit: it does not exist, and so has no config.yml"
    assert refusal(load_run_config, tmp_path / "none") == f"{tmp_path}/none: {message}"
