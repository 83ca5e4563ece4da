"""Imports only point down the floors of the house, and nowhere in a circle.

A module belongs to the package that it lies in; a package belongs to a floor. What a package may
import, its own modules apart, is listed here; local imports and those for type checkers count.
"""

import ast

import pytest
from conftest import REPOSITORY

GROUND = {"core"}
METHOD = {"gaussians", "cameras", *GROUND}
LOADERS = {"initialization", "datasets", "io", "config", *METHOD}
INTEGRATOR = {"accuracy", "effects", "light", "splatting", *LOADERS}
TRAINING = {"results", "integrator", "cli", *INTEGRATOR}

MAY_IMPORT = {
    "core": set(),
    "reference": set(),
    "config": GROUND,
    "gaussians": {"io", *GROUND},
    "cameras": GROUND,
    "cli": GROUND,
    "splatting": {"config", *METHOD},
    "io": GROUND,
    "accuracy": {"splatting", "config", *METHOD},
    "effects": {"splatting", "config", *METHOD},
    "light": {"splatting", "config", *METHOD},
    "datasets": {"io", "config", *METHOD},
    "initialization": LOADERS,
    "integrator": INTEGRATOR,
    "results": {"integrator", *LOADERS},
    "training": TRAINING,
    "plugins": {"integrator", *INTEGRATOR},
    "_registration": {"plugins", *GROUND},
    # drgs/__init__.py; its public names are imported when they are used, and by type checkers.
    "": {"_registration", "core", "datasets", "gaussians", "gsplat_api", "training"},
    "gsplat_api": {"accuracy", "effects", "splatting", "config", *METHOD},
    "viewer": {"training", *TRAINING},
    "commands": {"viewer", "training", "cli", "plugins", *TRAINING},
    "bench": {
        "commands",
        "gsplat_api",
        "training",
        "cli",
        "reference",
        "",
        *TRAINING,
    },
}
"""Packages that a package may import. ``drgs`` itself may be imported for its version."""

COMMANDS = {"__main__", "fit", "poses", "render", "export", "view", "capture"}


def module_name(path):
    parts = list(path.relative_to(REPOSITORY).with_suffix("").parts)
    if parts[0] == "plugins":
        parts = ["drgs", *parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {
    module_name(path): path
    for folder in ("drgs", "plugins")
    for path in sorted((REPOSITORY / folder).rglob("*.py"))
}


def package_of(module):
    """The package of ``drgs.a.b``: ``a``."""
    parts = module.split(".")[1:]
    if not parts:
        return ""
    return "commands" if parts[0] in COMMANDS else parts[0]


def imports_of(module, source):
    """Modules of drgs that ``source`` imports, anywhere in the file."""
    package = module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                anchor = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*anchor, base]).rstrip(".")
            # "from drgs import x" imports module x, or a name that drgs/__init__.py defines.
            modules = {f"{base}.{alias.name}" for alias in node.names} & set(MODULES)
            found |= modules
            if len(modules) < len(node.names):
                found.add(base)
    return {name for name in found if name.split(".")[0] == "drgs"}


IMPORTS = {
    name: imports_of(name, path.read_text()) & set(MODULES) for name, path in MODULES.items()
}


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_down(module):
    package = package_of(module)
    assert package in MAY_IMPORT, f"give {module} a floor in {__file__}"
    for imported in IMPORTS[module] - {"drgs"}:
        other = package_of(imported)
        allowed = other == package or other in MAY_IMPORT[package]
        assert allowed, f"{module} imports {imported}"


def find_cycle(imports):
    """A circle of modules each of which imports the next one; None: there is none."""
    finished, trail = set(), []

    def visit(module):
        if module in trail:
            return trail[trail.index(module) :]
        if module in finished:
            return None
        trail.append(module)
        for imported in sorted(imports[module] - {module}):
            if circle := visit(imported):
                return circle
        trail.pop()
        finished.add(module)
        return None

    return next((circle for circle in map(visit, imports) if circle), None)


def test_training_effects_do_not_import_the_trainer():
    effects = [name for name in MODULES if name.startswith("drgs.training.effects.")]
    assert effects
    for module in effects:
        assert "drgs.training.trainer" not in IMPORTS[module], module


def test_no_import_cycles_among_modules():
    assert find_cycle({name: found - {"drgs"} for name, found in IMPORTS.items()}) is None


def test_no_import_cycles_among_packages():
    packages = {name: set() for name in MAY_IMPORT}
    for module, found in IMPORTS.items():
        packages[package_of(module)] |= {package_of(name) for name in found - {"drgs"}}
    assert find_cycle(packages) is None


def test_import_cycle_is_found():
    assert find_cycle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]
    assert find_cycle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) is None


@pytest.mark.parametrize(
    "module", [name for name in MODULES if MODULES[name].name == "__init__.py" and name != "drgs"]
)
def test_package_docstrings_describe_contents_and_allowed_imports(module):
    documentation = ast.get_docstring(ast.parse(MODULES[module].read_text()))
    first, _, rest = documentation.partition("\n\n")
    assert first.endswith("."), "the first line says what lives there"
    assert "mport" in rest.partition("\n\n")[0], "the next ones say what it may import"


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import drgs.config", {"drgs.config"}),
        ("from drgs import config, __version__", {"drgs", "drgs.config"}),
        ("from drgs.config.schema import FitConfig", {"drgs.config.schema"}),
        ("from . import ply", {"drgs.io.ply"}),
        ("from .ply import read_gaussians", {"drgs.io.ply"}),
        ("from ..core import llvm", {"drgs.core.llvm"}),
        ("def f():\n    from drgs.io.ply import read_gaussians", {"drgs.io.ply"}),
        ("import drgs", {"drgs"}),
        ("import numpy", set()),
    ],
)
def test_imports_are_recognised(source, expected):
    assert imports_of("drgs.io", source) == expected
