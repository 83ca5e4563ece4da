"""``mpiexec -n K drgs render``: processes share the pictures; the first one writes them.

Every process reads what the command line names and finds the same cameras. The pictures go round:
the first process renders the first one, the second the second, and so on.
"""

from __future__ import annotations

import argparse
import json
import traceback
from collections.abc import Callable, Iterator, Sequence

import mitsuba as mi
import numpy as np

from drgs.core.errors import UserError
from drgs.data.types import Viewpoint
from drgs.distributed.ranks import Ranks, wait
from drgs.distributed.together import end_all, end_if_told, leading
from drgs.integrator.scene import render_views

GO = "go"
"""What the first process says when it waits for pictures."""

Render = Callable[..., Iterator[np.ndarray]]
"""Of a scene and views, pictures (H, W, 3)."""


def run_together(args: argparse.Namespace, work: Callable[[Render], None]) -> None:
    """Run the command on all processes; work: the command, given what renders views."""
    ranks = Ranks.world()
    if args.threads is None:
        args.threads = ranks.own_cores
    if args.what.suffix.lower() == ".xml" and ranks.size > 1:
        work = _refuse
    if ranks.is_first:
        with leading(ranks):
            work(lambda scene, views: _gathered(ranks, scene, views))
    else:
        _follow(ranks, work)


def _refuse(render: Render) -> None:
    del render
    raise UserError("mpiexec: a scene of Mitsuba is rendered by one process; leave mpiexec out")


def _gathered(ranks: Ranks, scene: mi.Scene, views: Sequence[Viewpoint]) -> Iterator[np.ndarray]:
    """All pictures in order, of which this process renders its own."""
    ranks.text_of(0, json.dumps([GO]))
    ranks.is_broken = True  # if it ends here, the others wait for somebody to take their pictures
    own = render_views(scene, views[:: ranks.size])
    for index, view in enumerate(views):
        source = index % ranks.size
        if source == 0:
            yield next(own)
            continue
        picture = np.empty((view.height, view.width, 3), np.float32)
        wait(ranks.receive(picture, source, 0))
        yield picture
    ranks.is_broken = False


def _follow(ranks: Ranks, work: Callable[[Render], None]) -> None:
    """Render what falls to this process, and end with the status of the first one."""

    def render(scene: mi.Scene, views: Sequence[Viewpoint]) -> Iterator[np.ndarray]:
        end_if_told(ranks)
        ranks.is_broken = True  # if it ends here, the first process waits for pictures
        own = views[ranks.rank :: ranks.size]
        for picture in render_views(scene, own):
            wait(ranks.send(np.ascontiguousarray(picture, np.float32), 0, 0))
        ranks.is_broken = False
        end_if_told(ranks)
        raise RuntimeError("the first process goes on with pictures that nobody has asked for")

    try:
        work(render)
        end_if_told(ranks)  # it had nothing to share
    except SystemExit:
        raise
    except BaseException as error:
        if isinstance(error, UserError) and not ranks.is_broken:
            end_if_told(ranks)  # the first process has found the same
        end_all(ranks, "".join(traceback.format_exception(error)), 1)
