"""Datasets, start points, viewpoints, and pictures of Mitsuba scenes as a dataset.

May import ``io``, ``config``, ``gaussians``, ``cameras`` and ``core``.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from drgs.config.load import config_from
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.data import nerf_synthetic, nerfstudio
from drgs.data.initial import initial_gaussians
from drgs.data.types import Dataset, View, Viewpoint

__all__ = ["Dataset", "View", "Viewpoint", "initial_gaussians", "load_dataset"]


def _load_colmap(config: DataConfig) -> Dataset:
    from drgs.data import colmap

    return colmap.load(config)


_LOADERS: dict[str, Callable[[DataConfig], Dataset]] = {
    "nerf_synthetic": nerf_synthetic.load,
    "nerfstudio": nerfstudio.load,
    "colmap": _load_colmap,
}

_MARKERS = {
    "nerf_synthetic": "transforms_train.json",
    "nerfstudio": "transforms.json",
}


def load_dataset(source: str | Path | DataConfig, **settings: object) -> Dataset:
    """All views of a dataset: photographs with their cameras, to train on and to measure on.

    source: the folder, in the layout of NeRF-synthetic, of nerfstudio / instant-ngp or of COLMAP,
    or the section ``data`` of a configuration; settings: other values of that section, such as
    ``image_size=400`` (px) or ``background="black"``.

    Raises :class:`UserError` naming the file, the key, what was expected and what was got; where
    the folder is missing, it says where to get the data.
    """
    if settings or not isinstance(source, DataConfig):
        given = source.model_dump() if isinstance(source, DataConfig) else {"path": source}
        source = config_from({"data": {**given, **settings}}, "load_dataset()").data
    return _LOADERS[_layout(source)](source)


def _layout(config: DataConfig) -> str:
    try:
        names = os.listdir(config.path)
    except FileNotFoundError:
        source = f", or get it from {config.source}" if config.source else ""
        raise UserError(
            f"data.path: there is no folder {config.path}; say where it is (--data DIR){source}"
        ) from None
    except NotADirectoryError:
        raise UserError(
            f"data.path: {config.path} is a file; give the folder of the dataset, such as "
            f"{config.path.parent}"
        ) from None
    except OSError as error:
        raise UserError(
            f"data.path: cannot open the folder {config.path}: {error.strerror}"
        ) from None
    if config.type != "auto":
        return config.type
    for layout, marker in _MARKERS.items():
        if marker in names:
            return layout
    from drgs.data.recognition import has_colmap_model, what_is_there

    if has_colmap_model(config.path):
        return "colmap"
    raise UserError(f"{config.path}: {what_is_there(config.path, tuple(_MARKERS.values()))}")
