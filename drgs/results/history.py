"""The tables of a fit: ``history.csv`` and ``density.csv``."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

from drgs.core.files import atomic_path


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


@dataclass(frozen=True)
class DensityReport:
    """Changes that one call of a strategy of density made to the rows."""

    num_gaussians: int  # afterwards
    num_added: int = 0  # rows on top of those before, parents of a split not counted
    cloned: int = 0  # Gaussians that were copied
    split: int = 0  # Gaussians that were replaced by several
    relocated: int = 0  # rows that became copies of others
    pruned: int = 0  # rows that were removed, parents of a split not counted
    refused: int = 0  # Gaussians that were to be cloned or split, but there was no room


@dataclass(frozen=True, kw_only=True)
class DensityRow(DensityReport):
    """A line of ``density.csv``: changes after an iteration."""

    iteration: int  # the first is 1


DENSITY_COLUMNS = ("iteration", *(field.name for field in fields(DensityReport)))
"""Columns of ``density.csv``."""


@dataclass(eq=False)
class FitHistory:
    """The rows of both tables."""

    rows: list[HistoryRow] = field(default_factory=list)
    density: list[DensityRow] = field(default_factory=list)


def write_history(path: Path, history: Sequence[HistoryRow]) -> None:
    """Write ``history.csv``."""
    rows = [
        [f"{v:.6g}" if isinstance(v, float) else v for v in vars(row).values()] for row in history
    ]
    _write_table(path, HistoryRow.__dataclass_fields__, rows)


def write_density(path: Path, changes: Sequence[DensityRow]) -> None:
    """Write ``density.csv`` if there are changes."""
    if changes:
        rows = [[getattr(change, name) for name in DENSITY_COLUMNS] for change in changes]
        _write_table(path, DENSITY_COLUMNS, rows)


def _write_table(path: Path, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def summarize_density(strategy: str, changes: Sequence[DensityRow]) -> str | None:
    """Return in one line how the population changed; None: it has not.

    strategy: ``densify.strategy``.
    """
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
