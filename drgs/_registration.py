"""Keeps the plugins registered for whichever Mitsuba variant is active.

The only global state of drgs: Mitsuba's plugin registry belongs to a variant.
"""

from __future__ import annotations

import importlib.machinery
import importlib.util
import sys
from pathlib import Path

from drgs.core.llvm import ensure_usable_llvm


def register_plugins() -> None:
    """Register for the active variant, if any, and for every one that becomes active later."""
    import mitsuba as mi

    from drgs.core.private import call_on_variant_change  # imports Dr.Jit

    call_on_variant_change(_on_variant)
    if mi.variant() is not None:
        _on_variant(None, mi.variant())


def _on_variant(old: str | None, new: str | None) -> None:
    del old
    if new is None:
        return
    if new.startswith("llvm_"):
        ensure_usable_llvm()
    import drgs.plugins

    drgs.plugins.register(new)


class SiblingPluginFinder:
    """Finds ``drgs.plugins`` in ``folder`` (a path to a package), and nothing else."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def find_spec(
        self, name: str, path: object = None, target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The import protocol: the package's spec, or None for every other module."""
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
