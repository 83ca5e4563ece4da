"""Sphinx builds the pages without a warning."""

import subprocess
import sys

import pytest
from conftest import REPOSITORY

pytestmark = pytest.mark.slow


def test_sphinx_builds_the_pages_without_a_warning(tmp_path):
    for module in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(module)
    command = ["-W", "--keep-going", "-b", "html", "-d", str(tmp_path / "trees")]
    result = subprocess.run(
        [sys.executable, "-m", "sphinx", *command, "docs", str(tmp_path / "html")],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    for page in (REPOSITORY / "docs").glob("*.md"):
        assert (tmp_path / "html" / f"{page.stem}.html").exists(), page
