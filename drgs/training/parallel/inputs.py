"""Inputs of a fit by several processes: configuration and Gaussians of rank 0, photographs.

Rank 0 reads the whole dataset. Each other rank reads the photographs of the views that it renders
by itself, and of other views the cameras and sizes, from files' headers.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from drgs.config.schema import FitConfig
from drgs.datasets import load_dataset
from drgs.datasets.images import without_images
from drgs.datasets.types import Dataset
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.training.parallel.agreement import (
    check_versions,
    check_views,
    send_fingerprint,
    versions,
)
from drgs.training.parallel.communicator import Communicator
from drgs.training.parallel.population import own_views


def share_inputs(
    comm: Communicator, config: FitConfig | None, dataset: Dataset | None
) -> tuple[FitConfig, Dataset]:
    """Return the configuration of rank 0, and the dataset with the photographs of this rank.

    config, dataset: of rank 0, which gives the configuration completed, and all photographs; None
    on other ranks.

    Raises ``UserError`` where a rank reads other photographs than rank 0, or has other versions.
    """
    if comm.size == 1:
        return config, dataset
    if comm.is_root:
        names = [view.name for view in dataset.train]
        comm.broadcast_text(json.dumps([config.model_dump_json(), names, versions()]))
        send_fingerprint(comm, dataset)  # made while the others read
        return config, _with_own_photographs(dataset, config.optimizer.views_per_step, comm)
    text, names, versions_of_root = json.loads(comm.broadcast_text(""))
    check_versions(versions_of_root)
    config = FitConfig.model_validate_json(text)
    return config, _read_own_photographs(config, names, comm)


def _with_own_photographs(dataset: Dataset, views_per_step: int, comm: Communicator) -> Dataset:
    """Return the dataset without the photographs of views that other ranks render."""
    own = own_views(len(dataset.train), views_per_step, comm.rank, comm.size)
    train = (v if i in own else without_images(v) for i, v in enumerate(dataset.train))
    return replace(dataset, train=tuple(train))


def _read_own_photographs(config: FitConfig, names: list[str], comm: Communicator) -> Dataset:
    """Return the dataset with the training views of these names, and no views to measure on."""
    own = own_views(len(names), config.optimizer.views_per_step, comm.rank, comm.size)
    rendered = {names[index] for index in own}
    dataset = load_dataset(config.data_for_training, rendered.__contains__, config.extensions)
    chosen = set(names)
    dataset = replace(dataset, train=tuple(view for view in dataset.train if view.name in chosen))
    check_views(comm, dataset, rendered, config.data.path)
    by_name = {view.name: view for view in dataset.train}
    return replace(dataset, train=tuple(by_name[name] for name in names), test=())


def share_gaussians(comm: Communicator, gaussians: Gaussians | None) -> Gaussians:
    """Return the Gaussians of rank 0 (numpy arrays); other ranks may give None."""
    if comm.size == 1:
        return gaussians
    given = [getattr(gaussians, name) for name in PARAMETER_NAMES] if comm.is_root else []
    described = json.loads(comm.broadcast_text(json.dumps([[a.dtype.str, a.shape] for a in given])))
    arrays = given or [np.empty(shape, dtype) for dtype, shape in described]
    arrays = [comm.broadcast(a).reshape(a.shape) for a in arrays]
    return Gaussians(**dict(zip(PARAMETER_NAMES, arrays, strict=True)))
