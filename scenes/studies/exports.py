"""Measure the size of each file format, and the quality that a round trip loses.

The Gaussians that a fit leaves for other programs are written in each format of ``drgs.io.formats``
and read again. The test views are rendered as such programs do, and compared with the photographs
and with the images before. Results: ``exports.md``.
"""

from __future__ import annotations

import argparse
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
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.io.formats import writable_formats
from drgs.results import metrics
from drgs.results.folder import CONFIG


def round_trip(gaussians: Gaussians, each: Extension) -> tuple[Gaussians, int, float, float]:
    """Return what is read, the bytes of the file, and the seconds of writing and reading."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"model{each.value.suffix}"
        start = time.perf_counter()
        path.write_bytes(gaussians.to_bytes(each.name))
        written = time.perf_counter()
        read = Gaussians.load(path)
        return read, path.stat().st_size, written - start, time.perf_counter() - written


def mean_psnr(images: Sequence[np.ndarray], dataset: Dataset) -> float:
    """Return the mean PSNR of the test views, dB."""
    pairs = zip(images, dataset.test, strict=True)
    return float(np.mean([metrics.psnr(image, v.image, v.mask) for image, v in pairs]))


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
    quality, rows = mean_psnr(before, dataset), []
    ply_bytes = len(gaussians.to_bytes("ply"))
    for each in writable_formats():
        read, size, writing, reading = round_trip(gaussians, each)
        after = render(read)
        psnr = mean_psnr(after, dataset)
        change = float(np.mean(list(map(metrics.psnr, after, before))))
        rows.append(
            [
                f"`{each.name}`",
                f"{size / 1e6:.2f}",
                f"{size / ply_bytes:.0%}",
                f"{psnr:.2f}",
                f"{quality - psnr:.2f}",
                f"{change:.1f}" if np.isfinite(change) else "equal",
                f"{writing:.2f}, {reading:.2f}",
            ]
        )
    header = ["format", "MB", "of PLY", "PSNR [dB]", "lost [dB]", "against before [dB]"]
    print(f"{machine()}\n\n{markdown_table([*header, 'write, read [s]'], rows)}")


if __name__ == "__main__":
    main()
