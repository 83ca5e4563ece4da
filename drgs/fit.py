"""``python -m drgs.fit CONFIG.yml|FOLDER``: fit Gaussians to photographs.

Reads the configuration, or makes one that suits the folder, and the dataset, runs
:class:`drgs.training.trainer.Trainer`, measures the result on the test views and writes the output
folder:

- ``point_cloud.ply``: the Gaussians, in the layout of the 3DGS reference implementation
- ``point_cloud_viewers.ply``: the same for other viewers, where these render otherwise than the fit
- ``metrics.json``: quality on the test views, time, population, versions, machine, command
- ``history.csv``: loss, PSNR, population and rate over the iterations, now and then test PSNR,
  for the report's curve
- ``density.csv``: what was added to the population and removed from it, where anything was
- ``renders/<split>/*.png``: the test views as fitted
- ``side_by_side/<split>/*.png``: fitted, photograph and difference
- ``curves.png``, ``orbit.webp``, ``orbit.gif``
- ``report.html``: all of it on one page that needs no other file (``output.report: false``
  leaves out this page and what is made for it: comparisons, curves, orbits, ``viewer.html``)
- ``viewer.html``: the Gaussians to walk around in, in a browser, unless they are too many
- ``config.yml``: every value that the fit used
- ``views.json``: the cameras of the training views, for orbits
- ``colors.json``, ``cameras.json``: colour transforms and refined cameras of the training views
- ``plan.txt``: with ``--budget``, what was planned and why
- ``tensorboard/``: with ``--tensorboard``, the history as TensorBoard reads it

While it runs there is also ``checkpoint.npz``, from which ``--resume`` continues.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

import drgs
from drgs.cli.commands import MAX_PORT, CommandParser, at_least, file_or_folder, run_command
from drgs.cli.execution import add_execution_arguments, executing, select_variant
from drgs.cli.interrupts import INTERRUPTED_STATUS, StopRequest
from drgs.cli.progress import RunProgress
from drgs.config.approximations import Approximations
from drgs.config.changes import changed
from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.core.environment import processor, required
from drgs.core.errors import UserError, UserNote
from drgs.core.files import atomic_path
from drgs.core.folders import sole_writer
from drgs.core.memory import release_unused_memory
from drgs.core.private import llvm_version
from drgs.core.processes import process_number, start_mpi
from drgs.datasets import Dataset, View, load_dataset
from drgs.datasets.fingerprint import Fingerprint, fingerprint_of
from drgs.datasets.folders import config_for
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.defaults import completed
from drgs.initialization.start import (
    Start,
    description_of_start,
    gaussians_at,
    start_of,
)
from drgs.integrator.scene import check_lenses
from drgs.integrator.summary import described
from drgs.results.files import (
    BUDGET_PLAN,
    CHECKPOINT,
    CONFIG,
    DENSITY,
    EVENTS,
    GAUSSIANS,
    GAUSSIANS_FOR_VIEWERS,
    HISTORY,
    METRICS,
    REPORT,
    VIEWS,
)
from drgs.results.folder import (
    check_output_folder,
    claim_output_folder,
    continue_run,
    has_results,
    is_finished,
    load_moved_config,
    pictures_of,
    remove_run,
    require_no_run,
    seal_run,
    write_run_config,
)
from drgs.results.metrics import FitMetrics, Quality, SplitMetrics, mean_of
from drgs.results.refined_cameras import write_views
from drgs.results.report import (
    Fitted,
    score,
    seconds_of_curves,
    seconds_of_results,
    write_pictures,
    write_results,
)
from drgs.results.viewer import Shown, shows_as_fitted
from drgs.training.budget import (
    AllIterations,
    Deadline,
    Plan,
    load_curves,
    make_plan,
    parse_duration,
    rehearse,
    target_of,
)
from drgs.training.checkpoint import (
    Checkpoint,
    check_fits,
    check_same_data,
    load_checkpoint,
    remove_checkpoint,
    save_checkpoint,
)
from drgs.training.finite_checks import NonFiniteError
from drgs.training.history import History, smoother, write_density, write_history
from drgs.training.loop import Length, Observer, as_saved, iterations
from drgs.training.quality import measure, measured_views, measurement_is_due
from drgs.training.summary import summary_of_fit
from drgs.training.trainer import Trainer

if TYPE_CHECKING:  # imported where somebody looks on
    from drgs.viewer.server import LocalServer

LOADING_SECONDS = 1.2
"""Before :func:`run`: the interpreter and the libraries; 1.0 to 1.4 s on two cores (AMD Zen 4).
``--budget`` counts them."""

MOST_FOR_PICTURES = 0.33
"""Of the time that ``--budget`` leaves behind the start: pictures that take more are left out."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m drgs.fit``."""
    run_command(add_arguments, "python -m drgs.fit", arguments)


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Fit 3D Gaussians to posed photographs."
    parser.show_examples(
        "%(prog)s photographs",
        "%(prog)s scenes/photos.yml --data DIR --out out/mine",
        "%(prog)s --resume out/mine",
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "config",
        nargs="?",
        type=file_or_folder,
        metavar="CONFIG.yml|FOLDER",
        help="what to fit, and how; or the folder of a dataset, to have that chosen",
    )
    what.add_argument(
        "--resume", type=file_or_folder, metavar="OUT_DIR", help="go on with a fit that was stopped"
    )
    parser.add_argument(
        "--data", metavar="DIR", help="dataset folder (data.path), also one that was moved"
    )
    parser.add_argument("--out", metavar="DIR", help="output folder (default: out/NAME)")
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the run that the output folder holds"
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="override a value of the configuration, as in densify.every=200; repeatable",
    )
    parser.add_argument(
        "--budget",
        type=_duration,
        metavar="TIME",
        help="90s, 5m, 1h30m: plan a fit that is done, results written, after this time",
    )
    _add_looking_on(parser)
    add_execution_arguments(parser)
    parser.set_defaults(run=run, is_shared=True, prog=parser.prog)


