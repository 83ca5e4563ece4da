"""The tables of a fit: ``history.csv`` and ``density.csv``."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from drgs.core.files import atomic_path
from drgs.training.density.strategy import DensityReport


@dataclass(frozen=True)
class HistoryRow:
    """A line of ``history.csv``."""

    iteration: int  # the first is 1
    loss: float
    psnr: float  # dB, of the iteration's training view
    num_gaussians: int
    means_lr: float  # world units
    wall_s: float  # since the first iteration
    test_psnr: float | None = None  # dB, mean of some test views; None: not measured here


@dataclass(frozen=True, kw_only=True)
class DensityRow(DensityReport):
    """A line of ``density.csv``: changes after an iteration."""

    iteration: int  # the first is 1


DENSITY_COLUMNS = ("iteration", *(field.name for field in fields(DensityReport)))


def write_history(path: Path, history: Sequence[HistoryRow]) -> None:
    """Write ``history.csv``."""
    values = (vars(row).values() for row in history)
    rows = [[f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in values]
    write_csv(path, HistoryRow.__dataclass_fields__, rows)


def write_density(path: Path, changes: Sequence[DensityRow]) -> None:
    """Write ``density.csv`` if there are changes."""
    if changes:
        rows = [[getattr(change, name) for name in DENSITY_COLUMNS] for change in changes]
        write_csv(path, DENSITY_COLUMNS, rows)


def write_csv(path: Path, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a table; missing parent folders are created."""
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def summarize_density(strategy: str, changes: Sequence[DensityRow]) -> str | None:
    """Summarize the changes of ``densify.strategy`` in one line; None without changes."""
    if not changes:
        return None
    first, end = changes[0], changes[-1].num_gaussians
    start = first.num_gaussians - first.num_added + first.pruned
    counts = []
    for name in ("cloned", "split", "relocated", "pruned", "refused"):
        total = sum(getattr(change, name) for change in changes)
        if total or name in ("pruned", "refused"):
            counts.append(f"{total:,} {name}")
    return f"{strategy}: {start:,} \u2192 {end:,} Gaussians; {', '.join(counts)}"
