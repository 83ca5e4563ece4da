"""Sphinx builds the pages, and finds the targets of the links of all pages, without a warning."""

import sys

import pytest
from conftest import REPOSITORY, run_program

pytestmark = pytest.mark.slow

# Pages outside of docs/ are read too: their links, and the links to them.
ALL_PAGES = {
    "include_patterns": "*.md,docs/**.md,docs/generated/*.rst,docs/**.ipynb,scenes/studies/*.md",
    "root_doc": "README",
    "suppress_warnings": "toc.not_included,myst.header,ref.python",
}


@pytest.mark.parametrize("folder, settings", [("docs", {}), (".", ALL_PAGES)])
def test_sphinx_builds_the_pages_without_a_warning(folder, settings, tmp_path):
    for module in ("sphinx", "myst_nb", "sphinx_design", "furo"):
        pytest.importorskip(module)
    command = ["-W", "--keep-going", "-b", "html", "-c", "docs", "-d", str(tmp_path / "trees")]
    command += [f"-D{name}={value}" for name, value in settings.items()]
    run_program(sys.executable, "-m", "sphinx", *command, folder, tmp_path / "html")
    for page in (REPOSITORY / "docs").rglob("*.md"):
        built = tmp_path / "html" / page.relative_to(REPOSITORY / folder)
        assert "_build" in page.parts or built.with_suffix(".html").exists(), page
