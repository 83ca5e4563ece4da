"""The story of a population: what was added to it, and what was removed, over the iterations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol


class DensityChange(Protocol):
    """What the strategy did to the rows after an iteration: a row of ``density.csv``."""

    @property
    def iteration(self) -> int:
        """The first is 1."""

    @property
    def num_gaussians(self) -> int:
        """Afterwards."""

    @property
    def num_added(self) -> int:
        """Rows on top of those before."""

    @property
    def cloned(self) -> int:
        """Gaussians that were copied."""

    @property
    def split(self) -> int:
        """Gaussians that were replaced by several."""

    @property
    def relocated(self) -> int:
        """Rows that became copies of others."""

    @property
    def pruned(self) -> int:
        """Rows that were removed."""

    @property
    def refused(self) -> int:
        """Gaussians for whose copies there was no room."""


ALWAYS, WHERE_ANY = ("pruned", "refused"), ("cloned", "split", "relocated")
"""Counts that the story states."""


def story_of(strategy: str, changes: Sequence[DensityChange]) -> str | None:
    """One line: from how many to how many Gaussians, and by what; None: nothing has changed.

    strategy: ``densify.strategy``.
    """
    if not changes:
        return None
    first = changes[0]
    start = first.num_gaussians - first.num_added + first.pruned
    sums = {k: sum(getattr(c, k) for c in changes) for k in (*WHERE_ANY, *ALWAYS)}
    said = [f"{n:,} {name}" for name, n in sums.items() if n or name in ALWAYS]
    end = changes[-1].num_gaussians
    return f"{strategy}: {start:,} \u2192 {end:,} Gaussians; {', '.join(said)}"
