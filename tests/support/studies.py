"""Studies, which are scripts in a checkout, as modules."""

from importlib import import_module
from types import ModuleType

import pytest
from conftest import REPOSITORY


def load_study(name: str) -> ModuleType:
    """Import a script that may import its neighbours."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(REPOSITORY / "scenes" / "studies")
        return import_module(name)


reference_rays = load_study("reference_rays")
"""The float64 reference along rays, which studies and tests share."""
