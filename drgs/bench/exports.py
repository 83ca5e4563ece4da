"""``python -m drgs.bench exports RUN``: size of each file format, and what a round trip costs.

The Gaussians of a fit that are meant for other programs are written in each format of
``drgs.io.formats`` and read again. The test views are rendered as such programs do, and compared
with the photographs and with the pictures before.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import mitsuba as mi
import numpy as np

from drgs.bench.output import add_out, machine, markdown_table, write_csv
from drgs.cli.commands import CommandParser
from drgs.config.load import load_config
from drgs.config.schema import ModelConfig
from drgs.core.environment import VARIANTS
from drgs.core.errors import UserError
from drgs.core.registry import Extension
from drgs.datasets import Dataset, load_dataset
from drgs.export import load_source
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.io.formats import readable_formats
from drgs.results import metrics
from drgs.results.files import CONFIG


@dataclass(frozen=True)
class Measurement:
    """Of one format."""

    format: str
    num_gaussians: int
    megabytes: float
    psnr: float  # dB, against the photographs
    psnr_lost: float  # dB
    psnr_against_before: float  # dB, against the pictures before; infinite where they are equal
    seconds_to_write: float
    seconds_to_read: float


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s out/lego")
    add_out(parser, run, "exports.csv")
    parser.add_argument(
        "folder",
        nargs="?",
        type=Path,
        default=Path("out/lego"),
        metavar="RUN",
        help="a fit's output folder (default: out/lego)",
    )


def run(args: argparse.Namespace) -> None:
    """Measure; write table and CSV."""
    folder = args.folder
    if not folder.is_dir():
        raise UserError(f"{folder}: must be the output folder of a fit that has ended")
    mi.set_variant(VARIANTS[0])
    print(machine())
    found = measure(folder)
    print(f"\n{table(found)}")
    columns = list(Measurement.__dataclass_fields__)
    write_csv(args.out / "exports.csv", columns, [list(vars(m).values()) for m in found])
    print(f"\nwritten: {args.out / 'exports.csv'}")


def measure(folder: Path) -> list[Measurement]:
    """Measure all formats that can be read; folder: of a fit."""
    gaussians = replace(load_source(folder).gaussians, rendered_with=None)
    config = load_config(folder / CONFIG)
    dataset = load_dataset(config.data)
    model = ModelConfig(near=config.model.near).of_file()
    before = pictures(gaussians, dataset, model)
    quality = _psnr(before, dataset)
    found = []
    for each in readable_formats():
        read, *numbers = round_trip(gaussians, each)
        after = pictures(read, dataset, model)
        psnr, moved = _psnr(after, dataset), float(np.mean(list(map(metrics.psnr, after, before))))
        size, *seconds = numbers
        found.append(
            Measurement(
                each.name, len(read.means), size / 1e6, psnr, quality - psnr, moved, *seconds
            )
        )
        print(f"{each.name}: {size / 1e6:.2f} MB, {psnr:.2f} dB", flush=True)
    return found


def round_trip(gaussians: Gaussians, each: Extension) -> tuple[Gaussians, int, float, float]:
    """What is read, the bytes of the file, and the seconds of writing and reading."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"model{each.value.suffix}"
        start = time.perf_counter()
        path.write_bytes(gaussians.to_bytes(each.name))
        written = time.perf_counter()
        read = Gaussians.load(path)
        return read, path.stat().st_size, written - start, time.perf_counter() - written


def pictures(gaussians: Gaussians, dataset: Dataset, model: ModelConfig) -> list[np.ndarray]:
    """Of the test views, (H, W, 3) display space each."""
    return list(render_views(make_scene(gaussians, model, dataset.background), dataset.test))


def _psnr(images: Sequence[np.ndarray], dataset: Dataset) -> float:
    """Mean over the test views, dB."""
    pairs = zip(images, dataset.test, strict=True)
    return float(np.mean([metrics.psnr(image, v.image, v.mask) for image, v in pairs]))


def table(found: Sequence[Measurement]) -> str:
    """A row for each format."""
    whole = next(m.megabytes for m in found if m.format == "ply")
    header = ["format", "MB", "of PLY", "PSNR [dB]", "lost [dB]", "against before [dB]"]
    header += ["write, read [s]"]
    rows = [
        [
            f"`{m.format}`",
            f"{m.megabytes:.2f}",
            f"{m.megabytes / whole:.0%}",
            f"{m.psnr:.2f}",
            f"{m.psnr_lost:.2f}",
            f"{m.psnr_against_before:.1f}" if np.isfinite(m.psnr_against_before) else "equal",
            f"{m.seconds_to_write:.2f}, {m.seconds_to_read:.2f}",
        ]
        for m in found
    ]
    return markdown_table(header, rows)
