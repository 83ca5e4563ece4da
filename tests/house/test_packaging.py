"""``drgs.plugins`` is importable from a checkout, editable and installed.

Setuptools alone builds the installed tree here: offline, and without the package "wheel".
"""

import importlib.util
import shutil
import subprocess
import sys

import pytest
from conftest import REPOSITORY

SHOW = "import drgs, drgs.plugins, drgs.io, drgs.data; print(drgs.plugins.__file__)"


def copy_checkout(folder):
    for name in ("drgs", "plugins"):
        shutil.copytree(
            REPOSITORY / name, folder / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, folder / name)
    return folder


@pytest.fixture
def installed(tmp_path):
    """A folder that holds what an installation puts into site-packages."""
    # Not imported here: setuptools brings its own distutils, which is to be the first.
    if importlib.util.find_spec("setuptools") is None:
        pytest.skip("setuptools is not installed")
    checkout = tmp_path / "checkout"
    checkout.mkdir()
    copy_checkout(checkout)
    build = ["-q", "build", "--build-lib", str(tmp_path / "installed")]
    result = subprocess.run(
        [sys.executable, "-c", "from setuptools import setup; setup()", *build],
        cwd=checkout,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    return tmp_path / "installed"


def test_plugins_are_found_in_a_plain_checkout(run_python):
    result = run_python(SHOW)
    assert result.stdout.strip() == str(REPOSITORY / "plugins" / "__init__.py"), result.stderr


def test_plugins_are_found_from_another_folder(run_python, tmp_path):
    result = run_python(SHOW, cwd=tmp_path, PYTHONPATH=str(REPOSITORY))
    assert result.stdout.strip() == str(REPOSITORY / "plugins" / "__init__.py"), result.stderr


def test_an_installed_package_holds_its_plugins(run_python, tmp_path, installed):
    result = run_python(SHOW, cwd=tmp_path, PYTHONPATH=str(installed))
    expected = installed / "drgs" / "plugins" / "__init__.py"
    assert result.stdout.strip() == str(expected), result.stderr


def test_a_checkout_that_shadows_an_installed_package_finds_its_own_plugins(run_python, installed):
    result = run_python(SHOW, PYTHONPATH=str(installed))
    assert result.stdout.strip() == str(REPOSITORY / "plugins" / "__init__.py"), result.stderr


def test_the_packages_listed_are_all_there_are(installed):
    def packages(folder):
        return {
            p.parent.relative_to(folder).as_posix().replace("plugins", "drgs/plugins")
            for top in ("drgs", "plugins")
            for p in (folder / top).rglob("__init__.py")
        }

    built = {p.parent.relative_to(installed).as_posix() for p in installed.rglob("__init__.py")}
    assert built == packages(REPOSITORY)


def test_the_version_is_that_of_the_project_file():
    import drgs

    assert f'\nversion = "{drgs.__version__}"\n' in (REPOSITORY / "pyproject.toml").read_text()


def test_finding_the_plugins_twice_installs_one_finder():
    from drgs._registration import SiblingPluginFinder, map_sibling_plugins

    map_sibling_plugins()
    assert sum(isinstance(finder, SiblingPluginFinder) for finder in sys.meta_path) <= 1