def _add_looking_on(parser: CommandParser) -> None:
    group = parser.add_argument_group("looking on", "The result has the same bytes without these.")
    group.add_argument(
        "--view",
        action="store_true",
        help="show the fit on a page while it runs, with a pause and an early end (extra: viewer)",
    )
    group.add_argument(
        "--view-address",
        metavar="ADDRESS",
        help="where the page is (default: 127.0.0.1, for this machine alone)",
    )
    group.add_argument(
        "--view-port", type=at_least(1, MAX_PORT), metavar="N", help="(default: the first free one)"
    )
    group.add_argument(
        "--tensorboard",
        action="store_true",
        help="write the history for TensorBoard, too (extra: tensorboard)",
    )


@dataclass(frozen=True, eq=False)
class Run:
    """A fit, and the folder that it is saved to."""

    trainer: Trainer
    history: History
    data: Fingerprint
    out: Path

    @staticmethod
    def taken_up(
        trainer: Trainer, data: Fingerprint, out: Path, checkpoint: Checkpoint | None
    ) -> Run:
        """From its checkpoint, or from the beginning where there is none (None)."""
        if checkpoint is None:
            return Run(trainer, History(), data, out)
        check_fits(out, checkpoint, trainer.state())
        trainer.restore(checkpoint.trainer)
        print(f"continues at iteration {trainer.iteration}")
        history = History.from_array(checkpoint.history, checkpoint.wall_s, checkpoint.density)
        return Run(trainer, history, data, out)

    def save(self) -> None:
        """Write the checkpoint."""
        state, history = self.trainer.state(), self.history
        rows, changes = history.as_array(), history.density_array()
        checkpoint = Checkpoint(state, rows, history.wall_s, self.data, changes)
        save_checkpoint(self.out, self.trainer.config, checkpoint)


