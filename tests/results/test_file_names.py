"""The names of what a fit writes are said in one module."""

import ast

import pytest
from conftest import REPOSITORY

from drgs.results import files

NAMES = {files.CONFIG, *files.RESULTS}

ALLOWED_NAMES = {
    "drgs/fit.py": {files.TENSORBOARD},
}
"""Modules below ``results`` recognise a fit's folder by names that they write out themselves; the
extra that a command asks for has the name of a folder."""

MODULES = [
    path
    for path in sorted((REPOSITORY / "drgs").rglob("*.py"))
    if path != REPOSITORY / "drgs" / "results" / "files.py"
]


def strings(source):
    """The text of all constants; docstrings and messages are longer than a name."""
    nodes = ast.walk(ast.parse(source))
    return {node.value for node in nodes if isinstance(node, ast.Constant)} - {None}


def test_file_names_are_unique():
    assert len(NAMES) == len(files.RESULTS) + 1


@pytest.mark.slow
@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_file_names_are_written_in_one_module_only(path):
    known = ALLOWED_NAMES.get(path.relative_to(REPOSITORY).as_posix(), set())
    assert NAMES & strings(path.read_text()) == known


def test_literal_file_name_is_found():
    assert strings('"""A docstring."""\npath = out / "metrics.json"') & NAMES == {"metrics.json"}
