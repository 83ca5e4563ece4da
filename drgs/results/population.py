"""The story of a population: what was added to it, and what was removed, over the iterations."""

from __future__ import annotations

from collections.abc import Sequence

from drgs.results.history import DensityRow

ALWAYS, WHERE_ANY = ("pruned", "refused"), ("cloned", "split", "relocated")
"""Counts that the story states."""


def story_of(strategy: str, changes: Sequence[DensityRow]) -> str | None:
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