MakeTrainer = Callable[[FitConfig, Dataset, Gaussians], Trainer]
"""Of the fit's configuration, its photographs, and where it starts."""


def run(args: argparse.Namespace) -> None:
    """Fit what the command line names; end the process with status 130 if Ctrl-C stopped it."""
    if process_number() is None:
        run_with(args, Trainer)
        return
    start_mpi()
    from drgs.training.parallel.fitting import run_together

    run_together(args, partial(run_with, args))


def run_with(args: argparse.Namespace, make_trainer: MakeTrainer) -> None:
    """The command, on the process that reads, decides, writes and prints."""
    started = time.perf_counter() - LOADING_SECONDS
    with executing(args.threads, args.debug) as check_ranges, ExitStack() as blocks:
        server = blocks.enter_context(page_server(args))
        if args.tensorboard:
            required("tensorboardX", "tensorboard", "--tensorboard")
        config, out = what_to_fit(args)
        keep_folder = blocks.enter_context(sole_writer(out))
        if not args.overwrite and (has_results(out) if args.resume else is_finished(out, config)):
            remove_checkpoint(out)  # a process that was killed behind its last file has not
            seal_run(out)
            print(f"{out}: this fit is finished; --overwrite does it again")
            return
        checkpoint = earlier_state(args, config, out)
        if checkpoint is not None:
            config = checkpoint.config
        dataset = load_dataset(config.data_for_training)
        data = fingerprint_of(dataset)
        if checkpoint is not None:
            check_same_data(out, config.data.path, checkpoint.data, data)
        config = completed(config, dataset)
        select_variant(args.variant)
        start = announced_start(config, dataset)
        # The folder is touched when all of the input has been found to be usable.
        gaussians = gaussians_at(start, config)
        length, plan = AllIterations(), None
        if args.budget is not None:
            end, plan = planned(config, dataset, gaussians, started + args.budget, make_trainer)
            config = plan.config
            print(plan.reasons)
        trainer = make_trainer(config, dataset, gaussians)
        dataset = trainer.dataset  # of which others may have a part
        taken_up = Run.taken_up(trainer, data, out, checkpoint)
        del checkpoint  # and its arrays
        keep_folder()
        take_folder(args, config, dataset, out)
        if plan is not None:
            with atomic_path(out / BUDGET_PLAN) as temporary:
                temporary.write_text(f"--budget {args.budget:g}s\n{plan.reasons}\n")
            length = Deadline(trainer, end, plan.curve)
        observers: list[Observer] = []
        if args.tensorboard:
            from drgs.training.event_log import EventLog

            observers.append(blocks.enter_context(EventLog(out / EVENTS, taken_up.history)))
        if server is not None:
            from drgs.viewer.fit_page import watch
            from drgs.viewer.server import url

            watching, length = watch(server, trainer, dataset, length)
            observers.append(watching)
            print(f"look on at {url(server)}", flush=True)
        finished = fit_and_write(taken_up, dataset, length, check_ranges, args.command, observers)
    if not finished:
        print(f"stopped; continue with: {args.prog} --resume {out}")
        sys.exit(INTERRUPTED_STATUS)


def page_server(args: argparse.Namespace) -> AbstractContextManager[LocalServer | None]:
    """What serves the page that ``--view`` asks for; None without it.

    Raises ``UserError`` where it cannot be served, before anything is read or written.
    """
    if not args.view:
        for name in ("address", "port"):
            if getattr(args, f"view_{name}") is not None:
                raise UserError(f"--view-{name}: needs --view")
        return nullcontext()
    required("viser", "viewer", "--view")
    from drgs.viewer.server import ADDRESS, serving

    options = ("--view-address", "--view-port")
    return serving(args.view_address or ADDRESS, args.view_port, options)


