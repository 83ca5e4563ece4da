"""Output folders of fits: which are taken, continued, removed and refused."""

import ast
import os

import pytest
from conftest import REPOSITORY
from support.folders import contents

from drgs.config.changes import is_open, with_changes
from drgs.config.extensions import EFFECTS
from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.results import folder as files
from drgs.results.folder import (
    FOLDERS,
    METRICS,
    check_output_folder,
    claim_output_folder,
    continue_run,
    image_names,
    is_finished,
    load_run_config,
    remove_run,
    result_names,
)
from drgs.results.model import load_open_config

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


def assert_refused(message, function, folder, *arguments):
    """And all files are kept."""
    before = contents(folder)
    with pytest.raises(UserError) as error:
        function(folder, *arguments)
    assert message in str(error.value) and contents(folder) == before


@pytest.mark.parametrize("name", [".DS_Store", "config.yml"])
def test_folder_without_results_is_accepted(tmp_path, config, name):
    (tmp_path / name).write_text("")
    claim_output_folder(tmp_path, config)
    assert load_run_config(tmp_path) == config


def test_run_with_the_same_configuration_may_continue_and_finish(finished, config):
    before = contents(finished)
    same = FitConfig(data=config.data, output={"history_every": 3})
    claim_output_folder(finished, same, IMAGES)
    assert load_run_config(finished) == same
    assert {**contents(finished), "config.yml": None} == {**before, "config.yml": None}
    assert not is_finished(finished, config)
    (finished / METRICS).write_text("{}")
    assert is_finished(finished, config)
    assert not is_finished(finished, FitConfig(data=config.data, seed=7))


def test_configuration_before_defaults_matches_those_that_the_data_decided(tmp_path, photographs):
    photos = REPOSITORY / "scenes" / "photos.yml"
    config = load_open_config(photos, [f"data.path={photographs}"], None)
    assert config.data.background_rgb == (0, 0, 0)
    assert config.model.near == 0.2  # a twenty-fifth of 4.1, to one digit
    assert not is_open(config) and is_open(load_config(photos))
    given = FitConfig(data={"path": tmp_path})
    decided = with_changes(given, {"data.background": "black", "model.near": 0.3})
    out = tmp_path / "new" / "out"
    claim_output_folder(out, decided)
    assert load_run_config(out) == decided
    (out / METRICS).write_text("{}")
    assert is_finished(out, given)
    assert not is_finished(out, with_changes(given, {"model.near": 0.2}))


def test_temporary_files_of_a_killed_run_are_removed(finished, config):
    kept = {".DS_Store", ".notes.tmp.txt", "point_cloud.ply", *IMAGES}
    for name in (".checkpoint.4711.tmp.npz", "renders/.r_1.4711.tmp.png", *kept):
        (finished / name).write_text("half")
    claim_output_folder(finished, config)
    assert contents(finished).keys() == {".drgs-fit.json", "config.yml", *kept}


def test_other_runs_and_foreign_files_are_refused_and_kept(tmp_path, finished, config):
    changes = {"init": {"half_extent": 2.0}, "densify": {"every": 9}, "loss": {"dssim_weight": 0.5}}
    message = (
        "already holds another run, which differs in init.half_extent = None (here 2.0), "
        "loss.dssim_weight = 0.2 (here 0.5), densify.every = 100 (here 9) and 1 more; choose"
    )
    other = FitConfig(data=config.data, seed=7, **changes)
    assert_refused(message, claim_output_folder, finished, other)
    (finished / METRICS).write_text("{}")
    (finished / "notes.txt").write_text("mine")
    message = "must hold nothing but a run to be replaced, got notes.txt; move that away"
    assert_refused(message, remove_run, finished)
    (finished / "config.yml").write_text("[")
    message = "holds another run, with a config.yml that is not readable; choose"
    assert_refused(message, claim_output_folder, finished, config)
    assert_refused("not valid YAML", remove_run, finished)
    assert not is_finished(finished, config)
    (finished / "config.yml").unlink()
    message = "is not the output folder of a fit: it has no config.yml"
    assert_refused(message, remove_run, finished)
    message = (
        "/none: is not the output folder of a fit: it does not exist, and so has no config.yml"
    )
    assert_refused(message, load_run_config, tmp_path / "none")
    mine = tmp_path / "mine"
    mine.mkdir()
    for name in "dbca":
        (mine / name).write_text("mine")
    message = "must be new or empty, got one that holds a, b, c and 1 more; choose"
    assert_refused(message, claim_output_folder, mine, config)
    for folder, reason in (("a", "File exists"), ("a/deeper", "Not a directory")):
        message = f"{reason}; choose another folder: a part of this path is a file"
        assert_refused(message, claim_output_folder, mine / folder, config)
    message = "a: cannot be the output folder: Not a directory; choose another folder"
    assert_refused(message, check_output_folder, mine / "a", config)
    assert contents(mine) == dict.fromkeys("abcd", b"mine")


def test_removing_a_run_deletes_every_result(tmp_path, config):
    remove_run(tmp_path / "none")
    remove_run(tmp_path)
    claim_output_folder(tmp_path, with_changes(config, {"output.small_file": "sog"}))
    for name in result_names():
        if name in FOLDERS:
            (tmp_path / name / "empty").mkdir(parents=True)
        else:
            (tmp_path / name).write_text("")
    remove_run(tmp_path)
    assert os.listdir(tmp_path) == []


def test_exported_file_with_the_name_of_a_small_one_is_kept(finished, config):
    """It is in the way of a fit that would write it, and of no other."""
    (finished / "point_cloud.sog").write_text("mine")
    claim_output_folder(finished, config)
    small = with_changes(config, {"output.small_file": "sog"})
    assert_refused(
        "point_cloud.sog, which this command would replace", continue_run, finished, small
    )
    assert_refused("got point_cloud.sog", remove_run, finished)


@pytest.mark.parametrize("is_recorded", [True, False])
def test_folder_in_place_of_a_result_is_not_removed(finished, is_recorded):
    if not is_recorded:
        (finished / ".drgs-fit.json").unlink()
    (finished / "curves.png").mkdir()
    assert_refused("got curves.png", remove_run, finished, IMAGES)
    assert (finished / "curves.png").is_dir()


EFFECT_NAMES = {f"effects/{e.name}.py": set(e.value.files) for e in EFFECTS.all()}

OTHER_NAMES = {files.CONFIG, *result_names()} - set().union(*EFFECT_NAMES.values())
OTHER_NAMES -= set(files.small_file_names().values())  # made of a format's suffix

ALLOWED_NAMES = {
    "results/folder.py": OTHER_NAMES,
    **EFFECT_NAMES,
    "datasets/folders.py": {"cameras.json"},  # of another program
    "datasets/other_programs.py": {"cameras.json"},
}


@pytest.mark.slow
def test_file_names_are_written_in_one_module_only():
    for path in sorted((REPOSITORY / "drgs").rglob("*.py")):
        # Docstrings and messages are longer than a name.
        nodes = ast.walk(ast.parse(path.read_text()))
        strings = {node.value for node in nodes if isinstance(node, ast.Constant)} - {None}
        module = path.relative_to(REPOSITORY / "drgs").as_posix()
        assert {files.CONFIG, *result_names()} & strings == ALLOWED_NAMES.get(module, set()), module
