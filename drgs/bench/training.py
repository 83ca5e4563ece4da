"""``python -m drgs.bench training``: what another minute of fitting buys.

The shipped scene at 200x200 (``scenes/lego_mini.yml``) is fitted with different numbers of
iterations, and with one other choice at a time: smaller pictures first, fewer Gaussians, spherical
harmonics of a lower degree, no SSIM. Each choice is a curve of the quality on the test views over
the time that the fit took. Finished fits are not repeated, interrupted ones go on.

``--times`` shows what plans make of these curves (``drgs.fit --budget``): a fit for each of several
times, which count everything from the start of the command to its end. An interrupted one begins
anew.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi

from drgs import fit
from drgs.bench.output import add_out, machine, markdown_table, write_csv
from drgs.cli.commands import CommandParser
from drgs.config.changes import changed, with_iterations
from drgs.config.load import dump_config, load_config
from drgs.config.schema import FitConfig
from drgs.datasets import load_dataset
from drgs.initialization.defaults import completed
from drgs.initialization.start import initial_gaussians
from drgs.io.figures import new_figure, write_figure
from drgs.results.files import METRICS
from drgs.training.budget import STRATEGIES, Strategy, rehearse

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONFIG = Path(__file__).parents[2] / "scenes" / "lego_mini.yml"

BUDGETS = (250, 750, 2000, 5000)
"""Iterations."""

QUICK_BUDGETS = (100, 200)

TIMES = ("10s", "30s", "1m", "2m", "5m")
"""For all that a fit does."""

QUICK_TIMES = ("20s",)

REHEARSALS = 3

Change = Callable[[FitConfig], FitConfig]


@dataclass(frozen=True)
class Choice:
    """A curve: a change of the configuration, which knows its number of iterations."""

    name: str
    change: Change


def _strategy(strategy: Strategy) -> Choice:
    return Choice(strategy.name, lambda config: strategy.applied(config, config.init.num_points))


def _other(name: str, **values: object) -> Choice:
    """values: by names of the configuration, with __ for a dot."""
    changes = {key.replace("__", "."): value for key, value in values.items()}
    return Choice(name, lambda config: changed(config, changes))


CHOICES = (
    *map(_strategy, STRATEGIES),
    _other("SH of degree 1", model__sh_degree=1),
    _other("no SSIM", loss__dssim_weight=0.0),
)


@dataclass(frozen=True)
class Point:
    """A finished fit."""

    choice: str
    iterations: int
    start_s: float  # of an iteration at the start, as shipped
    wall_s: float  # of all iterations
    psnr: float  # dB, test views
    ssim: float
    gaussians: int


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s --only 1 2", "%(prog)s --times")
    add_out(parser, run, "training/training.csv", "training/training.png")
    parser.add_argument("--quick", action="store_true", help="a few hundred iterations")
    parser.add_argument(
        "--config",
        type=Path,
        default=CONFIG,
        metavar="YML",
        help=f"what to fit (default: {CONFIG})",
    )
    parser.add_argument(
        "--only", type=int, nargs="+", metavar="K", choices=range(1, len(CHOICES) + 1),
        help="; ".join(f"{k}: {choice.name}" for k, choice in enumerate(CHOICES, 1)),
    )  # fmt: skip

    parser.add_argument(
        "--times",
        action="store_true",
        help=f"instead of the curves, fits for {', '.join(TIMES)}: what plans make of them",
    )


def run(args: argparse.Namespace) -> None:
    """Fit what is not finished; table, CSV and plot of all that is."""
    out = args.out / "training"
    if args.times:
        run_times(args.config, QUICK_TIMES if args.quick else TIMES, out)
    else:
        run_curves(args, out)


def run_curves(args: argparse.Namespace, out: Path) -> None:
    """One fit for each choice and number of iterations."""
    budgets = QUICK_BUDGETS if args.quick else BUDGETS
    numbers = args.only or range(1, len(CHOICES) + 1)
    for iterations in budgets:
        for choice in (CHOICES[k - 1] for k in numbers):
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                pool.submit(fit_point, args.config, choice.name, iterations, out).result()
    second = seconds_at_start(args.config, out)
    points = [
        point_of(choice, iterations, out, second)
        for choice in CHOICES
        for iterations in budgets
        if (folder_of(choice, iterations, out) / METRICS).exists()
    ]
    print(f"\n{machine()}\n\n{table(points)}")
    rows = [list(vars(point).values()) for point in points]
    write_csv(out / "training.csv", list(Point.__dataclass_fields__), rows)
    write_figure(out / "training.png", plot(points))
    print(f"\nwritten: {out / 'training.csv'}, {out / 'training.png'}")


def run_times(config: Path, times: Sequence[str], out: Path) -> None:
    """One planned fit for each time; a table of those that are finished."""
    rows = []
    for duration in times:
        folder = out / "times" / duration
        seconds = folder.with_suffix(".s")
        if not seconds.exists():
            folder.parent.mkdir(parents=True, exist_ok=True)
            arguments = [str(config), "--out", str(folder), "--budget", duration, "--overwrite"]
            command = [sys.executable, "-m", "drgs.fit", *arguments]
            start = time.perf_counter()
            subprocess.run(command, check=True)
            seconds.write_text(f"{time.perf_counter() - start:.1f}")
        metrics = json.loads((folder / METRICS).read_text())
        rows.append(
            [
                duration,
                f"{float(seconds.read_text()):.1f} s",
                f"{metrics['iterations']:,}",
                f"{metrics['num_gaussians']:,}",
                f"{metrics['test']['psnr']:.2f} dB",
            ]
        )
    header = ["--budget", "took", "iterations", "Gaussians", "PSNR"]
    print(f"\n{machine()}\n\n{markdown_table(header, rows)}")


def folder_of(choice: Choice, iterations: int, out: Path) -> Path:
    """Where a fit is written."""
    return out / choice.name.replace(",", "").replace(" ", "_") / str(iterations)


def fit_point(config: Path, name: str, iterations: int, out: Path) -> None:
    """Run, or go on with, one fit: the configuration's schedule in proportion, then the choice.

    name: of a choice; functions do not travel to another process.
    """
    choice = next(choice for choice in CHOICES if choice.name == name)
    folder = folder_of(choice, iterations, out)
    file = folder.with_suffix(".yml")
    file.parent.mkdir(parents=True, exist_ok=True)
    shipped = load_config(config)
    shipped = completed(shipped, load_dataset(shipped.data_for_training))
    dump_config(choice.change(with_iterations(shipped, iterations)), file)
    print(f"\n{choice.name}, {iterations} iterations", flush=True)
    fit.main([str(file), "--out", str(folder)])


def seconds_at_start(config: Path, out: Path) -> float:
    """Seconds of an iteration at the start of a fit as shipped, as plans time them; kept."""
    path = out / "start.json"
    if not path.exists():
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            path.write_text(json.dumps(pool.submit(rehearsed, config).result()))
    return statistics.median(json.loads(path.read_text()))


def rehearsed(path: Path) -> list[float]:
    """Seconds of an iteration in each of some rehearsals."""
    mi.set_variant("llvm_ad_rgb")
    config = load_config(path)
    dataset = load_dataset(config.data_for_training)
    gaussians = initial_gaussians(config, dataset)
    config = completed(config, dataset)
    seconds = (rehearse(config, dataset, gaussians).iteration_s for _ in range(REHEARSALS))
    return [round(second, 5) for second in seconds]


def point_of(choice: Choice, iterations: int, out: Path, start_s: float) -> Point:
    """What a finished fit reached."""
    metrics = json.loads((folder_of(choice, iterations, out) / METRICS).read_text())
    return Point(
        choice=choice.name,
        iterations=iterations,
        start_s=start_s,
        wall_s=metrics["wall_s"],
        psnr=metrics["test"]["psnr"],
        ssim=metrics["test"]["ssim"],
        gaussians=metrics["num_gaussians"],
    )


def table(points: Sequence[Point]) -> str:
    """A row for each choice, a column for each number of iterations."""
    budgets = sorted({point.iterations for point in points})
    header = ["time and PSNR", *(f"{n:,} iterations" for n in budgets)]
    rows = []
    for name in dict.fromkeys(point.choice for point in points):
        reached = {
            p.iterations: f"{p.wall_s:.0f} s, {p.psnr:.2f} dB" for p in points if p.choice == name
        }
        rows.append([name, *(reached.get(n, "") for n in budgets)])
    return markdown_table(header, rows)


def plot(points: Sequence[Point]) -> Figure:
    """PSNR over time, one curve a choice."""
    figure = new_figure(9, 5)
    axes = figure.subplots()
    for k, name in enumerate(dict.fromkeys(point.choice for point in points)):
        curve = sorted((p.wall_s, p.psnr) for p in points if p.choice == name)
        style = "o-" if k == 0 else "o--"
        axes.plot(
            *zip(*curve, strict=True), style, markersize=4, linewidth=2 if k == 0 else 1, label=name
        )
    axes.set(xscale="log", xlabel="s", ylabel="PSNR on the test views, dB")
    axes.grid(alpha=0.3)
    if points:
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1))
    return figure
