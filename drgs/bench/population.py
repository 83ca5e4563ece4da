"""``python -m drgs.bench population``: how many Gaussians the reference recipe keeps, and why.

The recipe of the 3DGS paper (``scenes/lego_paper.yml``, 30,000 iterations) at three sizes of the
pictures, and at the smallest with one of its rules changed at a time, as people do who write it
again: what survives, and what it is worth. Each fit is a run of ``drgs.fit`` in a process and a
folder of its own. Interrupted fits go on, finished ones are not repeated.

At 200 and 400 px the pictures are those of NeRF-synthetic's Lego (which is distributed at 800;
smaller pictures are area averages), at 800 px those of the shipped generator.
"""

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

import drjit as dr
import numpy as np
from scipy.special import expit

from drgs import fit
from drgs.bench.output import add_out, markdown_table, write_csv
from drgs.capture import __main__ as capture
from drgs.cli.commands import CommandParser
from drgs.config.load import load_config
from drgs.config.schema import DensifyConfig, FitConfig
from drgs.core.arrays import from_host
from drgs.datasets import load_dataset
from drgs.io.figures import new_figure, write_figure
from drgs.results.files import HISTORY, METRICS
from drgs.training.density import adc
from drgs.training.density.strategy import DensityReport, Population

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCENES = Path(__file__).parents[2] / "scenes"
CONFIG = SCENES / "lego_paper.yml"
GENERATOR = SCENES / "brick_crane.py"

ITERATIONS = 30_000
"""Of the recipe."""

SMALL, MEDIUM, LARGE = 200, 400, 800
"""px, width and height of the pictures."""

LARGE_SPP = 64
"""Paths per pixel of the generated pictures: as many a picture as the shipped ones at 400 px."""


@dataclass(frozen=True)
class Case:
    """One fit of the study."""

    name: str
    size: int  # px
    generated: bool = False  # pictures of the shipped generator instead of NeRF-synthetic's Lego
    overrides: Callable[[FitConfig, float], dict[str, object]] = lambda config, extent: {}
    rules: Callable[[], object] = nullcontext  # a context in which the fit runs


@dataclass(frozen=True)
class Outcome:
    """What a finished fit left."""

    case: str
    size: int  # px
    peak: int  # largest number of Gaussians
    after_reset: int  # smallest number before iteration 3000
    gaussians: int  # at the end
    psnr: float  # dB, test views
    ssim: float
    wall_s: float
    threads: int


# ----------------------------------------------------------------------------------------------
# What is changed
# ----------------------------------------------------------------------------------------------


@contextmanager
def _prune_added_rows_at_once() -> Iterator[None]:
    """The prune of a step also meets what the step has added, as in the reference's code."""

    def densify_and_prune(
        rows: Population, statistics: adc.DensityStatistics, config: DensifyConfig, iteration: int
    ) -> DensityReport:
        report = original(rows, statistics, config, iteration)
        opacities = expit(rows.host("logit_opacities"))
        scales = np.exp(rows.host("log_scales")).max(axis=1)
        limit = (
            config.adc.prune_scale * rows.extent if adc.prunes_large(config, iteration) else np.inf
        )
        keep = np.flatnonzero((opacities >= config.adc.prune_opacity) & (scales <= limit))
        if len(keep) == report.num_gaussians:
            return report
        rows.edit(from_host(dr.uint32_array_t(type(statistics.views)), keep))
        pruned = report.pruned + report.num_gaussians - len(keep)
        return replace(report, pruned=pruned, num_gaussians=len(keep))

    original = adc.densify_and_prune
    with patch.object(adc, "densify_and_prune", densify_and_prune):
        yield


@contextmanager
def _reset_until_the_end() -> Iterator[None]:
    """Opacities go on being lowered when the population no longer changes.

    But not in the last iteration, which would leave nothing to see.
    """

    def should_reset(config: DensifyConfig, iteration: int, white_background: bool) -> bool:
        if config.stop <= iteration < ITERATIONS:
            return iteration % config.adc.reset_every == 0
        return original(config, iteration, white_background)

    original = adc.should_reset
    with patch.object(adc, "should_reset", should_reset):
        yield


def _unscaled_means_rate(config: FitConfig, extent: float) -> dict[str, object]:
    rates = config.optimizer
    return {
        "optimizer.means_lr": rates.means_lr / extent,
        "optimizer.means_lr_final": rates.means_lr_final / extent,
    }


def _threshold_in_pixels(config: FitConfig, extent: float) -> dict[str, object]:
    # A gradient per pixel is one in NDC divided by half the film's size.
    return {"densify.adc.grad_threshold": config.densify.adc.grad_threshold * SMALL / 2}


CASES = (
    Case("the recipe, 200 px", SMALL),
    Case("the recipe, 400 px", MEDIUM),
    Case("the recipe, 800 px", LARGE, generated=True),
    Case("means' rate not scaled by the extent", SMALL, overrides=_unscaled_means_rate),
    Case(
        "no reset for white backgrounds",
        SMALL,
        overrides=lambda config, extent: {"densify.adc.white_background_reset": "null"},
    ),
    Case("gradient threshold in pixels", SMALL, overrides=_threshold_in_pixels),
    Case("just added rows pruned at once", SMALL, rules=_prune_added_rows_at_once),
    Case("opacity resets until the end", SMALL, rules=_reset_until_the_end),
)


