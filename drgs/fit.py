"""``python -m drgs.fit CONFIG.yml``: fit Gaussians to photographs.

Reads the configuration and the dataset, runs :class:`drgs.training.trainer.Trainer`, measures the
result on the test views and writes the output folder:

- ``point_cloud.ply``: the Gaussians, in the layout of the 3DGS reference implementation
- ``metrics.json``: quality on the test views, time, population, versions, machine, command
- ``history.csv``: loss, PSNR, population and rate over the iterations, now and then test PSNR
- ``renders/<split>/*.png``: the test views as fitted
- ``side_by_side/<split>/*.png``: fitted, photograph and difference
- ``curves.png``, ``orbit.webp``, ``orbit.gif``
- ``report.html``: all of it on one page that needs no other file
- ``config.yml``: every value that the fit used
- ``colors.json``, ``cameras.json``: colour transforms and refined cameras of the training views
- ``plan.txt``: with ``--budget``, what was planned and why

While it runs there is also ``checkpoint.npz``, from which ``--resume`` continues.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import drgs
from drgs.cli.commands import CommandParser, file_or_folder, run_command
from drgs.cli.execution import add_execution_arguments, executing, select_variant
from drgs.cli.interrupts import INTERRUPTED_STATUS, StopRequest
from drgs.cli.progress import RunProgress
from drgs.config.load import dump_config, load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.core.files import atomic_path
from drgs.core.machine import processor
from drgs.core.private import llvm_version
from drgs.data import Dataset, View, initial_gaussians, load_dataset
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import check_lenses
from drgs.integrator.summary import described
from drgs.results.files import (
    BUDGET_PLAN,
    CHECKPOINT,
    CONFIG,
    GAUSSIANS,
    HISTORY,
    METRICS,
    REPORT,
)
from drgs.results.folder import (
    claim_output_folder,
    is_finished,
    load_run_config,
    remove_run,
    require_no_run,
)
from drgs.results.metrics import FitMetrics, Quality, mean_of
from drgs.results.report import seconds_to_write, write_pictures, write_results
from drgs.training.budget import (
    AllIterations,
    Deadline,
    Plan,
    load_curves,
    make_plan,
    parse_duration,
    rehearse,
)
from drgs.training.checkpoint import (
    Checkpoint,
    load_checkpoint,
    remove_checkpoint,
    save_checkpoint,
)
from drgs.training.finite_checks import NonFiniteError
from drgs.training.history import History, write_history
from drgs.training.loop import Length, as_saved, iterations
from drgs.training.quality import measure, measured_views, measurement_is_due
from drgs.training.summary import summary_of_fit
from drgs.training.trainer import Trainer

SMOOTHING = 0.9
"""Weight of the past in the PSNR that the progress line shows."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m drgs.fit``."""
    run_command(add_arguments, "python -m drgs.fit", arguments)


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Fit 3D Gaussians to posed photographs."
    parser.show_examples(
        "%(prog)s scenes/lego.yml --data DIR --out out/mine --set iterations=3000",
        "%(prog)s --resume out/mine",
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("config", nargs="?", metavar="CONFIG.yml", help="what to fit, and how")
    what.add_argument(
        "--resume", type=file_or_folder, metavar="OUT_DIR", help="go on with a fit that was stopped"
    )
    parser.add_argument("--data", metavar="DIR", help="dataset folder (data.path)")
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
    add_execution_arguments(parser)
    parser.set_defaults(run=run, prog=parser.prog)


def run(args: argparse.Namespace) -> None:
    """Fit what the command line names; end the process with status 130 if Ctrl-C stopped it."""
    started = time.perf_counter()
    with executing(args.threads, args.debug) as check_ranges:
        config, out = what_to_fit(args)
        if is_finished(out, config) and not args.overwrite:
            print(f"{out}: this fit is finished; --overwrite does it again")
            return
        dataset = load_dataset(config.data_for_training)
        select_variant(args.variant)
        announce(config, dataset)
        # The folder is touched when all of the input has been found to be usable.
        gaussians = initial_gaussians(config, dataset)
        length, plan = AllIterations(), None
        if args.budget is not None:
            if not args.overwrite:
                require_no_run(out)
            end, plan = planned(config, dataset, gaussians, started + args.budget)
            config = plan.config
            print(plan.reasons)
        trainer = Trainer(config, dataset, gaussians)
        if args.overwrite:
            remove_run(out)
        claim_output_folder(out, config)
        if plan is not None:
            with atomic_path(out / BUDGET_PLAN) as temporary:
                temporary.write_text(f"--budget {args.budget:g}s\n{plan.reasons}\n")
            length = Deadline(trainer, end, plan.curve)
        finished = fit_and_write(trainer, dataset, out, length, check_ranges, args.command)
    if not finished:
        print(f"stopped; continue with: {args.prog} --resume {out}")
        sys.exit(INTERRUPTED_STATUS)


def what_to_fit(args: argparse.Namespace) -> tuple[FitConfig, Path]:
    """The configuration that the command line asks for, and the output folder."""
    given = {"data.path": args.data, "output.dir": args.out}
    shorthands = [f"{key}={value}" for key, value in given.items() if value is not None]
    if args.resume is not None:
        if shorthands or args.overrides or args.overwrite or args.budget is not None:
            raise UserError(
                f"--resume: takes its configuration from {args.resume / CONFIG}: leave out --data, "
                "--out, --set, --budget and --overwrite"
            )
        return load_run_config(args.resume), args.resume
    config = load_config(args.config, args.overrides + shorthands)
    return config, config.output.dir or Path("out") / Path(args.config).stem


def announce(config: FitConfig, dataset: Dataset) -> None:
    """Print the data and what is simulated; refuse lenses that the projection cannot show."""
    print(dataset.description)
    print(
        f"{len(dataset.train)} views to train on, {len(dataset.test)} of split "
        f"'{dataset.test_split}' to measure on; background {config.data.background}"
    )
    print(described(summary_of_fit(config, dataset)))
    views, remedy = (*dataset.train, *dataset.test), "set data.ignore_distortion"
    check_lenses(config.model, views, f"{config.data.path}: ", remedy)


def planned(
    config: FitConfig, dataset: Dataset, gaussians: Gaussians, end: float
) -> tuple[float, Plan]:
    """When the iterations are to end, and a plan until then.

    end: of everything, by ``time.perf_counter``.
    """
    rehearsal = rehearse(config, dataset, gaussians)
    end -= seconds_to_write(rehearsal.trainer.scene, dataset)
    side = min(min(view.width, view.height) for view in dataset.train)
    seconds = end - time.perf_counter()
    num_points, second = gaussians.num_gaussians, rehearsal.iteration_s
    return end, make_plan(config, num_points, side, seconds, second, load_curves())


def fit_and_write(
    trainer: Trainer,
    dataset: Dataset,
    out: Path,
    length: Length,
    check_ranges: Callable[[], None],
    command: str,
) -> bool:
    """Fit, measure, and write into the folder ``out``; False if stopped by Ctrl-C.

    Goes on from the checkpoint in ``out``, if there is one. check_ranges: raises ``UserError``;
    command: the line that was typed, for the report.
    """
    checkpoint = load_checkpoint(out, trainer.config)
    log = History()
    if checkpoint is not None:
        trainer.restore(checkpoint.trainer)
        log = History.from_array(checkpoint.history, checkpoint.wall_s)
        print(f"continues at iteration {trainer.iteration}")
    try:
        views = measured_views(dataset.test)
        if not run_iterations(trainer, log, views, out, length, check_ranges):
            return False
        wall_s = log.wall_s
        gaussians = trainer.gaussians()
    except NonFiniteError as error:
        raise UserError(f"{error}; {_remedy(out)}") from None
    as_saved(gaussians, trainer).save(out / GAUSSIANS)
    for effect in trainer.effects:
        effect.write(out, dataset.train)
    write_history(out / HISTORY, log.rows)
    config, render = trainer.config, trainer.pictures
    dump_config(config, out / CONFIG)
    scores = write_pictures(out, dataset, render, config.output.save_renders)
    quality = mean_of(scores)
    metrics = summarize(config, dataset, gaussians.num_gaussians, wall_s, quality, command)
    write_results(out, dataset, trainer.scene, gaussians, render, scores, log.rows, metrics)
    with atomic_path(out / METRICS) as temporary:
        temporary.write_text(json.dumps(metrics, indent=2) + "\n")
    remove_checkpoint(out)
    print(
        f"{quality.num_views} {dataset.test_split} views: PSNR {quality.psnr:.2f} dB, "
        f"SSIM {quality.ssim:.4f}; {gaussians.num_gaussians:,} Gaussians; "
        f"{config.iterations} iterations in {wall_s:.0f} s"
    )
    print(f"written: {out}")
    print(f"open {out / REPORT}")
    return True


def run_iterations(
    trainer: Trainer,
    history: History,
    views: tuple[View, ...],
    out: Path,
    length: Length,
    check_ranges: Callable[[], None],
) -> bool:
    """Run the iterations that are left, showing progress and saving checkpoints.

    views: are measured now and then. False if Ctrl-C stopped it; the state is saved then.
    """
    smooth_psnr, every = None, trainer.config.output.checkpoint_every
    shown = RunProgress("iteration", length.total(trainer), trainer.iteration)
    with shown as progress, StopRequest() as stop:
        for done in iterations(trainer, history, length):
            check_ranges()
            if done.row is not None:
                psnr = done.row.psnr
                smooth_psnr = psnr if smooth_psnr is None else smooth_psnr
                smooth_psnr = SMOOTHING * smooth_psnr + (1 - SMOOTHING) * psnr
                status = (
                    f"loss {done.row.loss:.4f}  PSNR {smooth_psnr:5.2f} dB  "
                    f"Gaussians {done.row.num_gaussians:,}"
                )
                progress.update(done.row.iteration, length.total(trainer), status)
                if measurement_is_due(history.rows, trainer.config.iterations):
                    measure(trainer, history, views)
            is_due = every and done.report.iteration % every == 0 and not done.is_last
            if stop.requested or is_due:
                save(trainer, history, out)
            if stop.requested:
                return False
    return True


def save(trainer: Trainer, log: History, out: Path) -> None:
    """Write the checkpoint."""
    save_checkpoint(out, trainer.config, Checkpoint(trainer.state(), log.as_array(), log.wall_s))


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
        "test": {
            "psnr": quality.psnr,
            "ssim": quality.ssim,
            "num_views": quality.num_views,
            "split": dataset.test_split,
        },
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


def _duration(text: str) -> float:
    try:
        return parse_duration(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


if __name__ == "__main__":
    main()
