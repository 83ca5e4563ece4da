"""Agreement of processes: what they read, and their libraries' versions, must be those of rank 0.

Otherwise a result would depend on the number of processes.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
import PIL

import drgs
from drgs.cameras.viewpoints import Viewpoint
from drgs.core.errors import UserError, format_names
from drgs.core.private import llvm_vector_width, llvm_version
from drgs.integrator.state import SplatsPlugin
from drgs.training.parallel.communicator import Communicator


def versions() -> dict[str, str]:
    """Return versions and the vector width that the bytes of a result depend on, by name."""
    return {
        "drgs": drgs.__version__,
        "Mitsuba": str(mi.__version__),
        "Dr.Jit": dr.__version__,  # pyright: ignore[reportAttributeAccessIssue]  # not in the stub
        "numpy": np.__version__,
        "Pillow": PIL.__version__,
        "LLVM": ".".join(map(str, llvm_version())),
        "the vector width": str(llvm_vector_width()),
        "the variant": mi.variant() or "",
    }


def check_versions(first: Mapping[str, str]) -> None:
    """Raise ``UserError`` unless this process has the versions of rank 0."""
    own = versions()
    for name, value in first.items():
        if own.get(name) != value:
            raise UserError(
                f"mpiexec: {name} must be the same everywhere, or the result would depend on the "
                f"number of processes; got {own.get(name)} on {platform.node()}, {value} for "
                "process 0"
            )


def check_scene(
    comm: Communicator, scene: mi.Scene, views: Sequence[Viewpoint], files: Mapping[str, object]
) -> None:
    """Raise ``UserError`` unless the scene and its views equal those of rank 0.

    files: for the message, the origin of ``cameras`` and ``background``, and of the ``model``.
    Called by all processes; returns when all have agreed.
    """
    integrator = cast(SplatsPlugin, scene.integrator())
    own = versions()
    parameters = {**mi.traverse(integrator), "smoothing": integrator.smoothing}
    for name, value in parameters.items():
        array = np.asarray(value)  # an object, where it is no array
        own[name] = str(value) if array.dtype == object else _digest(array.tobytes())
    cameras = [
        [view.name, view.width, view.height, view.K.tolist(), view.camera_to_world.tolist()]
        + ([] if view.lens is None else [view.lens.kind, str(view.lens.coefficients())])
        + ([] if view.motion is None else [view.motion.close_to_world.tolist()])
        for view in views
    ]
    own |= {"settings": str(integrator), "cameras": _digest(json.dumps(cameras).encode())}
    first = json.loads(comm.broadcast_text(json.dumps(own)))
    check_versions({name: first[name] for name in versions()})
    if other := [name for name in {**first, **own} if first.get(name) != own.get(name)]:
        raise differs_error(files.get(other[0].partition(".")[0]) or files["model"], other)
    comm.all_gather(np.array(True))


def differs_error(file: object, differences: Sequence[object]) -> UserError:
    """Return the error for a file that this process reads otherwise than rank 0."""
    return UserError(
        f"{file}: not the same on {platform.node()} as for process 0: {format_names(differences)}; "
        "all processes must see the same files and options"
    )


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
