"""``python -m drgs.fit CONFIG.yml|FOLDER``: fit Gaussians to photographs.

Runs :class:`drgs.fit.session.FitSession` with a given or a default configuration.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from drgs.cli.commands import PORT, CommandParser, file_or_folder, run_command
from drgs.cli.ending import INTERRUPTED_STATUS
from drgs.cli.execution import add_execution_arguments, execution_settings
from drgs.config.changes import with_iterations
from drgs.config.extensions import describe_extensions
from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.core.environment import require_module
from drgs.core.errors import UserError
from drgs.core.processes import process_number, start_mpi
from drgs.datasets.folders import config_for
from drgs.fit.budget import Budget, parse_duration
from drgs.fit.fit_folder import FitFolder
from drgs.fit.session import FitSession
from drgs.results.folder import CONFIG, has_results, load_moved_config, load_run_config
from drgs.training.parallel.communicator import Communicator

MIN_EXAMINED_SECONDS = 100  # of a --budget: no short fit ends within a tenth of less

LOADING_SECONDS = 1.2  # before run(), for imports; --budget includes them


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Fit 3D Gaussians to posed photographs."
    parser.show_examples(
        "%(prog)s photographs",
        "%(prog)s scenes/photos.yml --data DIR --out out/mine",
        "%(prog)s --resume out/mine",
    )
    parser.more_help = describe_extensions
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "config",
        nargs="?",
        type=file_or_folder,
        metavar="CONFIG.yml|FOLDER",
        help="configuration file, or dataset folder, whose settings are then chosen automatically",
    )
    what.add_argument(
        "--resume", type=file_or_folder, metavar="OUT_DIR", help="continue a fit that was stopped"
    )
    parser.add_argument(
        "--data", metavar="DIR", help="dataset folder (data.path), also if it was moved"
    )
    parser.add_argument("--out", metavar="DIR", help="output folder (default: out/NAME)")
    parser.add_argument(
        "--overwrite", action="store_true", help="replace an earlier run in the output folder"
    )
    parser.add_overrides("override a value of the configuration, as in densify.every=200")
    parser.add_argument(
        "--leave-out",
        action="append",
        default=[],
        metavar="NAME",
        help="photograph that is not used (data.leave_out), by its file name; repeatable",
    )
    parser.add_argument(
        "--budget",
        type=parse_duration,
        metavar="TIME",
        help="90s, 5m, 1h30m: plan a fit that ends within this time, results included",
    )
    parser.add_argument(
        "--max-gaussians",
        dest="overrides",
        action="append",
        type="densify.max_gaussians={}".format,
        metavar="N",
        help="most Gaussians at any time (densify.max_gaussians); --budget is a time",
    )
    group = parser.add_argument_group("viewing", "These do not change the result.")
    group.add_argument(
        "--view",
        action="store_true",
        help="show the running fit on a web page, with buttons to pause and end it (extra: viewer)",
    )
    group.add_argument("--view-port", **PORT)
    add_execution_arguments(parser)
    parser.set_defaults(run=run, is_shared=True, prog=parser.prog)


def run(args: argparse.Namespace) -> None:
    """Fit the dataset of the command line; exit with status 130 if Ctrl-C stopped it."""
    started = time.perf_counter() - LOADING_SECONDS
    comm = communicator(args)
    budget = None if args.budget is None else Budget(args.budget, started + args.budget)
    with execution_settings(args.threads, args.debug) as check_ranges, ExitStack() as blocks:
        session = FitSession(
            None, variant=args.variant, budget=budget, check_ranges=check_ranges, comm=comm
        )
        if not comm.is_root:
            session.run()
            return
        if args.view:
            serve_live_view(session, args.view_port, blocks)
        elif args.view_port is not None:
            raise UserError("--view-port: needs --view")
        session.config, out = read_inputs(args)
        session.folder = FitFolder(out, args.command, args.resume is not None, args.overwrite)
        if args.config is not None and args.config.is_dir():
            choose_effects(session, session.config, session.folder)
        session.uses_terminal = True
        finished = session.run()
    if not finished:
        print(f"stopped; continue with: {args.prog} --resume {out}")
        sys.exit(INTERRUPTED_STATUS)


def choose_effects(session: FitSession, config: FitConfig, folder: FitFolder) -> None:
    """Let the session examine the dataset, unless an earlier run in its folder has."""
    examined = folder.with_examination(config)
    if examined is not None:
        session.config = examined
    elif session.budget is not None and session.budget.seconds < MIN_EXAMINED_SECONDS:
        print(f"not examined: --budget is less than {MIN_EXAMINED_SECONDS} s")
    else:
        session.examines = True


def communicator(args: argparse.Namespace) -> Communicator:
    """Return the communicator of this process, or of those that ``mpiexec`` has started."""
    if process_number() is None:
        return Communicator()
    start_mpi()
    comm = Communicator.world()
    if args.threads is None:
        args.threads = comm.num_own_cores
    if args.view:
        raise UserError("--view: shows the fit of one process alone; leave it out, or mpiexec")
    if not comm.is_root:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # rank 0 decides when to stop
    return comm


def serve_live_view(session: FitSession, port: int | None, blocks: ExitStack) -> None:
    """Serve a page until ``blocks`` ends, which observes the fit from its start."""
    require_module("viser", "viewer", "--view")
    from drgs.live_page.server import run_server, url

    server = blocks.enter_context(run_server(port, "--view-port"))

    def observe(session: FitSession) -> None:
        from drgs.fit.live_view import watch

        viewer, session.continues = watch(server, session.trainer, session.continues)
        session.observers.append(viewer)
        print(f"live view: {url(server)}", flush=True)

    session.on_start = observe


def read_inputs(args: argparse.Namespace) -> tuple[FitConfig, Path]:
    """Return the configuration that the command line specifies, and the output folder."""
    data = [] if args.data is None else [f"data.path={args.data}"]
    if args.resume is not None:
        given = args.out is not None, args.budget is not None, args.overwrite, args.leave_out
        more = [text for text in args.overrides if text.startswith("iterations=")]
        if len(more) < len(args.overrides) or any(given):
            raise UserError(
                f"--resume: takes its configuration from {args.resume / CONFIG}: leave out --out, "
                "--set, --leave-out, --budget and --overwrite; --set iterations=N alone goes on"
            )
        config = load_moved_config(args.resume, data)
        if more and not has_results(args.resume):
            raise UserError(f"--set {more[0]}: {args.resume} has not ended yet; leave it out")
        if more:
            config = with_iterations(config, load_run_config(args.resume, more).iterations)
        return config, args.resume
    out = [] if args.out is None else [f"output.dir={args.out}"]
    left_out = [f"data.leave_out={json.dumps(args.leave_out)}"] if args.leave_out else []
    overrides = args.overrides + left_out + data + out
    if args.config.is_dir():
        if data:
            raise UserError(f"--data: {args.config} is a folder already; leave one of them out")
        config, reasons = config_for(args.config, overrides)
        print(reasons)
        name = args.config.resolve().name
    else:
        config, name = load_config(args.config, overrides), args.config.stem
    return config, config.output.dir or Path("out") / name


main = partial(run_command, add_arguments, "python -m drgs.fit")

if __name__ == "__main__":
    main()
