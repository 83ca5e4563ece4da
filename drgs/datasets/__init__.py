"""Datasets: posed photographs as read from folders, and viewpoints without photographs.

May import ``io``, ``config``, ``gaussians``, ``cameras`` and ``core``.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Protocol

import numpy as np

from drgs.config.load import config_from
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.core.origin import WORLD, near_origin, shown_origin
from drgs.datasets.types import Dataset, Keeps, View, Viewpoint, all_of_them

__all__ = ["Dataset", "View", "Viewpoint", "load_dataset"]


class Layout(Protocol):
    """What reads folders of a kind."""

    def load(self, config: DataConfig, keeps: Keeps = all_of_them) -> Dataset:
        """All views, some of them perhaps without their pictures."""

    def picture_files(self, config: DataConfig) -> Sequence[Path]:
        """The files of those to train on, or of all."""


LAYOUTS = {"nerf_synthetic": "transforms_train.json", "nerfstudio": "transforms.json", "colmap": ""}
"""By name, which is that of a module: the file that a folder is recognised by."""


def layout_of(config: DataConfig) -> Layout:
    """What reads the folder of the dataset, as :func:`layout_name` says."""
    return import_module(f"drgs.datasets.{layout_name(config)}")


def load_dataset(
    source: str | Path | DataConfig, keeps: Keeps = all_of_them, **settings: object
) -> Dataset:
    """All views of a dataset: photographs with their cameras, to train on and to measure on.

    source: the folder, in the layout of NeRF-synthetic, of nerfstudio / instant-ngp or of COLMAP,
    or the section ``data`` of a configuration; keeps: of which views pictures are kept, by name;
    settings: other values of that section, such as
    ``image_size=400`` (px) or ``background="black"``.

    Where the cameras are far from the world's origin, their positions are relative to the
    dataset's ``origin``, the middle of the training cameras.

    Raises :class:`UserError` naming the file, the key, what was expected and what was got; where
    the folder is missing, it says where to get the data.
    """
    if settings or not isinstance(source, DataConfig):
        given = source.model_dump() if isinstance(source, DataConfig) else {"path": source}
        source = config_from({"data": {**given, **settings}}, "load_dataset()").data
    return _near(layout_of(source).load(source, keeps))


def _near(dataset: Dataset) -> Dataset:
    """The dataset about the middle of its cameras, where that is far from the world's origin."""
    if not dataset.train:
        return dataset
    middle = np.mean([view.center for view in dataset.train], axis=0)
    origin = near_origin(middle, dataset.extent)
    if origin == WORLD:
        return dataset
    note = f"; far from the origin: coordinates are relative to {shown_origin(origin)}"
    return replace(dataset.relative_to(origin), description=dataset.description + note)


def layout_name(config: DataConfig) -> str:
    """Of :data:`LAYOUTS`. Raises :class:`UserError` for a folder that is none, with what to do."""
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
    markers = [marker for marker in LAYOUTS.values() if marker]
    for layout, marker in LAYOUTS.items():
        if marker in names:
            return layout
    from drgs.datasets.recognition import has_colmap_model, what_is_there

    if has_colmap_model(config.path):
        return "colmap"
    raise UserError(f"{config.path}: {what_is_there(config.path, markers)}")
