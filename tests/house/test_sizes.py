"""Functions fit a screen, and take few parameters.

Lines are counted without the docstring; ``drgs.reference`` follows the papers' equations instead.
"""

import ast

import pytest
from conftest import REPOSITORY

MAX_FUNCTION_LINES = 60
MAX_PARAMETERS = 8

MORE_PARAMETERS = {"rasterization"}
"""It has the names and the order of gsplat's."""

FILES = [
    path
    for folder in ("drgs", "plugins")
    for path in sorted((REPOSITORY / folder).rglob("*.py"))
    if "reference" not in path.relative_to(REPOSITORY).parts
]


def sizes(source):
    """Return lines without the docstring and number of parameters, by function."""
    found = {}
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        lines = node.end_lineno - node.lineno + 1
        if ast.get_docstring(node) is not None:
            lines -= node.body[0].end_lineno - node.body[0].lineno + 1
        a = node.args
        parameters = [*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg]
        found[node.name] = lines, sum(p is not None for p in parameters)
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_functions_are_short_and_take_few_parameters(path):
    for name, (lines, parameters) in sizes(path.read_text()).items():
        assert lines <= MAX_FUNCTION_LINES, f"{name}: {lines} lines"
        if name not in MORE_PARAMETERS:
            assert parameters <= MAX_PARAMETERS, f"{name}: {parameters} parameters"


def test_lines_and_parameters_are_counted():
    source = 'def f(a, /, b, *c, d, **e):\n    """One\n\n    more."""\n    return (\n        a)\n'
    assert sizes(source) == {"f": (3, 5)}
