"""``python -m drgs.fit CONFIG.yml``: fit Gaussians to photographs.

Layer 5. Reads the configuration and the dataset, runs :class:`drgs.trainer.Trainer`, measures the
result on the test views and writes the output folder:

- ``point_cloud.ply``: the Gaussians, in the layout of the 3DGS reference implementation
- ``metrics.json``: quality on the test views, time, population, versions
- ``history.csv``: loss, PSNR, population and rate over the iterations
- ``renders/<split>/*.png``: the test views as fitted
- ``config.yml``: every value that the fit used
"""

from __future__ import annotations

import argparse
import csv
import json
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import imageio.v3 as iio
import mitsuba as mi
import numpy as np

import drgs
from drgs.checks import exit_on_user_error
from drgs.config import FitConfig, dump_config, load_config
from drgs.data import Dataset, initial_gaussians, load_dataset
from drgs.files import atomic_path
from drgs.io.ply import write_ply
from drgs.metrics import Quality, mean_quality
from drgs.progress import FitProgress
from drgs.trainer import StepReport, Trainer, render_views

SMOOTHING = 0.9
"""Weight of the past in the PSNR that the progress line shows."""


@dataclass(frozen=True)
class HistoryRow:
    """One line of ``history.csv``."""

    iteration: int
    loss: float
    psnr: float  # dB, of the iteration's training view
    num_gaussians: int
    means_lr: float
    wall_s: float  # since the first iteration


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the command."""
    args = _parse(arguments)
    with exit_on_user_error():
        config = load_config(args.config, args.overrides + _shorthands(args))
        dataset = load_dataset(config.data)
        out = config.output.dir or Path("out") / Path(args.config).stem
        mi.set_variant(args.variant)
        print(f"{args.config}: {dataset.description}")
        print(
            f"{len(dataset.train)} views to train on, {len(dataset.test)} of split "
            f"'{dataset.test_split}' to measure on; background {config.data.background}"
        )
        run(config, dataset, out)


def run(config: FitConfig, dataset: Dataset, out: Path) -> Quality:
    """Fit, measure, and write the output folder ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    dump_config(config, out / "config.yml")
    trainer = Trainer(config, dataset, initial_gaussians(config, dataset))
    started = time.perf_counter()
    history = train(trainer, config, started)
    wall_s = time.perf_counter() - started

    gaussians = trainer.gaussians()
    write_ply(out / "point_cloud.ply", gaussians)
    write_history(out / "history.csv", history)
    images = list(render_views(trainer.scene, dataset.test))
    quality = mean_quality(
        (image, view.image) for image, view in zip(images, dataset.test, strict=True)
    )
    if config.output.save_renders:
        write_renders(out / "renders" / dataset.test_split, dataset, images)
    write_metrics(out / "metrics.json", config, dataset, gaussians.num_gaussians, wall_s, quality)
    print(
        f"{quality.num_views} {dataset.test_split} views: PSNR {quality.psnr:.2f} dB, "
        f"SSIM {quality.ssim:.4f}; {gaussians.num_gaussians:,} Gaussians; "
        f"{config.iterations} iterations in {wall_s:.0f} s"
    )
    print(f"written: {out}")
    return quality


def train(trainer: Trainer, config: FitConfig, started: float) -> list[HistoryRow]:
    """Run all iterations, showing progress; returns the history."""
    history: list[HistoryRow] = []
    smooth_psnr = None
    with FitProgress(config.iterations) as progress:
        for _ in range(config.iterations):
            report = trainer.step()
            if report.iteration % config.output.history_every and (
                report.iteration != config.iterations
            ):
                continue
            row = _history_row(report, time.perf_counter() - started)
            history.append(row)
            smooth_psnr = row.psnr if smooth_psnr is None else smooth_psnr
            smooth_psnr = SMOOTHING * smooth_psnr + (1 - SMOOTHING) * row.psnr
            progress.update(row.iteration, row.loss, smooth_psnr, row.num_gaussians)
    return history


def write_history(path: Path, history: list[HistoryRow]) -> None:
    """Write ``history.csv``."""
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(HistoryRow.__dataclass_fields__)
        for row in history:
            writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in vars(row).values()])


def write_renders(folder: Path, dataset: Dataset, images: list[np.ndarray]) -> None:
    """Write one 8-bit PNG per test view."""
    for view, image in zip(dataset.test, images, strict=True):
        with atomic_path(folder / f"{view.name}.png") as temporary:
            iio.imwrite(temporary, np.round(image * 255).astype(np.uint8))


def write_metrics(
    path: Path,
    config: FitConfig,
    dataset: Dataset,
    num_gaussians: int,
    wall_s: float,
    quality: Quality,
) -> None:
    """Write ``metrics.json``."""
    metrics: dict[str, Any] = {
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
            "llvm": ".".join(map(str, dr.detail.llvm_version())),
        },
        "variant": mi.variant(),
        "threads": dr.thread_count(),
        "config": config.model_dump(mode="json"),
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(metrics, indent=2) + "\n")


def _history_row(report: StepReport, wall_s: float) -> HistoryRow:
    return HistoryRow(
        iteration=report.iteration,
        loss=report.loss,
        psnr=report.psnr,
        num_gaussians=report.num_gaussians,
        means_lr=report.means_lr,
        wall_s=wall_s,
    )


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m drgs.fit", description="Fit 3D Gaussians to posed photographs."
    )
    parser.add_argument("config", metavar="CONFIG.yml", help="what to fit, and how")
    parser.add_argument("--data", metavar="DIR", help="dataset folder (data.path)")
    parser.add_argument("--out", metavar="DIR", help="output folder (default: out/NAME)")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="override a value of the configuration, as in densify.every=200; repeatable",
    )
    parser.add_argument(
        "--variant", default="llvm_ad_rgb", help="Mitsuba variant (default: llvm_ad_rgb)"
    )
    return parser.parse_args(arguments)


def _shorthands(args: argparse.Namespace) -> list[str]:
    given = {"data.path": args.data, "output.dir": args.out}
    return [f"{key}={value}" for key, value in given.items() if value is not None]


if __name__ == "__main__":
    main()
