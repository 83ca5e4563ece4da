"""3D Gaussian splatting inside Mitsuba 3: a rasterizer in Dr.Jit with a hand-written adjoint.

>>> import drgs
>>> dataset = drgs.load_dataset("data/lego", image_size=400)
>>> fitted = drgs.train("scenes/lego.yml", dataset)
>>> fitted.gaussians.save("lego.ply")
>>> image, alpha, _ = drgs.rasterization(means, quats, scales, opacities, colors, ...)

:class:`Gaussians` is a scene, :func:`load_dataset` reads photographs with their cameras,
:func:`examine` tells which effects they call for, :func:`train` fits Gaussians to them, and
:func:`rasterization` renders differentiably. :func:`sensor_from_view` and :func:`view_from_sensor`
turn cameras into Mitsuba's, and back. :data:`EXAMPLE` is the file of a fitted crane truck.

Importing ``drgs`` selects the LLVM that Dr.Jit will load, registers the plugins ``splats``,
``splatpath``, ``calibrated`` and ``splats_minimal`` with each Mitsuba variant that is active or
set later, and changes nothing else. To do so it puts at most two finders first on
``sys.meta_path``: one finds no module, and notices when a variant of Mitsuba is imported; in a
checkout, the other finds ``drgs.plugins``. Public names are imported when they are first used.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING

from drgs import _registration
from drgs.core import llvm

if TYPE_CHECKING:
    from drgs.datasets import load_dataset
    from drgs.examine.examination import examine
    from drgs.fit.session import train
    from drgs.gaussians.parameters import Gaussians
    from drgs.gsplat_api import rasterization
    from drgs.integrator.scene import sensor_from_view, view_from_sensor

__version__ = "0.1.0"

EXAMPLE = Path(__file__).with_name("brick_crane.compressed.ply")
"""File of a fitted crane truck, for a first look: ``drgs.Gaussians.load(drgs.EXAMPLE)``."""

__all__ = ["EXAMPLE", "Gaussians", "examine", "load_dataset", "rasterization", "sensor_from_view"]
__all__ += ["train", "view_from_sensor"]

# Dr.Jit loads its libLLVM while it is being imported: this comes before anything that does.
llvm.select_newest_llvm()
llvm.check_llvm_variants()
_registration.map_sibling_plugins()
_registration.register_plugins()

_MODULES = {
    "Gaussians": "drgs.gaussians.parameters",
    "examine": "drgs.examine.examination",
    "load_dataset": "drgs.datasets",
    "rasterization": "drgs.gsplat_api",
    "sensor_from_view": "drgs.integrator.scene",
    "train": "drgs.fit.session",
    "view_from_sensor": "drgs.integrator.scene",
}


if not TYPE_CHECKING:  # else a type checker would accept every name

    def __getattr__(name: str) -> object:
        """Import a public name when it is first used."""
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(importlib.import_module(_MODULES[name]), name)
        return value


def __dir__() -> list[str]:
    """Return the names that exist, and those that are imported when they are used."""
    return sorted({*globals(), *__all__})
