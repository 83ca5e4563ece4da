"""What is no Python but belongs to a package is installed with it."""

import pytest
from conftest import REPOSITORY

DATA = sorted(
    path
    for path in (REPOSITORY / "drgs").rglob("*")
    if path.is_file() and path.suffix in {".html", ".csv", ".json", ".txt"}
)


def test_there_are_such_files():
    assert {"page.html", "training_curves.csv"} <= {path.name for path in DATA}


@pytest.mark.parametrize("path", DATA, ids=lambda path: path.name)
def test_a_file_of_a_package_is_listed(path):
    package = ".".join(path.parent.relative_to(REPOSITORY).parts)
    lines = (REPOSITORY / "pyproject.toml").read_text().splitlines()
    (line,) = [line for line in lines if line.startswith(f'"{package}" = [')]
    assert f'"{path.name}"' in line
