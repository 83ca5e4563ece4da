"""Scripts and commands run, and write into the checkout only if they are told to."""

import importlib
import sys

import numpy as np
import pytest
from conftest import REPOSITORY

SCENES = REPOSITORY / "scenes"
STUDIES = SCENES / "studies"

SCRIPTS = {
    "compare_shapes": ((), {"out/shapes.png"}),
    "knot": ((), {"out/knot.ply"}),
    "draw_tiles": ((), {"out/tiles.png"}),
    "flat_mirror": (("--size", 8, "--splats", 20), set()),
    "among_surfaces": ((), set()),
    "relight": ((SCENES / "shapes" / "knot.ply",), {"out/relight/target.png"}),
}
"""Arguments, and the files that are written to the current folder."""


def main_scripts(folder):
    return sorted(path.stem for path in folder.glob("*.py") if "__main__" in path.read_text())


def files_of_the_checkout():
    """Return path, size and time of the last change of each file."""
    folders = (REPOSITORY / name for name in ("docs", "drgs", "plugins", "scenes", "tests"))
    paths = [path for folder in folders for path in folder.rglob("*")]
    kept = [path for path in paths if path.is_file() and "__pycache__" not in path.parts]
    return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in kept}


@pytest.fixture
def load_script(monkeypatch, tmp_path):
    """Load a script in an empty folder, as with these arguments: load(name, *arguments)."""

    def load(name, *arguments):
        for folder in (SCENES, STUDIES, REPOSITORY / "docs"):
            monkeypatch.syspath_prepend(folder)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, arguments)])
        return importlib.import_module(name)

    return load


def write_image(*arguments):
    """In the place of what a script computes."""
    arguments[-1].mkdir(parents=True)
    (arguments[-1] / "target.png").write_text("an image")


def test_every_script_is_tested_and_every_study_has_its_result():
    assert {*main_scripts(SCENES), *main_scripts(REPOSITORY / "docs")} == SCRIPTS.keys()
    listed = (STUDIES / "README.md").read_text()
    for name in main_scripts(STUDIES):
        assert (STUDIES / f"{name}.md").is_file() and f"({name}.py)" in listed


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_script_writes_to_the_current_folder(load_script, monkeypatch, tmp_path, capsys, name):
    arguments, written = SCRIPTS[name]
    module = load_script(name, *arguments)
    if name == "compare_shapes":
        result = module.Result(np.zeros((4, 4, 3)), 1.0)
        monkeypatch.setattr(module, "measure", lambda *arguments: result)
    if name == "relight":
        monkeypatch.setattr(module, "relight", write_image)
    if name == "among_surfaces":
        for rows in ("furnace_rows", "shadow_rows"):
            monkeypatch.setattr(module, rows, lambda *arguments: [])
    before = files_of_the_checkout()
    module.main()
    assert files_of_the_checkout() == before
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.p*")} == written
    assert written or capsys.readouterr().out.count("\n") >= 4


@pytest.mark.parametrize("name", main_scripts(STUDIES))
def test_every_study_has_help(load_script, name, capsys):
    with pytest.raises(SystemExit) as end:
        load_script(name, "--help").main()
    assert end.value.code == 0
    assert f"usage: {name}.py" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "arguments", "printed"),
    [
        ("hybrid", "--gaussians 100 --size 16 --rounds 1", "| 100 |"),
        ("kernels", "--gaussians 200 --size 32 --rounds 1", "| a training iteration |"),
        ("prediction", "--quick", "| 64 | 25 Gbit/s |"),
    ],
)
def test_study_runs(load_script, name, arguments, printed, capsys):
    load_script(name, *arguments.split()).main()
    assert printed in capsys.readouterr().out
