"""The names of what a fit writes are said in one module."""

import ast

import pytest
from conftest import REPOSITORY

from drgs.results import files

NAMES = {files.CONFIG, *files.RESULTS}

ALLOWED_NAMES = {"fit.py": {files.TENSORBOARD}, "results/files.py": NAMES}
"""Modules below ``results`` recognise a fit's folder by names that they write out themselves; the
extra that a command asks for has the name of a folder."""


@pytest.mark.slow
def test_file_names_are_written_in_one_module_only():
    assert len(NAMES) == len(files.RESULTS) + 1
    for path in sorted((REPOSITORY / "drgs").rglob("*.py")):
        # Docstrings and messages are longer than a name.
        nodes = ast.walk(ast.parse(path.read_text()))
        strings = {node.value for node in nodes if isinstance(node, ast.Constant)} - {None}
        module = path.relative_to(REPOSITORY / "drgs").as_posix()
        assert NAMES & strings == ALLOWED_NAMES.get(module, set()), module
