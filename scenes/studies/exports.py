"""Measure the size of each file format, the quality that its viewers show, and what rounding loses.

The Gaussians that ``drgs export`` would choose for each format of ``drgs.io.formats`` are written
and read again. The test views are rendered as the viewers of the format do (``shown_with``), before
and after, and compared with the photographs. Then the fit's small file (``output.small_file``) is
made with palettes of several sizes, and without rounding, which is what they are compared with.

Results: ``exports.md``; ``exports.csv`` in the columns of the survey 3DGS.zip (Bagdasarian et al.
2024), whose LPIPS is empty; and the figure ``exports.png``.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import drgs  # noqa: F401  (registers the integrator)
import mitsuba as mi
import numpy as np
from drgs.bench.output import machine, markdown_table
from drgs.config.changes import with_changes
from drgs.config.load import load_config
from drgs.config.schema import ModelConfig
from drgs.core.registry import Extension
from drgs.datasets import Dataset, load_dataset
from drgs.export.__main__ import targets
from drgs.export.source import load_source
from drgs.fit.viewers_fit import fit_small_file
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.io import sog
from drgs.io.figures import new_figure, write_figure
from drgs.io.formats import FORMATS
from drgs.results import metrics
from drgs.results.folder import CONFIG, own_gaussians
from drgs.training.trainer import Trainer

COLUMNS = ("Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians")

TICKS = (15, 20, 30, 40, 60, 100, 250)

SMALL = "-sog"  # before the share of entries of a palette

SHARES = (1 / 100, 1 / 24, 1 / 12, 1 / 8, 1 / 6, 1 / 4, 1 / 2)


def round_trip(gaussians: Gaussians, each: Extension) -> tuple[Gaussians, int, float, float]:
    """Return what is read, the bytes of the file, and the seconds of writing and reading."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"model{each.value.suffix}"
        start = time.perf_counter()
        path.write_bytes(gaussians.to_bytes(each.name))
        written = time.perf_counter()
        read = Gaussians.load(path)
        return read, path.stat().st_size, written - start, time.perf_counter() - written


def quality_of(images: Sequence[np.ndarray], dataset: Dataset) -> metrics.Quality:
    """Return the mean quality of the test views."""
    pairs = zip(images, dataset.test, strict=True)
    return metrics.mean_quality((image, v.image, v.mask) for image, v in pairs)


def write_results(rows: list[list[str | float]], folder: Path) -> None:
    """Write the table of the survey, and the figure; rows: of COLUMNS."""
    with (folder / "exports.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])
    figure = new_figure(7, 4)
    axes = figure.subplots()
    points = {str(row[0]): (float(row[4]) / float(row[5]), float(row[1])) for row in rows}
    small = sorted(point for name, point in points.items() if name.startswith(SMALL))
    axes.plot(*zip(*small, strict=True), "o-", label="small file, by the size of its palette")
    for name, point in points.items():
        if not name.startswith(SMALL):
            axes.plot(*point, "x", color="black")
            above = {"ply": 16, "usd": 28}.get(name, 4)  # beside glb
            axes.annotate(name, point, (-8, above), textcoords="offset points")
    axes.set_xscale("log")
    axes.set_xticks(TICKS, map(str, TICKS))
    axes.minorticks_off()
    axes.set_xlabel("bytes per Gaussian")
    axes.set_ylabel("PSNR of the test views, as viewers show them [dB]")
    axes.legend()
    write_figure(folder / "exports.png", figure)


def main() -> None:
    """Measure all formats."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FIT_DIR", help="a finished fit")
    folder = parser.parse_args().folder
    mi.set_variant("llvm_ad_rgb")
    config = with_changes(load_config(folder / CONFIG), {"output.small_file": "sog"})
    dataset = load_dataset(config.data)
    own = Gaussians.load(own_gaussians(folder))
    rows, table = [], []

    def render(gaussians: Gaussians, each: Extension) -> list[np.ndarray]:
        model = ModelConfig(near=config.model.near).with_3dgs_defaults()
        model = model.model_copy(update=dict(each.value.shown_with))
        return list(render_views(make_scene(gaussians, model, dataset.background), dataset.test))

    def measure(name: str, each: Extension, shown: Gaussians, before: list[np.ndarray]) -> None:
        read, size, writing, reading = round_trip(shown, each)
        after, num = render(read, each), shown.num_gaussians
        found, lost = quality_of(after, dataset), quality_of(before, dataset).psnr
        change = float(np.mean(list(map(metrics.psnr, after, before))))
        rows.append([name, round(found.psnr, 4), round(found.ssim, 5), "", size, num])
        table.append(
            [
                f"`{name}`",
                f"{size / 1e6:.2f}",
                f"{size / num:.1f}",
                f"{found.psnr:.2f}",
                f"{lost - found.psnr:.2f}",
                f"{change:.1f}" if np.isfinite(change) else "equal",
                f"{writing:.2f}, {reading:.2f}",
            ]
        )

    for name, target in targets().items():
        if name in FORMATS:
            shown = replace(load_source(folder, target.honoured).gaussians, rendered_with=None)
            measure(name, FORMATS.get(name), shown, render(shown, FORMATS.get(name)))

    def fitted() -> Gaussians:
        trainer = Trainer(config, dataset, own)
        trainer.iteration = config.last_iteration
        return fit_small_file(trainer, own).gaussians

    each = FORMATS.get("sog")
    rounding, each.value.rounding = each.value.rounding, lambda *_: lambda arrays: arrays
    before = render(fitted(), each)
    each.value.rounding = rounding
    for share in SHARES:
        sog.FITTED_SHARE = share
        measure(f"{SMALL}{share:.3f}", each, fitted(), before)
    header = ["format", "MB", "bytes per Gaussian", "PSNR [dB]", "lost [dB]", "against before [dB]"]
    print(f"{machine()}\n\n{markdown_table([*header, 'write, read [s]'], table)}")
    write_results(rows, Path(__file__).parent)


if __name__ == "__main__":
    main()
