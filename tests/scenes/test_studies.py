"""Each study has a result and runs; its numbers are those of the day when it was measured."""

import importlib
import sys

import pytest
from conftest import REPOSITORY

STUDIES = REPOSITORY / "scenes" / "studies"
SCRIPTS = sorted(p.stem for p in STUDIES.glob("*.py") if "__main__" in p.read_text())


@pytest.fixture
def run(monkeypatch, capsys):
    """Run a script: ``run(name, *arguments)`` returns what it prints."""

    def script(name, *arguments):
        monkeypatch.syspath_prepend(STUDIES)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
        importlib.import_module(name).main()
        return capsys.readouterr().out

    return script


def test_every_script_has_its_result_and_is_listed():
    listed = (STUDIES / "README.md").read_text()
    for name in SCRIPTS:
        assert (STUDIES / f"{name}.md").is_file() and f"({name}.py)" in listed


@pytest.mark.parametrize("name", SCRIPTS)
def test_every_script_has_help(run, name, capsys):
    with pytest.raises(SystemExit) as end:
        run(name, "--help")
    assert end.value.code == 0
    assert f"usage: {name}.py" in capsys.readouterr().out


def test_objects_among_splats_are_timed(run):
    printed = run("hybrid", "--gaussians", "100", "--size", "16", "--rounds", "1")
    assert printed.count("| 100 |") == 2


@pytest.mark.slow
def test_kernels_are_counted_and_machines_predicted(run):
    printed = run("kernels", "--gaussians", "200", "--size", "32", "--rounds", "1")
    assert "| a training iteration |" in printed
    assert "| 64 | 25 Gbit/s |" in run("prediction", "--quick")
