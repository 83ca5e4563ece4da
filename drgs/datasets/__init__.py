"""Datasets: posed photographs as read from folders, and viewpoints without photographs.

May import ``io``, ``config``, ``gaussians``, ``cameras`` and ``core``.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.config.extensions import READERS, section_of
from drgs.config.load import config_from
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.core.origin import WORLD, near_origin, shown_origin
from drgs.datasets.types import Dataset, Keeps, View, Viewpoint, all_of_them

if TYPE_CHECKING:
    from drgs.datasets.reader import DatasetReader

__all__ = ["Dataset", "View", "Viewpoint", "load_dataset"]

MARKERS = ("transforms_train.json", "transforms.json")
"""Files by which folders of the layouts NeRF-synthetic and nerfstudio are recognized."""

NO_SECTIONS: Mapping[str, Any] = MappingProxyType({})
"""No extension has a section."""


def reader_of(
    config: DataConfig, sections: Mapping[str, Any] = NO_SECTIONS
) -> tuple[str, DatasetReader]:
    """Return the name and the reader of the folder of a dataset: see :func:`reader_name`.

    sections: those of extensions, by name.
    """
    extension = READERS.get(reader_name(config, sections), "data.type")
    return extension.name, extension.value.from_config(section_of(extension, sections))


def load_dataset(
    source: str | Path | DataConfig,
    keeps: Keeps = all_of_them,
    sections: Mapping[str, Any] = NO_SECTIONS,
    **settings: object,
) -> Dataset:
    """All views of a dataset: photographs with their cameras, to train on and to measure on.

    source: the folder, in the layout of NeRF-synthetic, of nerfstudio / instant-ngp or of COLMAP,
    or of a reader of another package, or the section ``data`` of a configuration; keeps: of which
    views pictures are kept, by name; sections: of extensions, by name; settings: other values of
    the section ``data``, such as ``image_size=400`` (px) or ``background="black"``.

    Where the cameras are far from the world's origin, their positions are relative to the
    dataset's ``origin``, the middle of the training cameras.

    Raises :class:`UserError` naming the file, the key, what was expected and what was got; where
    the folder is missing, it says where to get the data.
    """
    if settings or not isinstance(source, DataConfig):
        given = source.model_dump() if isinstance(source, DataConfig) else {"path": source}
        source = config_from({"data": {**given, **settings}}, "load_dataset()").data
    return _near(reader_of(source, sections)[1].load(source, keeps))


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


def reader_name(config: DataConfig, sections: Mapping[str, Any] = NO_SECTIONS) -> str:
    """Return the name of the reader of a folder: ``data.type``, or the one that recognizes it.

    sections: those of extensions, by name.

    Raises :class:`UserError` for a folder that no reader recognizes, with what to do.
    """
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
    for extension in map(READERS.get, READERS.names()):
        if extension.value.from_config(section_of(extension, sections)).recognizes(
            config.path, names
        ):
            return extension.name
    from drgs.datasets.recognition import what_is_there

    raise UserError(f"{config.path}: {what_is_there(config.path, MARKERS)}")
