"""Measure the size of each file format, and the quality that a round trip loses.

The Gaussians that a fit leaves for other programs are written in each format of ``drgs.io.formats``
and read again. The test views are rendered as such programs do, and compared with the photographs
and with the images before. Then the fit's small file (``output.small_file``) is made with palettes
of several sizes. Results: ``exports.md``; ``exports.csv`` in the columns of the survey 3DGS.zip
(Bagdasarian et al. 2024), whose LPIPS is empty; and the figure ``exports.png``.
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
from drgs.config.load import load_config
from drgs.config.schema import ModelConfig
from drgs.core.registry import Extension
from drgs.datasets import Dataset, load_dataset
from drgs.export.source import load_source
from drgs.fit.viewers_fit import fit_small_file
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.io import sog
from drgs.io.figures import new_figure, write_figure
from drgs.io.formats import FORMATS, writable_formats
from drgs.results import metrics
from drgs.results.folder import CONFIG
from drgs.training.trainer import Trainer

COLUMNS = ("Submethod", "PSNR", "SSIM", "LPIPS", "Size [Bytes]", "#Gaussians")

SHARES = (1 / 100, 1 / 24, 1 / 12, 1 / 8, 1 / 6, 1 / 4, 1 / 2)  # of entries of a palette


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


def write_results(rows: list[tuple[str, metrics.Quality, int, int]], folder: Path) -> None:
    """Write the table of the survey, and the figure."""
    with (folder / "exports.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for name, found, size, num in rows:
            writer.writerow([name, f"{found.psnr:.4f}", f"{found.ssim:.5f}", "", size, num])
    figure = new_figure(7, 4)
    axes = figure.subplots()
    small = [(size / num, found.psnr) for name, found, size, num in rows if name.startswith("-")]
    axes.plot(*zip(*small, strict=True), "o-", label="fitted as SOG rounds, by size of the palette")
    for name, found, size, num in rows:
        if not name.startswith("-") and size / num < 100:
            axes.plot(size / num, found.psnr, "x", color="black")
            axes.annotate(name, (size / num, found.psnr), (4, 4), textcoords="offset points")
    axes.axhline(rows[0][1].psnr, color="grey", linewidth=0.8, label="before")
    axes.set_xlabel("bytes per Gaussian")
    axes.set_ylabel("PSNR of the test views [dB]")
    low = min(psnr for _, psnr in small) - 0.1
    axes.set_ylim(low, rows[0][1].psnr + 0.3)
    axes.legend(loc="lower right")
    write_figure(folder / "exports.png", figure)


def main() -> None:
    """Measure all formats."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FIT_DIR", help="a finished fit")
    folder = parser.parse_args().folder
    mi.set_variant("llvm_ad_rgb")
    gaussians = replace(load_source(folder).gaussians, rendered_with=None)
    config = load_config(folder / CONFIG)
    dataset = load_dataset(config.data)
    model = ModelConfig(near=config.model.near).with_3dgs_defaults()

    def render(model_gaussians: Gaussians) -> list[np.ndarray]:
        scene = make_scene(model_gaussians, model, dataset.background)
        return list(render_views(scene, dataset.test))

    before = render(gaussians)
    quality, rows = quality_of(before, dataset), []
    ply_bytes, num = len(gaussians.to_bytes("ply")), gaussians.num_gaussians
    listed = [("Baseline", quality, ply_bytes, num)]
    fitted = {f"-sog{share:.4f}": share for share in SHARES}
    for name in [*(each.name for each in writable_formats()), *fitted]:
        shown = gaussians
        if name in fitted:
            sog.FITTED_SHARE = fitted[name]
            trainer = Trainer(config, dataset, gaussians)
            trainer.iteration = config.last_iteration
            shown = fit_small_file(trainer, gaussians).gaussians
        each = FORMATS.get("sog" if name in fitted else name)
        read, size, writing, reading = round_trip(shown, each)
        after = render(read)
        found = quality_of(after, dataset)
        change = float(np.mean(list(map(metrics.psnr, after, before))))
        listed.append((name, found, size, num))
        rows.append(
            [
                f"`{name}`",
                f"{size / 1e6:.2f}",
                f"{size / num:.1f}",
                f"{found.psnr:.2f}",
                f"{quality.psnr - found.psnr:.2f}",
                f"{change:.1f}" if np.isfinite(change) else "equal",
                f"{writing:.2f}, {reading:.2f}",
            ]
        )
    header = ["format", "MB", "bytes per Gaussian", "PSNR [dB]", "lost [dB]", "against before [dB]"]
    print(f"{machine()}\n\n{markdown_table([*header, 'write, read [s]'], rows)}")
    write_results(listed, Path(__file__).parent)


if __name__ == "__main__":
    main()
