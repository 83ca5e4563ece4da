"""Linters, formatter, spelling and layers, as configured in pyproject.toml."""

import sys
from importlib.util import find_spec

import pytest
from conftest import run_program

LAYERS = "-c from importlinter.cli import lint_imports; exit(lint_imports(no_cache=True))"

COMMANDS = {
    "ruff check": ("ruff", "-m ruff check ."),
    "ruff format": ("ruff", "-m ruff format --check ."),
    "codespell": ("codespell_lib", "-m codespell_lib ."),
    "import-linter": ("importlinter", LAYERS),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_source_is_clean(name):
    module, command = COMMANDS[name]
    if find_spec(module) is None:
        pytest.skip(f"{module} is not installed")
    option, _, arguments = command.partition(" ")
    arguments = [arguments] if option == "-c" else arguments.split()
    run_program(sys.executable, option, *arguments)
