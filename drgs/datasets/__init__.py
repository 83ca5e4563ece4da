"""Datasets: photographs with cameras, read from folders, and cameras of files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from pydantic import BaseModel

from drgs.config.load import config_from
from drgs.config.schema import DataConfig
from drgs.core.errors import check_type
from drgs.core.origin import WORLD, choose_origin, format_origin
from drgs.datasets.types import Dataset, View, ViewFilter, Viewpoint, all_views

__all__ = ["Dataset", "View", "Viewpoint", "load_dataset"]


def load_dataset(
    source: str | Path | DataConfig,
    keeps: ViewFilter = all_views,
    sections: Mapping[str, BaseModel] = MappingProxyType({}),
    **settings: object,
) -> Dataset:
    """Return all views of a dataset: photographs with their cameras, to train and to measure on.

    source: the folder (NeRF-synthetic, nerfstudio / instant-ngp, COLMAP, or the layout of an
    extension), or the section ``data`` of a configuration; keeps: accepts, by name, the views whose
    images are kept; sections: of extensions, by name; settings: other values of the section
    ``data``, such as ``image_size=400`` (px) or ``background="black"``.

    Where the cameras are far from the world's origin, their positions are relative to the
    dataset's ``origin``, the middle of the training cameras.

    Raises :class:`UserError` naming the file, the key, what was expected and what was got.
    """
    check_type("load_dataset()", "source", source, str, Path, DataConfig)
    if settings or not isinstance(source, DataConfig):
        given = source.model_dump() if isinstance(source, DataConfig) else {"path": source}
        source = config_from({"data": {**given, **settings}}, "load_dataset()").data
    from drgs.datasets.folders import find_reader  # a list of commands needs no readers

    dataset = find_reader(source, sections)[1].load(source, keeps)
    if not dataset.train:
        return dataset
    middle = np.mean([view.center for view in dataset.train], axis=0)
    origin = choose_origin(middle, dataset.extent)
    if origin != WORLD:
        note = f"; far from the origin: coordinates are relative to {format_origin(origin)}"
        dataset = replace(dataset.relative_to(origin), description=dataset.description + note)
    return dataset
