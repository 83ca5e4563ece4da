"""A type checker, basedpyright in its standard mode, finds nothing in the package."""

import importlib.metadata
import importlib.util
import runpy
import shutil
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY, run_program

OPTIONAL = ("mpi4py", "pycolmap", "viser")  # of the extra "dev"
CHECKER = shutil.which("basedpyright", path=str(Path(sys.executable).parent))


@pytest.mark.slow
@pytest.mark.skipif(
    CHECKER is None or not all(map(importlib.util.find_spec, OPTIONAL)),
    reason="needs the extra dev",
)
def test_type_checker_finds_no_errors():
    """With the settings of ``pyproject.toml``, as in an editor and on the command line."""
    run_program(CHECKER, "--pythonpath", sys.executable)


def test_stubs_are_those_of_the_installed_mitsuba(tmp_path):
    stubs = REPOSITORY / "typings" / "mitsuba"
    version = importlib.metadata.version("mitsuba")
    if f"Mitsuba {version}\n" not in (stubs / "__init__.pyi").read_text()[:200]:
        pytest.skip(f"the stubs are not those of Mitsuba {version}: run .ci/typings.py")
    runpy.run_path(str(REPOSITORY / ".ci" / "typings.py"))["write_stubs"](tmp_path)
    for path in tmp_path.iterdir():
        assert path.read_text() == (stubs / path.name).read_text(), path.name
