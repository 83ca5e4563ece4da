"""Fit the shipped scene at 200x200 with other lengths and settings; takes 20 minutes.

``scenes/lego_mini.yml`` is fitted with different numbers of iterations, and with one other choice
at a time: smaller images first, fewer Gaussians, spherical harmonics of a lower degree, no SSIM.
Each choice is a curve of the quality on the test views over the time that the fit took;
``drgs/fit/training_curves.csv`` has the curves from which ``drgs fit --budget`` plans.

``--times`` shows what plans make of these curves: a fit for each of several times, from the start
of the command to its end. Results: ``training.md``.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import drgs  # noqa: F401  (registers the integrator)
import mitsuba as mi
from drgs.bench.output import machine, markdown_table, write_rows
from drgs.config.changes import with_changes, with_iterations
from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.datasets import load_dataset
from drgs.fit.budget import STRATEGIES, Strategy, rehearse
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.start import initial_gaussians
from fits import SCENES, add_case_option, fit, fit_words, make_parser, write_curves

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CONFIG = SCENES / "lego_mini.yml"

NUM_ITERATIONS = (250, 750, 2000, 5000)

TIMES = ("10s", "30s", "1m", "2m", "5m")
"""Budgets for the whole command."""

REHEARSALS = 3

CHOICES: dict[str, Strategy | dict[str, object]] = {
    **{strategy.name: strategy for strategy in STRATEGIES},
    "SH of degree 1": {"model.sh_degree": 1},
    "no SSIM": {"loss.dssim_weight": 0.0},
}
"""Changes of the shipped configuration, by name."""


@dataclass(frozen=True)
class Point:
    """A finished fit: a row of the curves."""

    choice: str
    iterations: int
    start_s: float  # of an iteration at the start, as shipped
    wall_s: float  # of all iterations
    psnr: float  # dB, test views
    ssim: float
    gaussians: int


def fit_curves(out: Path, only: list[int], threads: int | None) -> None:
    """Fit each choice with each number of iterations; write table, CSV and plot."""
    shipped = load_config(CONFIG)
    shipped = resolve_defaults(shipped, load_dataset(shipped.data_for_training))
    start_s, points = seconds_at_start(), []
    for iterations in NUM_ITERATIONS:
        config = with_iterations(shipped, iterations)
        for name in (list(CHOICES)[k - 1] for k in only):
            folder = out / name.replace(",", "").replace(" ", "_") / str(iterations)
            metrics = fit(apply(CHOICES[name], config), folder, threads)
            test, gaussians = metrics["test"], metrics["num_gaussians"]
            quality = test["psnr"], test["ssim"], gaussians
            points.append(Point(name, iterations, start_s, metrics["wall_s"], *quality))
    print(f"\n{machine()}\n\n{table(points)}")
    write_rows(out / "training_curves.csv", Point, points)

    def draw(axes: Axes) -> None:
        for name in dict.fromkeys(point.choice for point in points):
            curve = sorted((p.wall_s, p.psnr) for p in points if p.choice == name)
            axes.semilogx(*zip(*curve, strict=True), "o-", markersize=4, label=name)

    write_curves(out / "training.png", "s", "PSNR on the test views, dB", draw)


def apply(choice: Strategy | dict[str, object], config: FitConfig) -> FitConfig:
    """Return a configuration with a choice."""
    if isinstance(choice, Strategy):
        return choice.apply(config, config.init.num_points)
    return with_changes(config, choice)


def seconds_at_start() -> float:
    """Time an iteration at the start of a fit as shipped, as plans do."""
    mi.set_variant("llvm_ad_rgb")
    config = load_config(CONFIG)
    dataset = load_dataset(config.data_for_training)
    gaussians = initial_gaussians(config, dataset)
    config = resolve_defaults(config, dataset)
    rehearsals = [rehearse(config, dataset, gaussians)[1] for _ in range(REHEARSALS)]
    return round(statistics.median(rehearsals), 5)


def table(points: list[Point]) -> str:
    """Format a row for each choice, a column for each number of iterations."""
    rows = []
    for name in dict.fromkeys(point.choice for point in points):
        found = [p for p in points if p.choice == name]
        rows.append([name, *(f"{p.wall_s:.0f} s, {p.psnr:.2f} dB" for p in found)])
    return markdown_table(["", *(f"{n:,} iterations" for n in NUM_ITERATIONS)], rows)


def fit_times(out: Path, threads: int | None) -> None:
    """Fit with each budget; print a table."""
    rows = []
    for duration in TIMES:
        started = time.perf_counter()
        words = [str(CONFIG), "--budget", duration, "--overwrite"]
        metrics = fit_words(words, out / "times" / duration, threads)
        took = f"{time.perf_counter() - started:.1f} s"
        counts = f"{metrics['iterations']:,}", f"{metrics['num_gaussians']:,}"
        rows.append([duration, took, *counts, f"{metrics['test']['psnr']:.2f} dB"])
    header = ["--budget", "took", "iterations", "Gaussians", "PSNR"]
    print(f"\n{machine()}\n\n{markdown_table(header, rows)}")


def main() -> None:
    """Fit curves or budgets."""
    parser = make_parser(__doc__, "training")
    parser.add_argument("--times", action="store_true", help=f"fits for {', '.join(TIMES)}")
    add_case_option(parser, list(CHOICES))
    args = parser.parse_args()
    if args.times:
        fit_times(args.out, args.threads)
    else:
        fit_curves(args.out, args.only, args.threads)


if __name__ == "__main__":
    main()
