"""Inputs of the processes of a fit: sent by rank 0, or read by each rank.

Rank 0 reads the whole dataset of a fit. Each other rank reads the photographs of the views that it
renders, and the sizes of others from files' headers. What it reads, and its libraries' versions,
must be those of rank 0, or the result would depend on the number of processes.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from drgs.config.schema import FitConfig
from drgs.datasets import load_dataset
from drgs.datasets.images import without_images
from drgs.datasets.types import Dataset
from drgs.fit.fingerprint import Fingerprint, fingerprint_of
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.training.parallel.agreement import check_versions, differs_error, versions
from drgs.training.parallel.communicator import Communicator
from drgs.training.parallel.population import own_views


def share_inputs(
    comm: Communicator, config: FitConfig | None, dataset: Dataset | None
) -> tuple[FitConfig, Dataset]:
    """Return the configuration of rank 0, and the dataset with the photographs of this rank.

    config, dataset: without open values, and with all photographs; None on other ranks than 0.

    Raises ``UserError`` where a rank reads other photographs than rank 0, or has other versions.
    """
    if comm.is_root:
        assert config is not None and dataset is not None, "rank 0 has read them"
        if comm.size == 1:
            return config, dataset
        names = [view.name for view in dataset.train]
        comm.broadcast_text(json.dumps([config.model_dump_json(), names, versions()]))
        # Computed while other ranks read.
        comm.broadcast_text(fingerprint_of(replace(dataset, test=())).to_bytes().decode())
        own = own_views(len(names), config.optimizer.views_per_step, comm.rank, comm.size)
        train = (v if i in own else without_images(v) for i, v in enumerate(dataset.train))
        return config, replace(dataset, train=tuple(train))
    text, names, versions_of_root = json.loads(comm.broadcast_text(""))
    check_versions(versions_of_root)
    config = FitConfig.model_validate_json(text)
    own = own_views(len(names), config.optimizer.views_per_step, comm.rank, comm.size)
    rendered = {names[index] for index in own}
    dataset = load_dataset(config.data_for_training, rendered.__contains__, config.sections)
    chosen = set(names)
    dataset = replace(dataset, train=tuple(view for view in dataset.train if view.name in chosen))
    check_views(comm, dataset, rendered, config.data.path)
    by_name = {view.name: view for view in dataset.train}
    return config, replace(dataset, train=tuple(by_name[name] for name in names), test=())


def share_gaussians(comm: Communicator, gaussians: Gaussians | None) -> Gaussians:
    """Return the Gaussians of rank 0 (numpy arrays); other ranks may give None."""
    if comm.size == 1:
        assert gaussians is not None, "a process that is alone has made them"
        return gaussians
    given = [getattr(gaussians, name) for name in PARAMETER_NAMES] if comm.is_root else []
    described = json.loads(comm.broadcast_text(json.dumps([[a.dtype.str, a.shape] for a in given])))
    arrays = given or [np.empty(shape, dtype) for dtype, shape in described]
    arrays = [comm.broadcast(a).reshape(a.shape) for a in arrays]
    return Gaussians(**dict(zip(PARAMETER_NAMES, arrays, strict=True)))


def check_views(comm: Communicator, dataset: Dataset, own: Collection[str], path: Path) -> None:
    """Raise ``UserError`` unless training views are those that rank 0 has read.

    own: names of the views whose files this process reads; path: the dataset's, for the message.
    """
    here = fingerprint_of(replace(dataset, test=()), own.__contains__)
    first = Fingerprint.from_bytes(comm.broadcast_text("").encode())
    if found := first.other_files(dataset.train, here) or first.differences(here):
        raise differs_error(path, found)
