"""Inputs that processes read by themselves, compared with those of the first process.

A stale copy on one machine would mix two datasets, and another version of a library would make the
result depend on the number of processes. The process that differs raises :class:`UserError`.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import PIL

import drgs
from drgs.core.errors import UserError, listed
from drgs.core.private import llvm_vector_width, llvm_version
from drgs.datasets.fingerprint import Fingerprint, fingerprint_of
from drgs.datasets.types import Dataset, Viewpoint
from drgs.training.parallel.communicator import Communicator


def versions() -> dict[str, str]:
    """Versions and the vector width that the bytes of a result depend on, by name."""
    return {
        "drgs": drgs.__version__,
        "Mitsuba": mi.__version__,
        "Dr.Jit": dr.__version__,
        "numpy": np.__version__,
        "Pillow": PIL.__version__,
        "LLVM": ".".join(map(str, llvm_version())),
        "the vector width": str(llvm_vector_width()),
        "the variant": mi.variant(),
    }


def check_versions(first: Mapping[str, str]) -> None:
    """Raise ``UserError`` unless this process has the versions of the first one."""
    own = versions()
    for name, value in first.items():
        if own.get(name) != value:
            raise UserError(
                f"mpiexec: {name} must be the same everywhere, or the result would depend on the "
                f"number of processes; got {own.get(name)} on {platform.node()}, {value} for "
                "process 0"
            )


def send_fingerprint(comm: Communicator, dataset: Dataset) -> None:
    """Send other ranks what :func:`check_views` compares, from rank 0."""
    comm.broadcast_text(fingerprint_of(replace(dataset, test=())).to_bytes().decode())


def check_views(comm: Communicator, dataset: Dataset, own: Collection[str], path: Path) -> None:
    """Raise ``UserError`` unless training views are those that the first process has read.

    own: names of the views whose files this process reads; path: the dataset's, for the message.
    """
    here = fingerprint_of(replace(dataset, test=()), own.__contains__)
    first = Fingerprint.from_bytes(comm.broadcast_text("").encode())
    if found := first.other_files(dataset.train, here) or first.differences(here):
        raise UserError(
            f"{path}: not the same on {platform.node()} as for process 0: {listed(found)}; all "
            "processes must see the same files"
        )


def check_pictures(
    comm: Communicator, scene: mi.Scene, views: Sequence[Viewpoint], files: Mapping[str, object]
) -> None:
    """Raise ``UserError`` unless the scene and its views are those of the first process.

    files: for the message, the origin of ``cameras`` and ``background``, and of the ``model``.
    Called by all processes; returns when all have agreed.
    """
    own = {**versions(), **_digests(scene), "cameras": _digest_of_cameras(views)}
    first = json.loads(comm.broadcast_text(json.dumps(own)))
    check_versions({name: first[name] for name in versions()})
    if other := [name for name in {**first, **own} if first.get(name) != own.get(name)]:
        file = files.get(other[0].partition(".")[0]) or files["model"]
        raise UserError(
            f"{file}: not the same on {platform.node()} as for process 0: {listed(other)}; all "
            "processes must see the same files and options"
        )
    comm.all_gather(np.array(True))


def _digests(scene: mi.Scene) -> dict[str, str]:
    """Digests of the parameters of the integrator, and its settings, by name."""
    integrator = scene.integrator()
    parameters = {**mi.traverse(integrator), "smoothing": integrator.smoothing}
    found = {}
    for name, value in parameters.items():
        array = np.asarray(value)  # of what is no array, a reference
        found[name] = str(value) if array.dtype == object else _digest(array)
    return {**found, "settings": str(integrator)}


def _digest_of_cameras(views: Sequence[Viewpoint]) -> str:
    cameras = [
        [view.name, view.width, view.height, view.K.tolist(), view.camera_to_world.tolist()]
        + ([] if view.lens is None else [view.lens.kind, str(view.lens.coefficients())])
        + ([] if view.motion is None else [view.motion.close_to_world.tolist()])
        for view in views
    ]
    return _digest(json.dumps(cameras).encode())


def _digest(content: bytes | np.ndarray) -> str:
    return hashlib.sha256(content).hexdigest()
