"""Datasets, start points, viewpoints, and pictures of Mitsuba scenes as a dataset.

May import ``io``, ``config``, ``gaussians``, ``cameras`` and ``core``.
"""

from __future__ import annotations

import os
from collections.abc import Callable

from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.data import nerf_synthetic, nerfstudio
from drgs.data.initial import initial_gaussians
from drgs.data.types import Dataset, View

__all__ = ["Dataset", "View", "initial_gaussians", "load_dataset"]

_LOADERS: dict[str, Callable[[DataConfig], Dataset]] = {
    "nerf_synthetic": nerf_synthetic.load,
    "nerfstudio": nerfstudio.load,
}

_MARKERS = {
    "nerf_synthetic": "transforms_train.json",
    "nerfstudio": "transforms.json",
}


def load_dataset(config: DataConfig) -> Dataset:
    """Read all views of the dataset that ``config`` names.

    Raises :class:`UserError` naming the file, the key, what was expected and what was got; where
    the folder is missing, it says where to get the data.
    """
    return _LOADERS[_layout(config)](config)


def _layout(config: DataConfig) -> str:
    try:
        names = os.listdir(config.path)
    except FileNotFoundError:
        remedy = f"; get it from {config.source}" if config.source else ""
        raise UserError(f"data.path: there is no folder {config.path}{remedy}") from None
    except OSError as error:
        raise UserError(
            f"data.path: cannot open the folder {config.path}: {error.strerror}"
        ) from None
    if config.type != "auto":
        return config.type
    for layout, marker in _MARKERS.items():
        if marker in names:
            return layout
    raise UserError(
        f"{config.path}: neither {' nor '.join(_MARKERS.values())} is there; data.path must be a "
        "folder in the layout of NeRF-synthetic or of nerfstudio / instant-ngp"
    )
