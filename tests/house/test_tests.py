"""How tests are laid out: by package, in files of a readable size that know no other test file."""

import re
from collections import Counter

from conftest import REPOSITORY

TESTS = REPOSITORY / "tests"
FILES = sorted(TESTS.rglob("*.py"))
NAMES = Counter(path.stem for path in FILES if path.stem.startswith("test_"))

MAX_FILE_LINES = 600

OTHER_FOLDERS = {"support", "references", "commands", "scenes", "house", "examples"}
"""Beside those that are named like a package: ``support`` is what tests share, ``references`` are
stored images, ``commands`` run the programs, ``scenes`` are the shipped ones, ``examples`` tests
the programs there, ``house`` is about the repository itself."""


def test_no_file_imports_a_test_file():
    """Nor do programs in strings."""
    for path in FILES:
        imports = re.findall(r"^\s*(?:from|import) (.*)", path.read_text(), re.MULTILINE)
        assert not NAMES.keys() & set(re.findall(r"\w+", " ".join(imports))), path


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
