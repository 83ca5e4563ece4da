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
from drgs.training.parallel.ranks import Ranks, wait

END = "end"
"""Message of the first process when all images are written."""

Render = Callable[..., Iterator[np.ndarray]]
"""Of a scene and views, pictures (H, W, 3)."""

Files = Mapping[str, object]
"""Files of models, cameras and backgrounds, for messages."""


def run_together(args: argparse.Namespace, work: Callable[[Render], None]) -> None:
    """Run the command on all processes; work: the command, given what renders views."""
    ranks = Ranks.world()
    if args.threads is None:
        args.threads = ranks.own_cores
    if args.what.suffix.lower() == ".xml" and ranks.size > 1:
        raise UserError("mpiexec: a scene of Mitsuba is rendered by one process; leave mpiexec out")
    background = " ".join(args.background or ())
    files = {"cameras": args.camera, "background": background, "model": args.what}
    if ranks.is_first:
        work(partial(_gathered, ranks, files))
        ranks.text_of(0, END)
    else:
        work(partial(_contributed, ranks, files))


def _gathered(
    ranks: Ranks, files: Files, scene: mi.Scene, views: Sequence[Viewpoint]
) -> Iterator[np.ndarray]:
    """All pictures in order, of which this process renders its own."""
    check_pictures(ranks, scene, views, files)
    own = render_views(scene, views[:: ranks.size])
    for index, view in enumerate(views):
        source = index % ranks.size
        if source == 0:
            yield next(own)
            continue
        picture = np.empty((view.height, view.width, 3), np.float32)
        wait(ranks.receive(picture, source, 0))
        yield picture


def _contributed(
    ranks: Ranks, files: Files, scene: mi.Scene, views: Sequence[Viewpoint]
) -> NoReturn:
    """Render what falls to this process, and end when the first process has."""
    check_pictures(ranks, scene, views, files)
    for picture in render_views(scene, views[ranks.rank :: ranks.size]):
        wait(ranks.send(np.ascontiguousarray(picture, np.float32), 0, 0))
    ranks.text_of(0, "")
    sys.exit()
