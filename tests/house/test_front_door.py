"""Names of ``import drgs``; none stands for a module and for something in it."""

import ast

import pytest
from conftest import REPOSITORY

import drgs

PUBLIC = {"Gaussians", "examine", "load_dataset", "rasterization", "train"} | {
    "sensor_from_view",
    "view_from_sensor",
}

CALLABLE_PACKAGE = "examine"  # drgs.examine is the function, in every order of imports

LAZILY = """
import sys
import drgs
heavy = {{"drgs.gaussians", "drgs.datasets", "drgs.training", "drgs.gsplat_api", "plyfile"}}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
drgs.{name}
assert "{name}" in vars(drgs)
"""


def test_public_names_are_listed():
    assert set(drgs.__all__) == PUBLIC | {"EXAMPLE"}
    assert "EXAMPLE" in drgs.__doc__ and drgs.EXAMPLE.is_file()
    assert set(dir(drgs)) >= PUBLIC | {"__version__"}


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_a_public_name_is_documented(name):
    documentation = getattr(drgs, name).__doc__
    assert documentation.split("\n\n")[0].rstrip().endswith(".")
    assert name in drgs.__doc__


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Gaussians", "rasterization"])
def test_public_names_are_imported_lazily(run_python, name):
    result = run_python(LAZILY.format(name=name))
    assert result.returncode == 0, result.stderr


def test_type_checkers_see_the_same_names():
    package = REPOSITORY / "drgs"
    (block,) = (
        node
        for node in ast.parse((package / "__init__.py").read_text()).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    seen = {alias.name: imports.module for imports in block.body for alias in imports.names}
    assert seen == drgs._MODULES and seen.keys() == PUBLIC
    assert (package / "py.typed").is_file()


def test_unknown_name_is_refused():
    with pytest.raises(AttributeError, match="module 'drgs' has no attribute 'fitt'"):
        _ = drgs.fitt


FILES = sorted((REPOSITORY / "drgs").rglob("*.py"))


def names_around(file):
    """Modules and packages that lie beside ``file`` or hold it, itself included."""
    parts = file.relative_to(REPOSITORY).with_suffix("").parts
    beside = {path.stem for path in file.parent.iterdir() if path.suffix == ".py" or path.is_dir()}
    return {*parts, *beside} - {"__init__", "__main__", CALLABLE_PACKAGE}


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(REPOSITORY)))
def test_no_name_equals_its_module_or_package(file):
    """Public functions and classes."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    defined = {node.name for node in ast.parse(file.read_text()).body if isinstance(node, kinds)}
    assert not defined & names_around(file)


def test_public_names_differ_from_module_names():
    assert PUBLIC - {CALLABLE_PACKAGE} == PUBLIC - {
        path.stem for path in (REPOSITORY / "drgs").iterdir()
    }
