"""Makes the sibling folder ``plugins/`` importable as ``drgs.plugins`` in a plain checkout.

Layer 0. An installed package has ``drgs/plugins``, and setuptools maps it for an editable one.
In a checkout ``plugins/`` lies beside ``drgs/``; when Python runs in the checkout's root,
``./drgs`` even shadows an installed package, and ``drgs.plugins`` would not be found (or found
in another checkout).
"""

from __future__ import annotations

import importlib.machinery
import importlib.util
import sys
from pathlib import Path


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