def what_to_fit(args: argparse.Namespace) -> tuple[FitConfig, Path]:
    """The configuration that the command line asks for, and the output folder."""
    data = [] if args.data is None else [f"data.path={args.data}"]
    if args.resume is not None:
        if args.out is not None or args.overrides or args.overwrite or args.budget is not None:
            raise UserError(
                f"--resume: takes its configuration from {args.resume / CONFIG}: leave out --out, "
                "--set, --budget and --overwrite"
            )
        return load_moved_config(args.resume, data), args.resume
    out = [] if args.out is None else [f"output.dir={args.out}"]
    overrides = args.overrides + data + out
    if args.config.is_dir():
        if data:
            raise UserError(f"--data: {args.config} is a folder already; leave one of them out")
        config, reasons = config_for(args.config, overrides)
        print(reasons)
        return config, config.output.dir or Path("out") / args.config.resolve().name
    config = load_config(args.config, overrides)
    return config, config.output.dir or Path("out") / args.config.stem


def earlier_state(args: argparse.Namespace, config: FitConfig, out: Path) -> Checkpoint | None:
    """The checkpoint from which the fit in the folder ``out`` goes on; None: there is none.

    Raises ``UserError`` where the folder is not for this fit. Nothing is written.
    """
    if args.overwrite:
        return None
    if args.budget is not None:
        require_no_run(out)
    elif args.resume is None:
        check_output_folder(out, config)
    return load_checkpoint(out, config)


def take_folder(args: argparse.Namespace, config: FitConfig, dataset: Dataset, out: Path) -> None:
    """Make ``out`` the folder of the fit, or raise ``UserError`` and leave it as it is."""
    pictures = pictures_of(dataset.test_split, [view.name for view in dataset.test])
    if args.overwrite:
        remove_run(out, pictures)
    if args.resume is None:
        claim_output_folder(out, config, pictures)
    else:
        continue_run(out, config, pictures)


def announced_start(config: FitConfig, dataset: Dataset) -> Start:
    """Where the fit starts; prints that, the data and what is simulated.

    Raises ``UserError`` for lenses that the projection cannot show.
    """
    print(dataset.description)
    print(
        f"{len(dataset.train)} views to train on, {len(dataset.test)} of split "
        f"'{dataset.test_split}' to measure on; background {config.data.background}; scene extent "
        f"{dataset.extent:.3g}"
    )
    start = start_of(config, dataset)
    print(description_of_start(config, start))
    print(described(summary_of_fit(config, dataset)))
    views, remedy = (*dataset.train, *dataset.test), "set data.ignore_distortion"
    check_lenses(config.model, views, f"{config.data.path}: ", remedy)
    return start


def planned(
    config: FitConfig,
    dataset: Dataset,
    gaussians: Gaussians,
    end: float,
    make_trainer: MakeTrainer = Trainer,
) -> tuple[float, Plan]:
    """When the iterations are to end, and a plan until then.

    end: of everything, by ``time.perf_counter``.
    """
    rehearsal = rehearse(config, dataset, gaussians, make_trainer)
    num_points, num_gaussians = gaussians.num_gaussians, target_of(config) or 0
    results = seconds_of_results(
        rehearsal.trainer.full_scene(),
        dataset,
        max(num_points, num_gaussians),
        config.model.sh_degree,
    )
    pictures = results.renders if config.output.save_renders else 0.0
    pictures += results.report + seconds_of_curves() if config.output.report else 0.0
    if pictures > MOST_FOR_PICTURES * (end - time.perf_counter()):
        warnings.warn(UserNote(_NO_PICTURES), stacklevel=2)
        config = changed(config, {"output.report": False, "output.save_renders": False})
    else:
        end -= pictures
    has_one_file = config.model.approximations.are_usual
    end -= results.measuring * (1 if has_one_file else 2)
    if not has_one_file:
        from drgs.training.viewers import TIME_SHARE

        end -= TIME_SHARE * max(0.0, end - time.perf_counter())
    side = min(min(view.width, view.height) for view in dataset.train)
    seconds = end - time.perf_counter()
    second = rehearsal.iteration_s
    return end, make_plan(config, num_points, side, seconds, second, load_curves())


