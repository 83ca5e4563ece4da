"""Examples of extensions, found as those of an installed package are."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType
from unittest import mock

from drgs.core import registry

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@contextmanager
def installed_examples(*names: str) -> Iterator[dict[str, ModuleType]]:
    """Within the block, entry points name these modules of ``examples``; yields the modules."""
    points = [EntryPoint(name, name, registry.ANY_KIND) for name in names]
    find = lambda group: [point for point in points if point.group == group]  # noqa: E731
    with (
        mock.patch.object(sys, "path", [str(EXAMPLES), *sys.path]),
        mock.patch.object(registry, "entry_points", find),
        mock.patch.dict(sys.modules),
        registry.temporary_registrations(),
    ):
        yield {name: importlib.import_module(name) for name in names}
