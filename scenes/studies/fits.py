"""Fits of the studies: each is a separate ``drgs fit`` process.

Interrupted fits are resumed, finished ones are not repeated.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drgs.config.load import dump_config
from drgs.config.schema import FitConfig
from drgs.io.figures import new_figure, write_figure
from drgs.results.folder import METRICS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCENES = Path(__file__).resolve().parents[1]
"""The folder of shipped scenes."""


def make_parser(description: str, name: str) -> argparse.ArgumentParser:
    """Return a parser with the options that all studies of fits have."""
    parser = argparse.ArgumentParser(description=description.partition("\n")[0])
    folder = Path("out/studies") / name
    parser.add_argument("--out", type=Path, default=folder, help=f"(default: {folder})")
    parser.add_argument("--threads", type=int, metavar="N", help="(default: one a core)")
    return parser


def add_case_option(parser: argparse.ArgumentParser, names: Sequence[str]) -> None:
    """Add ``--only``, which chooses cases by their numbers."""
    text = "; ".join(f"{k}: {name}" for k, name in enumerate(names, 1)).replace("%", "%%")
    numbers = range(1, len(names) + 1)
    parser.add_argument(
        "--only", type=int, nargs="+", metavar="K", choices=numbers, default=numbers, help=text
    )


def fit(config: FitConfig, folder: Path, threads: int | None = None) -> dict:
    """Fit, and return the metrics."""
    file = folder.with_suffix(".yml")
    file.parent.mkdir(parents=True, exist_ok=True)
    dump_config(config, file)
    return fit_words([str(file)], folder, threads)


def fit_words(words: Sequence[str], folder: Path, threads: int | None = None) -> dict:
    """Run ``drgs fit`` with ``words``, and return the metrics."""
    command = [sys.executable, "-m", "drgs.fit", *words, "--out", str(folder)]
    command += ["--threads", str(threads)] if threads is not None else []
    subprocess.run(command, check=True)
    return read_metrics(folder)


def read_metrics(folder: Path) -> dict:
    """Return the metrics of a finished fit."""
    return json.loads((folder / METRICS).read_text())


def write_curves(path: Path, x_label: str, y_label: str, draw: Callable[[Axes], None]) -> None:
    """Write a plot of one panel with a legend beside it."""
    figure = new_figure(9, 5)
    axes = figure.subplots()
    draw(axes)
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_figure(path, figure)
    print(f"written: {path}")
