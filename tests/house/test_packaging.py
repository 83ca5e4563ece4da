"""``drgs.plugins`` is importable from a checkout, editable and installed.

The build backend alone makes what is installed: offline, and without pip.
"""

import importlib.util
import sys
import zipfile

import pytest
from conftest import REPOSITORY, copy_checkout, run_program

PRINT_PLUGINS_PATH = (
    "import drgs, drgs.plugins, drgs.io, drgs.datasets; print(drgs.plugins.__file__)"
)


def site_packages(checkout, folder, hook):
    """A new ``folder`` with what pip would put into site-packages; hook: of the build backend."""
    if importlib.util.find_spec("hatchling") is None:
        pytest.skip("hatchling is not installed")
    program = f"from hatchling import build; build.{hook}({str(folder)!r})"
    run_program(sys.executable, "-c", program, cwd=checkout)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        file.extractall(folder)
    wheel.unlink()
    return folder


@pytest.fixture
def installed(tmp_path):
    """A folder that holds what an installation puts into site-packages."""
    checkout = copy_checkout(tmp_path / "checkout")
    return site_packages(checkout, tmp_path / "installed", "build_wheel")


def test_every_file_is_installed_and_the_plugins_are_found(run_python, tmp_path, installed):
    def files(folder):
        paths = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
        return {path.as_posix() for path in paths if "__pycache__" not in path.parts}

    expected = files(REPOSITORY / "drgs")
    expected |= {f"plugins/{name}" for name in files(REPOSITORY / "plugins")}
    assert {"results/page.html", "fit/training_curves.csv", "__init__.py"} <= expected
    assert files(installed / "drgs") == expected
    result = run_python(PRINT_PLUGINS_PATH, cwd=tmp_path, PYTHONPATH=str(installed))
    plugins = installed / "drgs" / "plugins" / "__init__.py"
    assert result.stdout.strip() == str(plugins), result.stderr


def test_checkout_finds_its_plugins(run_python, tmp_path, installed):
    """In its folder, from another, and if it shadows an installed package."""
    other_folder = {"cwd": tmp_path, "PYTHONPATH": str(REPOSITORY)}
    for options in ({}, other_folder, {"PYTHONPATH": str(installed)}):
        result = run_python(PRINT_PLUGINS_PATH, **options)
        assert result.stdout.strip() == str(REPOSITORY / "plugins" / "__init__.py"), result.stderr


@pytest.mark.slow
def test_an_editable_install_wins_over_a_clone_of_the_same_name(tmp_path):
    """In the clone's parent folder, where the folder ``drgs`` could be a namespace package."""
    checkout = copy_checkout(tmp_path / "drgs")
    site = site_packages(checkout, tmp_path / "site", "build_editable")
    # -S leaves out this environment's .pth files, such as that of an editable drgs.
    dependencies = [path for path in sys.path if path.endswith("site-packages")]
    program = (
        f"import site, sys; sys.path += {dependencies!r}; site.addsitedir({str(site)!r})\n"
        "import mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n"
        "import drgs; print(drgs.__file__); drgs.Gaussians\n"
        "import drgs.plugins; print(drgs.plugins.__file__)\n"
        "print(type(mi.load_dict({'type': 'splats'})).__name__)"
    )
    shown = run_program(sys.executable, "-S", "-c", program, cwd=tmp_path)
    package, plugins, integrator = shown.splitlines()
    assert package == str(checkout / "drgs" / "__init__.py")
    assert plugins == str(checkout / "plugins" / "__init__.py")
    assert integrator == "SplatsIntegrator"


def test_citation_has_the_version():
    import drgs

    assert f"\nversion: {drgs.__version__}\n" in (REPOSITORY / "CITATION.cff").read_text()


def test_finding_the_plugins_twice_installs_one_finder():
    from drgs._registration import SiblingPluginFinder, map_sibling_plugins

    map_sibling_plugins()
    assert sum(isinstance(finder, SiblingPluginFinder) for finder in sys.meta_path) <= 1