def fit_and_write(
    fit: Run,
    dataset: Dataset,
    length: Length,
    check_ranges: Callable[[], None],
    command: str,
    observers: Sequence[Observer] = (),
) -> bool:
    """Fit, measure, and write into the fit's folder; False if stopped by Ctrl-C.

    check_ranges: raises ``UserError``; command: the line that was typed, for the report.
    """
    trainer, log, out = fit.trainer, fit.history, fit.out
    try:
        views = measured_views(dataset.test)
        if not run_iterations(fit, views, length, check_ranges, observers):
            return False
        wall_s = log.wall_s
        gaussians = trainer.gaussians()
    except NonFiniteError as error:
        raise UserError(f"{error}; {_remedy(out)}") from None
    _say_what_is_missing(trainer)
    release_unused_memory()  # encoding the orbit's frames takes as much as iterations do
    as_saved(gaussians, trainer).save(out / GAUSSIANS)
    for effect in trainer.effects:
        effect.write(out, dataset)
    write_history(out / HISTORY, log.rows)
    write_density(out / DENSITY, log.density)
    write_views(out / VIEWS, dataset)
    config, render = trainer.config, trainer.images
    write_run_config(out, config)
    output = config.output
    scores = write_pictures(out, dataset, render, output.save_renders, output.report)
    quality = mean_of(scores)
    metrics = summarize(config, dataset, gaussians.num_gaussians, wall_s, quality, command)
    for_viewers = None
    if not config.model.approximations.are_usual:
        seen, for_viewers = write_for_viewers(out, trainer, dataset, gaussians)
        metrics["viewers"] = measured_split(seen, dataset)
    if output.report:
        shown = shown_on_page(gaussians, config.model.approximations, for_viewers)
        fitted = Fitted(trainer.full_scene(), gaussians, render, shown)
        write_results(out, dataset, fitted, scores, log, metrics)
    with atomic_path(out / METRICS) as temporary:
        temporary.write_text(json.dumps(metrics, indent=2) + "\n")
    remove_checkpoint(out)
    seal_run(out)
    print(
        f"{quality.num_views} {dataset.test_split} views: PSNR {quality.psnr:.2f} dB, "
        f"SSIM {quality.ssim:.4f}; {gaussians.num_gaussians:,} Gaussians; "
        f"{config.iterations} iterations in {wall_s:.0f} s"
    )
    if "viewers" in metrics:
        print(
            f"as other viewers show {out / GAUSSIANS_FOR_VIEWERS}: "
            f"PSNR {metrics['viewers']['psnr']:.2f} dB"
        )
    print(f"written: {out}")
    if output.report:
        print(f"open {out / REPORT}")
    return True


def write_for_viewers(
    out: Path, trainer: Trainer, dataset: Dataset, gaussians: Gaussians
) -> tuple[Quality, Gaussians]:
    """Write the Gaussians for other viewers; how these show the test views, and the Gaussians.

    trainer: is released by it, and goes on rendering what it has fitted; gaussians: that.
    """
    from drgs.training.viewers import for_viewers, num_iterations

    total = num_iterations(trainer.config)
    with RunProgress("iteration for viewers", total) as shown:
        found = for_viewers(trainer, gaussians, lambda done: shown.update(done, total))
    found.gaussians.save(out / GAUSSIANS_FOR_VIEWERS)
    pairs = zip(found.pictures(dataset.test), dataset.test, strict=True)
    return mean_of([score(image, view) for image, view in pairs]), found.gaussians


def shown_on_page(
    gaussians: Gaussians, approximations: Approximations, for_viewers: Gaussians | None
) -> Shown:
    """What ``viewer.html`` shows: the fit's own, where it renders with their approximations.

    for_viewers: what it shows otherwise; None: there is nothing but the fit's own.
    """
    if for_viewers is not None and not shows_as_fitted(approximations):
        return Shown(for_viewers, Approximations())
    if gaussians.smoothing is not None:
        from drgs.effects.smoothing import baked

        gaussians = baked(gaussians)
    return Shown(gaussians, approximations)


