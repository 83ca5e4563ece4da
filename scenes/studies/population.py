"""Count how many Gaussians the reference recipe keeps, and why; takes hours.

The recipe of the 3DGS paper (``scenes/lego_paper.yml``, 30,000 iterations) at three sizes of the
images, and at the smallest with one of its rules changed at a time, as other implementations
have it. Images of 200 and 400 px are NeRF-synthetic's Lego (``--data``), those of 800 px come
from the shipped generator. Results: ``population.md``.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

import numpy as np
from drgs.bench.output import markdown_table
from drgs.capture import __main__ as capture
from drgs.config.load import load_config
from drgs.config.schema import DensifyConfig, FitConfig
from drgs.datasets import load_dataset
from drgs.fit import __main__ as fit
from drgs.results.folder import HISTORY
from drgs.training.density.adc import AdaptiveDensityControl
from drgs.training.density.strategy import DensityReport, Population
from fits import SCENES, add_case_option, make_parser, read_metrics, write_curves
from scipy.special import expit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CONFIG = SCENES / "lego_paper.yml"
GENERATOR = SCENES / "brick_crane.py"

ITERATIONS = 30_000
"""The length of the recipe."""

SMALL, MEDIUM, LARGE = 200, 400, 800
"""px, width and height of the images."""


@contextmanager
def prune_added_rows_immediately() -> Iterator[None]:
    """Apply a step's prune also to rows that the step has added, as in the reference code."""

    def densify_and_prune(
        strategy: AdaptiveDensityControl, rows: Population, iteration: int
    ) -> DensityReport:
        report, rules = original(strategy, rows, iteration), strategy.config.adc
        opacities = expit(rows.host("logit_opacities"))
        scales = np.exp(rows.host("log_scales")).max(axis=1)
        limit = rules.prune_scale * rows.extent if iteration > rules.reset_every else np.inf
        keep = np.flatnonzero((opacities >= rules.prune_opacity) & (scales <= limit))
        if len(keep) == report.num_gaussians:
            return report
        rows.edit(rows.to_device_indices(keep))
        pruned = report.pruned + report.num_gaussians - len(keep)
        return replace(report, pruned=pruned, num_gaussians=len(keep))

    original = AdaptiveDensityControl.densify_and_prune
    with patch.object(AdaptiveDensityControl, "densify_and_prune", densify_and_prune):
        yield


@contextmanager
def reset_until_the_end() -> Iterator[None]:
    """Continue opacity resets after densification, except in the last iteration.

    A reset in the last iteration would leave nothing to see.
    """

    def resets(strategy: AdaptiveDensityControl, iteration: int) -> bool:
        if strategy.config.stop <= iteration < ITERATIONS:
            return iteration % strategy.config.adc.reset_every == 0
        return original(strategy, iteration)

    original = AdaptiveDensityControl.resets
    with patch.object(AdaptiveDensityControl, "resets", resets):
        yield


def unscaled_means_rate(config: FitConfig, extent: float) -> dict[str, object]:
    """Use a rate of the means that is not multiplied by the scene's extent."""
    rates = config.optimizer
    return {
        "optimizer.means_lr": rates.means_lr / extent,
        "optimizer.means_lr_final": rates.means_lr_final / extent,
    }


def threshold_in_pixels(config: FitConfig, extent: float) -> dict[str, object]:
    """Apply the threshold to gradients per pixel: NDC gradients divided by half the film size."""
    return {"densify.adc.grad_threshold": config.densify.adc.grad_threshold * SMALL / 2}


@dataclass(frozen=True)
class Case:
    """One fit of the study."""

    name: str
    size: int = SMALL  # px
    generated: bool = False  # images of the shipped generator
    overrides: Callable[[FitConfig, float], dict[str, object]] = lambda config, extent: {}
    rules: Callable[[], object] = nullcontext  # a context in which the fit runs


CASES = (
    Case("the recipe, 200 px"),
    Case("the recipe, 400 px", MEDIUM),
    Case("the recipe, 800 px", LARGE, generated=True),
    Case("means' rate not scaled by the extent", overrides=unscaled_means_rate),
    Case(
        "no reset for white backgrounds",
        overrides=lambda config, extent: {"densify.adc.white_background_reset": "null"},
    ),
    Case("gradient threshold in pixels", overrides=threshold_in_pixels),
    Case("just added rows pruned at once", rules=prune_added_rows_immediately),
    Case("opacity resets until the end", rules=reset_until_the_end),
)


def fit_case(number: int, args: argparse.Namespace) -> None:
    """Fit case ``number``, counted from 1, in this process."""
    case, data = CASES[number - 1], args.data
    if case.generated:
        data = args.out / f"pictures_{case.size}"
        size = ["--size", str(case.size), str(case.size), "--spp", "64"]
        if not (data / "transforms_train.json").exists():
            capture.main([str(GENERATOR), *size, "--out", str(data)])
    values: dict[str, object] = {"data.image_size": case.size}
    if data is not None:
        values["data.path"] = data.resolve()
    config = load_config(CONFIG, [f"{key}={value}" for key, value in values.items()])
    values |= case.overrides(config, load_dataset(config.data).extent)
    words = [word for key, value in values.items() for word in ("--set", f"{key}={value}")]
    words += ["--threads", str(args.threads)] if args.threads is not None else []
    with case.rules():
        fit.main([str(CONFIG), "--out", str(args.out / str(number)), *words])


def read_population(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return iterations and numbers of Gaussians from a fit's ``history.csv``."""
    with (folder / HISTORY).open() as file:
        rows = [(int(row["iteration"]), int(row["num_gaussians"])) for row in csv.DictReader(file)]
    iterations, population = np.array(rows).T
    return iterations, population


def row_of(case: Case, folder: Path) -> list[str]:
    """Format a finished fit."""
    metrics = read_metrics(folder)
    iterations, population = read_population(folder)
    rules = DensifyConfig.model_validate(metrics["config"]["densify"])
    early = population[iterations <= rules.adc.reset_every]
    test = metrics["test"]
    counts = early.min(), population.max(), metrics["num_gaussians"]
    quality = f"{test['psnr']:.2f} dB", f"{test['ssim']:.4f}"
    return [case.name, *(f"{count:,}" for count in counts), *quality]


def main() -> None:
    """Fit; a table and a plot."""
    parser = make_parser(__doc__, "population")
    parser.add_argument("--data", type=Path, metavar="DIR", help="NeRF-synthetic's Lego")
    parser.add_argument("--case", type=int, help=argparse.SUPPRESS)  # fitted in this process
    add_case_option(parser, [case.name for case in CASES])
    args = parser.parse_args()
    if args.case is not None:
        fit_case(args.case, args)
        return
    folders = {CASES[k - 1]: args.out / str(k) for k in args.only}
    for number in args.only:
        print(f"\n{number}: {CASES[number - 1].name}", flush=True)
        command = [sys.executable, __file__, *sys.argv[1:], "--case", str(number)]
        subprocess.run(command, check=True)
    header = ["reference recipe", "fewest before 3,000", "most", "at the end", "PSNR", "SSIM"]
    rows = [row_of(case, folder) for case, folder in folders.items()]
    print(f"\n{markdown_table(header, rows)}")

    def draw(axes: Axes) -> None:
        for case, folder in folders.items():
            axes.semilogy(*read_population(folder), label=case.name)

    write_curves(args.out / "population.png", "iteration", "Gaussians", draw)


if __name__ == "__main__":
    main()
