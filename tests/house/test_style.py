import subprocess
import sys
from importlib.util import find_spec

import pytest
from conftest import REPOSITORY

COMMANDS = ["ruff check .", "ruff format --check .", "codespell_lib ."]


@pytest.mark.parametrize("command", COMMANDS)
def test_source_is_clean(command):
    module, *arguments = command.split()
    if find_spec(module) is None:
        pytest.skip(f"{module} is not installed")
    result = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_misspellings_are_found(tmp_path):
    pytest.importorskip("codespell_lib")
    (tmp_path / "a.txt").write_text("rec" + "ieve")
    command = [sys.executable, "-m", "codespell_lib", str(tmp_path)]
    assert subprocess.run(command, cwd=REPOSITORY, capture_output=True).returncode != 0
