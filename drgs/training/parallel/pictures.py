"""``mpiexec -n K drgs render``: processes share the pictures; the first one writes them.

Every process reads what the command line names and finds the same cameras. The pictures go round:
the first process renders the first one, the second the second, and so on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NoReturn

import mitsuba as mi
import numpy as np

from drgs.core.errors import UserError
from drgs.datasets.types import Viewpoint
from drgs.integrator.scene import render_views
from drgs.training.parallel.agreement import check_pictures
from drgs.training.parallel.communicator import Communicator, wait

END = "end"
"""Message of the first process when all images are written."""

Render = Callable[..., Iterator[np.ndarray]]
"""Of a scene and views, pictures (H, W, 3)."""

Files = Mapping[str, object]
"""Files of models, cameras and backgrounds, for messages."""


def run_together(args: argparse.Namespace, work: Callable[[Render], None]) -> None:
    """Run the command on all processes; work: the command, given what renders views."""
    comm = Communicator.world()
    if args.threads is None:
        args.threads = comm.num_own_cores
    if args.what.suffix.lower() == ".xml" and comm.size > 1:
        raise UserError("mpiexec: a scene of Mitsuba is rendered by one process; leave mpiexec out")
    background = " ".join(args.background or ())
    files = {"cameras": args.camera, "background": background, "model": args.what}
    if comm.is_root:
        work(partial(_gathered, comm, files))
        comm.broadcast_text(END)
    else:
        work(partial(_contributed, comm, files))


def _gathered(
    comm: Communicator, files: Files, scene: mi.Scene, views: Sequence[Viewpoint]
) -> Iterator[np.ndarray]:
    """All pictures in order, of which this process renders its own."""
    check_pictures(comm, scene, views, files)
    own = render_views(scene, views[:: comm.size])
    for index, view in enumerate(views):
        source = index % comm.size
        if source == 0:
            yield next(own)
            continue
        picture = np.empty((view.height, view.width, 3), np.float32)
        wait(comm.receive(picture, source, 0))
        yield picture


def _contributed(
    comm: Communicator, files: Files, scene: mi.Scene, views: Sequence[Viewpoint]
) -> NoReturn:
    """Render what falls to this process, and end when the first process has."""
    check_pictures(comm, scene, views, files)
    for picture in render_views(scene, views[comm.rank :: comm.size]):
        wait(comm.send(np.ascontiguousarray(picture, np.float32), 0, 0))
    comm.broadcast_text("")
    sys.exit()
