"""How tests are laid out: by package, in files of a readable size that know no other test file."""

import ast
from collections import Counter
from pathlib import Path

import pytest
from conftest import REPOSITORY

TESTS = REPOSITORY / "tests"
FILES = sorted(TESTS.rglob("*.py"))
NAMES = Counter(path.stem for path in FILES if path.stem.startswith("test_"))

MAX_FILE_LINES = 600

OTHER_FOLDERS = {"support", "references", "commands", "scenes", "house", "examples"}
"""Beside those that are named like a package: ``support`` is what tests share, ``references`` are
stored images, ``commands`` run the programs, ``scenes`` are the shipped ones, ``examples`` are
extensions that the documents show, ``house`` is about
the repository itself."""


def imported_modules(path: Path) -> set[str]:
    """Return modules of all import statements, also in functions and in programs that a test
    runs."""
    tree = ast.parse(path.read_text())
    sources = [tree]
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            lines = [line.strip() for line in node.value.splitlines()]
            statements = [line for line in lines if line.startswith(("import ", "from "))]
            for statement in statements:
                try:
                    sources.append(ast.parse(statement))
                except SyntaxError:  # prose
                    continue
    modules = set()
    for source in sources:
        for node in ast.walk(source):
            if isinstance(node, ast.Import):
                modules |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                modules |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return modules


def last_name(module: str) -> str:
    return module.rpartition(".")[2]


@pytest.mark.slow
def test_no_file_imports_a_test_file():
    imported = {(path.name, m) for path in FILES for m in imported_modules(path)}
    assert len(imported) > 1000
    assert not [pair for pair in imported if last_name(pair[1]) in NAMES]


def test_no_file_is_too_long():
    lines = {str(path): len(path.read_text().splitlines()) for path in FILES}
    assert not {path: count for path, count in lines.items() if count > MAX_FILE_LINES}


def test_names_are_unique():
    assert not [name for name, count in NAMES.items() if count > 1]


def test_folders_mirror_the_packages():
    packages = {path.parent.name for path in (REPOSITORY / "drgs").glob("*/__init__.py")}
    folders = {path.name for path in TESTS.iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert folders <= packages | OTHER_FOLDERS
    names = {path.name for path in TESTS.glob("test_*.py")}
    assert names == {"test_gradients.py", "test_laws.py", "test_mutants.py"}
