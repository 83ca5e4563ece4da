"""No command and no script writes into the checkout unless it is told to."""

import importlib
import sys

import numpy as np
import pytest
from conftest import REPOSITORY

from drgs.__main__ import COMMANDS
from drgs.bench.__main__ import COMMANDS as MEASUREMENTS
from drgs.cli.commands import CommandParser

SCENES = REPOSITORY / "scenes"
FOLDERS = ("docs", "drgs", "plugins", "scenes", "tests")
SCRIPTS = ("among_surfaces", "compare_shapes", "draw_tiles", "flat_mirror", "knot", "relight")
MODULES = [c.module for c in COMMANDS.values()] + [f"drgs.bench.{name}" for name in MEASUREMENTS]


def files_of_the_checkout():
    """Return path, size and time of the last change of each file."""
    paths = [path for folder in FOLDERS for path in (REPOSITORY / folder).rglob("*")]
    kept = [path for path in paths if path.is_file() and "__pycache__" not in path.parts]
    return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in kept}


def photographs_in(folder):
    """In the place of what a script computes."""
    folder.mkdir(parents=True)
    (folder / "target.png").write_text("an image")


@pytest.fixture
def script(monkeypatch, tmp_path):
    """Runs one in another folder, without what takes long: script(name, *arguments)."""

    def run(name, *arguments):
        for folder in (SCENES, REPOSITORY / "docs"):
            monkeypatch.syspath_prepend(folder)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, arguments)])
        module = importlib.import_module(name)
        if name == "compare_shapes":
            result = module.Result(np.zeros((4, 4, 3)), 1.0)
            monkeypatch.setattr(module, "measure", lambda *arguments: result)
        if name == "relight":
            monkeypatch.setattr(module, "relight", lambda *arguments: photographs_in(arguments[-1]))
        if name == "among_surfaces":
            for rows in ("furnace_rows", "shadow_rows"):
                monkeypatch.setattr(module, rows, lambda *arguments: [])
        before = files_of_the_checkout()
        module.main()
        assert files_of_the_checkout() == before
        return {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.p*")}

    return run


def test_every_script_is_tested():
    files = [path for folder in ("docs", "scenes") for path in (REPOSITORY / folder).glob("*.py")]
    found = {path.stem for path in files if "__main__" in path.read_text()}
    assert found == set(SCRIPTS)


def test_shape_images_are_written_to_the_current_folder(script):
    assert script("compare_shapes") == {"out/shapes.png"}


@pytest.mark.slow
def test_knot_is_written_to_the_current_folder(script):
    assert script("knot") == {"out/knot.ply"}


@pytest.mark.slow
def test_tile_image_is_written_to_the_current_folder(script):
    assert script("draw_tiles") == {"out/tiles.png"}


@pytest.mark.slow
def test_flat_mirror_table_is_only_printed(script, capsys):
    assert script("flat_mirror", "--size", 8, "--splats", 20) == set()
    assert capsys.readouterr().out.count("\n") == 6


def test_among_surfaces_tables_are_only_printed(script, capsys):
    assert script("among_surfaces") == set()
    assert capsys.readouterr().out.count("\n") == 4


def test_relit_images_are_written_to_the_current_folder(script):
    model = SCENES / "shapes" / "knot.ply"
    assert script("relight", model) == {"out/relight/target.png"}


@pytest.mark.parametrize("module", MODULES)
def test_commands_write_to_the_current_folder_by_default(module):
    parser = CommandParser(prog="command")
    importlib.import_module(module).add_arguments(parser)
    for action in parser._actions:
        if action.dest == "out":
            assert action.required or action.default is None or not action.default.is_absolute()


def test_modified_file_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "REPOSITORY", tmp_path)
    path = tmp_path / "docs" / "a.png"
    path.parent.mkdir()
    path.write_text("a")
    before = files_of_the_checkout()
    assert set(before) == {path}
    path.write_text("bb")
    assert files_of_the_checkout() != before
