"""Registration of the plugins for every Mitsuba variant, as its plugin registry belongs to one.

Mitsuba 3.10 also finds :mod:`drgs.plugins` by its entry point; the first of both registers them.
"""

from __future__ import annotations

import importlib.machinery
import importlib.util
import sys
from pathlib import Path

BACKENDS = ("scalar_", "llvm_", "cuda_", "metal_")  # prefixes of Mitsuba's variants


def register_plugins() -> None:
    """Register for the active variant, if Mitsuba is imported, and for each that is set later."""
    if "mitsuba" in sys.modules:
        import mitsuba as mi

        _follow_variants()
        _on_variant(None, mi.variant())
    if not any(isinstance(finder, _VariantWatch) for finder in sys.meta_path):
        sys.meta_path.insert(0, _VariantWatch())


class _VariantWatch:
    """An import hook that finds nothing, and follows the variants before one is loaded."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        package, _, variant = name.partition(".")
        if package == "mitsuba" and variant.startswith(BACKENDS):
            _follow_variants()


def _follow_variants() -> None:
    """Have Mitsuba call :func:`_on_variant` at each change."""
    from drgs.core.private import call_on_variant_change  # imports Dr.Jit

    call_on_variant_change(_on_variant)


def _on_variant(old: str | None, new: str | None) -> None:
    if new is None:
        return
    import drgs.plugins  # pyright: ignore[reportMissingImports]  # plugins/, where it is installed

    drgs.plugins.register(new)


class SiblingPluginFinder:
    """Finds ``drgs.plugins`` in ``folder`` (a path to a package), and nothing else."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def find_spec(
        self, name: str, path: object = None, target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return the package's spec, or None for every other module."""
        if name != "drgs.plugins":
            return None
        return importlib.util.spec_from_file_location(
            name, self.folder / "__init__.py", submodule_search_locations=[str(self.folder)]
        )


def map_sibling_plugins() -> None:
    """Install the finder where ``plugins/`` is beside this package and not inside it."""
    package = Path(__file__).resolve().parent
    sibling = package.parent / "plugins"
    if (package / "plugins").is_dir() or not (sibling / "__init__.py").is_file():
        return
    if not any(isinstance(finder, SiblingPluginFinder) for finder in sys.meta_path):
        # First, because an editable install of another checkout would answer as well.
        sys.meta_path.insert(0, SiblingPluginFinder(sibling))
