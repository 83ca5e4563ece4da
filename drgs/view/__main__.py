"""``python -m drgs.view [WHAT]``: look at Gaussians in a browser, rendered by our own kernels.

``WHAT`` is a file of Gaussians or the output folder of a fit; without it, a shipped crane truck.
The page has lenses, depths, normals, opacities, approximations and rendering times; its resolution
adapts while the camera moves.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial

import numpy as np

import drgs
from drgs.cameras.orbits import orbit_of_gaussians
from drgs.cameras.viewpoints import FIELD_OF_VIEW, Viewpoint
from drgs.cli.commands import PORT, VECTOR, CommandParser, file_or_folder, run_command
from drgs.cli.ending import StopRequest
from drgs.cli.execution import add_execution_arguments, execution_settings, select_variant
from drgs.core.environment import require_module
from drgs.core.errors import UserError
from drgs.live_page.frames import LiveScene
from drgs.live_page.page import Page, StartView
from drgs.live_page.scheduler import RenderRequests, RenderScheduler
from drgs.results.model import Background, Model, load_model
from drgs.results.model_arguments import UP, add_background, add_error, parse_background
from drgs.results.refined_cameras import training_cameras

IDLE_SECONDS = 0.05  # longest wait until a camera is found to be still, or Ctrl-C to be pressed


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.description = "View Gaussians in a browser, rendered live on this machine."
    parser.show_examples("%(prog)s", "%(prog)s out/lego", "%(prog)s model.ply --background white")
    parser.add_argument(
        "what",
        nargs="?",
        default=drgs.EXAMPLE,
        type=file_or_folder,
        metavar="MODEL|OUT_DIR",
        help="file of Gaussians, or output folder of a fit (default: a crane truck)",
    )
    add_background(parser)
    add_error(parser)
    text = "axis that the camera orbits about (default: mean up direction of the training "
    text += "cameras; 0 0 1 for a file)"
    parser.add_argument("--up", **VECTOR, help=text)
    parser.add_argument("--port", **PORT)
    add_execution_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C."""
    require_module("viser", "viewer", "drgs view")
    from drgs.live_page.server import run_server, url

    if not args.what.exists():
        raise UserError(f"{args.what}: there is no such file or folder")
    with execution_settings(args.threads, args.debug):
        select_variant(args.variant)
        model = load_model(args.what, background=background_of(args))
        views = cameras_of(args, model)
        if args.error is not None:
            model = model.within_error(args.error, views)
        scene = LiveScene(model.gaussians, model.settings, model.background)
        requests, start = RenderRequests(), start_of(args, model, views)
        with run_server(args.port, "--port") as server:
            page = Page(server, requests, start, scene.approximations)
            if len(views) > 1:
                page.add_cameras(views, visible=False)
            count = model.gaussians.num_gaussians
            print(f"{count:,} Gaussians; live view: {url(server)}", flush=True)
            print("Ctrl-C ends this", flush=True)
            scheduler = RenderScheduler(requests, page.show, page.refuse)
            with StopRequest() as stop:
                while not stop.requested:
                    if not scheduler.serve(lambda: scene):
                        requests.wait(IDLE_SECONDS)


def background_of(args: argparse.Namespace) -> Background | None:
    """Return the background of the command line; white behind the shipped truck by default."""
    return parse_background(args.background or (["white"] if args.what == drgs.EXAMPLE else None))


def cameras_of(args: argparse.Namespace, model: Model) -> Sequence[Viewpoint]:
    """Return a fit's training cameras, refined if there are such; else one that sees all."""
    origin = model.gaussians.origin
    if args.what.is_dir() and (views := training_cameras(args.what, origin)) is not None:
        return views
    orbit = orbit_of_gaussians(model.gaussians, np.array(args.up or UP), FIELD_OF_VIEW)
    return orbit.viewpoints(1, 400, 400, FIELD_OF_VIEW)


def start_of(args: argparse.Namespace, model: Model, views: Sequence[Viewpoint]) -> StartView:
    """Return the page's first camera and up direction."""
    start = StartView.from_views(views, np.median(model.gaussians.numpy().means, axis=0))
    return start if args.up is None else start.upright(np.array(args.up))


main = partial(run_command, add_arguments, "python -m drgs.view")

if __name__ == "__main__":
    main()