# ----------------------------------------------------------------------------------------------
# The command
# ----------------------------------------------------------------------------------------------


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s --only 1 2 --iterations 7000")
    add_out(parser, run, "population/population.csv", "population/population.png")
    parser.add_argument(
        "--data", type=Path, metavar="DIR", help=f"NeRF-synthetic's Lego (default: as in {CONFIG})"
    )
    parser.add_argument(
        "--only", type=int, nargs="+", metavar="K", choices=range(1, len(CASES) + 1),
        help="; ".join(f"{k}: {case.name}" for k, case in enumerate(CASES, 1)),
    )  # fmt: skip
    parser.add_argument("--threads", type=int, metavar="N", help="(default: one a core)")
    parser.add_argument("--iterations", type=int, metavar="N", help="(default: 30,000)")


def run(args: argparse.Namespace) -> None:
    """Fit what is asked for and not finished; table, CSV and plot of all that is."""
    out = args.out / "population"
    numbers = args.only or range(1, len(CASES) + 1)
    for number in numbers:
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            pool.submit(fit_case, number, out, args.data, args.threads, args.iterations).result()
    folders = {case.name: out / str(k) for k, case in enumerate(CASES, 1)}
    found = [
        outcome(case, folders[case.name])
        for case in CASES
        if (folders[case.name] / METRICS).exists()
    ]
    print(f"\n{_table(found)}")
    rows = [list(vars(outcome).values()) for outcome in found]
    write_csv(out / "population.csv", list(Outcome.__dataclass_fields__), rows)
    write_figure(out / "population.png", plot({o.case: folders[o.case] for o in found}))
    print(f"\nwritten: {out / 'population.csv'}, {out / 'population.png'}")


def fit_case(
    number: int, out: Path, data: Path | None, threads: int | None, iterations: int | None
) -> None:
    """Run, or go on with, the fit of case ``number``, counted from 1; once finished, do nothing."""
    case = CASES[number - 1]
    if case.generated:
        data = generate(out / f"pictures_{case.size}", case.size)
    values: dict[str, object] = {"data.image_size": case.size}
    if data is not None:
        values["data.path"] = data.resolve()
    if iterations is not None:
        values["iterations"] = iterations
    config = load_config(CONFIG, _assignments(values))
    values.update(case.overrides(config, load_dataset(config.data).extent))
    arguments = [str(CONFIG), "--out", str(out / str(number))]
    for assignment in _assignments(values):
        arguments += ["--set", assignment]
    if threads is not None:
        arguments += ["--threads", str(threads)]
    print(f"\n{number}: {case.name}", flush=True)
    with case.rules():
        fit.main(arguments)


def _assignments(values: dict[str, object]) -> list[str]:
    return [f"{key}={value}" for key, value in values.items()]


def generate(folder: Path, size: int) -> Path:
    """Path trace the shipped scene at ``size`` px; what is there already is kept."""
    settings = ["--size", str(size), str(size), "--spp", str(LARGE_SPP), "--out", str(folder)]
    if not (folder / "transforms_train.json").exists():
        capture.main([str(GENERATOR), *settings])
    return folder


def outcome(case: Case, folder: Path) -> Outcome:
    """What the finished fit in ``folder`` left."""
    metrics = json.loads((folder / METRICS).read_text())
    iterations, population = read_population(folder)
    rules = DensifyConfig.model_validate(metrics["config"]["densify"])
    early = population[iterations <= rules.adc.reset_every]
    return Outcome(
        case=case.name,
        size=case.size,
        peak=int(population.max()),
        after_reset=int(early.min()),
        gaussians=metrics["num_gaussians"],
        psnr=metrics["test"]["psnr"],
        ssim=metrics["test"]["ssim"],
        wall_s=metrics["wall_s"],
        threads=metrics["threads"],
    )


def read_population(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Iterations and numbers of Gaussians from a fit's ``history.csv``."""
    with (folder / HISTORY).open() as file:
        rows = [(int(row["iteration"]), int(row["num_gaussians"])) for row in csv.DictReader(file)]
    iterations, population = np.array(rows).T
    return iterations, population


def _table(found: list[Outcome]) -> str:
    header = ["reference recipe", "fewest before 3,000", "most", "at the end", "PSNR", "SSIM"]
    rows = [
        [
            o.case,
            f"{o.after_reset:,}",
            f"{o.peak:,}",
            f"{o.gaussians:,}",
            f"{o.psnr:.2f} dB",
            f"{o.ssim:.4f}",
        ]
        for o in found
    ]
    return markdown_table(header, rows)


def plot(folders: dict[str, Path]) -> Figure:
    """Population over the iterations, one curve a fit."""
    figure = new_figure(8, 5)
    panel = figure.subplots()
    for name, folder in folders.items():
        panel.semilogy(*read_population(folder), label=name)
    panel.set(xlabel="iteration", ylabel="Gaussians")
    panel.grid(alpha=0.3)
    if folders:
        panel.legend(fontsize=8)
    return figure
