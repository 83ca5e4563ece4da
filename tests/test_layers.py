"""Imports only point down the list of layers.

Exceptions: ``drgs/__init__.py`` registers the plugins, and the trainer reaches the integrator
through ``mi.load_dict``, which is no import.
"""

import ast

import pytest
from conftest import REPOSITORY

LAYERS = {
    0: [
        "_plugin_path",
        "arrays",
        "checks",
        "config",
        "constants",
        "cutoffs",
        "files",
        "llvm",
        "reference",
        "reference_effects",
        "reference_rays",
    ],
    1: ["camera", "data", "gaussians", "io", "lenses", "pictures", "viewpoints"],
    2: [
        "defocus",
        "extra_features",
        "image_model",
        "lanes",
        "occlusion",
        "perspective",
        "pixel_order",
        "projection",
        "rasterize",
        "ray_colors",
        "samples",
        "sh",
        "sh_rotation",
        "shutter",
        "similarity",
        "smoothing",
        "tiles",
        "unscented",
    ],
    3: ["choices", "rendering"],
    4: [
        "backdrop",
        "batch",
        "camera_refinement",
        "checkpoint",
        "color_correction",
        "densify",
        "effects",
        "exposure",
        "guards",
        "losses",
        "metrics",
        "nesting",
        "optimizer",
        "output",
        "pixels",
        "plan",
        "properties",
        "sampling",
        "scene",
        "schedule",
        "shot",
        "shapes",
        "supervision",
        "surfaces",
        "trainer",
        "training_effects",
        "training_smoothing",
        "view_parameters",
    ],
    5: [
        "bench",
        "capture",
        "execution",
        "fit",
        "interrupts",
        "plugins",
        "progress",
        "registration",
        "render",
        "report",
    ],
}

LAYER_OF = {name: layer for layer, names in LAYERS.items() for name in names}


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


def layer_of(module):
    """Layer of ``drgs.a.b``: that of ``a``. ``drgs`` itself registers plugins: the top one."""
    parts = module.split(".")
    return LAYER_OF[parts[1]] if len(parts) > 1 else max(LAYERS)


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
            names = {f"{base}.{alias.name}" for alias in node.names} & set(MODULES)
            found |= names or {base}
    return {name for name in found if name.split(".")[0] == "drgs"}


@pytest.mark.parametrize("module", [m for m in MODULES if m != "drgs"])
def test_every_module_has_a_layer(module):
    assert module.split(".")[1] in LAYER_OF, f"add {module} to a layer in {__file__}"


@pytest.mark.parametrize("module", [m for m in MODULES if m != "drgs"])
def test_imports_do_not_point_up(module):
    for imported in imports_of(module, MODULES[module].read_text()):
        assert layer_of(imported) <= layer_of(module), f"{module} imports {imported}"


def test_the_reference_imports_nothing_of_ours():
    if "drgs.reference" in MODULES:
        assert not imports_of("drgs.reference", MODULES["drgs.reference"].read_text())


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import drgs.config", {"drgs.config"}),
        ("from drgs import config, __version__", {"drgs.config"}),
        ("from drgs.config import FitConfig", {"drgs.config"}),
        ("from . import ply", {"drgs.io.ply"}),
        ("from .ply import read_ply", {"drgs.io.ply"}),
        ("from .. import llvm", {"drgs.llvm"}),
        ("def f():\n    from drgs.io.ply import read_ply", {"drgs.io.ply"}),
        ("import drgs", {"drgs"}),
        ("import numpy", set()),
    ],
)
def test_imports_are_recognised(source, expected):
    assert imports_of("drgs.io", source) == expected