def run_iterations(
    fit: Run,
    views: tuple[View, ...],
    length: Length,
    check_ranges: Callable[[], None],
    observers: Sequence[Observer] = (),
) -> bool:
    """Run the iterations that are left, showing progress and saving checkpoints.

    views: are measured now and then. False if Ctrl-C stopped it; the state is saved then, and
    behind the last iteration: what was done is a configuration from then on, which results that
    are half written belong to.
    """
    trainer, history = fit.trainer, fit.history
    smooth_psnr, every = None, trainer.config.output.checkpoint_every
    shown = RunProgress("iteration", length.total(trainer), trainer.iteration)
    with shown as progress, StopRequest() as stop:
        for done in iterations(trainer, history, length):
            check_ranges()
            if done.row is not None:
                smooth_psnr = smoother(smooth_psnr, done.row.psnr)
                status = (
                    f"loss {done.row.loss:.4f}  PSNR {smooth_psnr:5.2f} dB  "
                    f"Gaussians {done.row.num_gaussians:,}"
                )
                progress.update(done.row.iteration, length.total(trainer), status)
                is_shown = trainer.config.output.report
                if is_shown and measurement_is_due(history.rows, trainer.config.iterations):
                    measure(trainer, history, views)
            for observer in observers:
                observer.after(trainer, history, done, lambda: stop.requested)
            is_due = every and (done.is_last or done.report.passes(every))
            if stop.requested or is_due:
                fit.save()
            if stop.requested:
                return False
    return True


def _say_what_is_missing(trainer: Trainer) -> None:
    """A note where a plan was revised and time was up before the last phase had ended."""
    wanted = trainer.config.densify.prune.to
    if wanted is not None and trainer.num_gaussians > wanted:
        note = (
            f"time was up before there were only densify.prune.to = {wanted:,} Gaussians: there "
            f"are {trainer.num_gaussians:,}; give --budget more time"
        )
        warnings.warn(UserNote(note), stacklevel=2)


_NO_PICTURES = (
    "--budget: the time is needed for iterations: no report, orbit and pictures are written "
    "(output.report, output.save_renders); python -m drgs.render OUT_DIR --out DIR makes pictures"
)


def _remedy(out: Path) -> str:
    """What to do about numbers that are not finite."""
    kept = "the last checkpoint is kept" if (out / CHECKPOINT).exists() else "nothing was saved yet"
    return (
        f"{kept}. --resume {out} --debug repeats this with range checks; lower learning rates "
        "(--set optimizer.means_lr=..., and so on) may avoid it"
    )


def summarize(
    config: FitConfig,
    dataset: Dataset,
    num_gaussians: int,
    wall_s: float,
    quality: Quality,
    command: str,
) -> FitMetrics:
    """What ``metrics.json`` holds."""
    return {
        "iterations": config.iterations,
        "num_gaussians": num_gaussians,
        "wall_s": round(wall_s, 2),
        "test": measured_split(quality, dataset),
        "seed": config.seed,
        "versions": {
            "drgs": drgs.__version__,
            "mitsuba": mi.__version__,
            "drjit": dr.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
            "llvm": ".".join(map(str, llvm_version())),
        },
        "variant": mi.variant(),
        "threads": dr.thread_count(),
        "processor": processor(),
        "date": datetime.now().astimezone().isoformat(timespec="minutes"),
        "command": command,
        "config": config.model_dump(mode="json"),
    }


def measured_split(quality: Quality, dataset: Dataset) -> SplitMetrics:
    """Of the test views."""
    numbers = {"psnr": quality.psnr, "ssim": quality.ssim, "num_views": quality.num_views}
    return {**numbers, "split": dataset.test_split}


def _duration(text: str) -> float:
    try:
        return parse_duration(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


if __name__ == "__main__":
    main()
