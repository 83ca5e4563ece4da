"""``mpiexec -n K drgs render``: rank k modulo K renders image k; rank 0 writes them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence

import mitsuba as mi
import numpy as np

from drgs.cameras.viewpoints import Viewpoint
from drgs.core.errors import UserError
from drgs.integrator.scene import render_views
from drgs.results.model import Render
from drgs.training.parallel.agreement import check_scene
from drgs.training.parallel.communicator import Communicator, wait


def run_together(args: argparse.Namespace, work: Callable[[Render], None]) -> None:
    """Run the command on all processes; work: the command, given a function that renders views."""
    comm = Communicator.world()
    if args.threads is None:
        args.threads = comm.num_own_cores
    if args.what.suffix.lower() == ".xml" and comm.size > 1:
        raise UserError("mpiexec: a scene of Mitsuba is rendered by one process; leave mpiexec out")
    background = " ".join(args.background or ())
    files = {"cameras": args.camera, "background": background, "model": args.what}

    def render_all(scene: mi.Scene, views: Sequence[Viewpoint]) -> Iterator[np.ndarray]:
        """Yield all images in order, of which rank 0 renders its own."""
        check_scene(comm, scene, views, files)
        own = render_views(scene, views[:: comm.size])
        for index, view in enumerate(views):
            source = index % comm.size
            if source == 0:
                yield next(own)
                continue
            image = np.empty((view.height, view.width, 3), np.float32)
            wait(comm.receive(image, source, 0))
            yield image

    def render_own(scene: mi.Scene, views: Sequence[Viewpoint]) -> Iterator[np.ndarray]:
        """Render the images of this rank, and end the process when rank 0 has written all."""
        check_scene(comm, scene, views, files)
        for image in render_views(scene, views[comm.rank :: comm.size]):
            wait(comm.send(np.ascontiguousarray(image, np.float32), 0, 0))
        comm.broadcast_text("")
        sys.exit()

    work(render_all if comm.is_root else render_own)
    if comm.is_root:
        comm.broadcast_text("all images are written")
