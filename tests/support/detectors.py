"""Which tests notice which mutants: the checks, and what became of each mutant."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
import pytest

from support.mutants import Mutant, Switchboard

MutantKey = tuple[str, str, str, str]
"""Function, source, part, change."""


@dataclass(frozen=True)
class Detector:
    """A test of the suite that is to notice mutants."""

    name: str
    check: Callable[[], None]

    def notices(self) -> bool:
        """Whether the check fails. An error that is no failed comparison is passed on."""
        try:
            with np.errstate(all="ignore"):
                self.check()
        except (AssertionError, pytest.fail.Exception):
            return True
        return False


@dataclass(frozen=True)
class Outcome:
    """The results of all mutants."""

    switchboard: Switchboard
    detectors: list[str]
    false_alarms: list[str]  # detectors that fail without a mutant
    noticed_by: dict[Mutant, list[str]]

    @property
    def table(self) -> str:
        """A line for each mutant."""
        lines = [
            f"{str(mutant)[:110]:110}  {mutant.change:11}  {', '.join(names) or '-'}"
            for mutant, names in self.noticed_by.items()
        ]
        reasons = Counter(reason for _, _, reason in self.switchboard.left_out)
        lines += [f"left out {count:3}: {reason}" for reason, count in reasons.items()]
        return "\n".join(lines)

    def survivors(self, equivalent: Collection[MutantKey]) -> list[str]:
        """Mutants that nobody notices and that are not among those known to change nothing."""
        unnoticed = [m for m, names in self.noticed_by.items() if not names]
        return [f"{m}  {m.change}" for m in unnoticed if _key(m) not in equivalent]

    def noticing(self, equivalent: Collection[MutantKey]) -> dict[MutantKey, list[str] | None]:
        """Who notices mutants that are said to change nothing; None for one that is not there."""
        noticed_by = {_key(mutant): names for mutant, names in self.noticed_by.items()}
        return {key: noticed_by.get(key) for key in equivalent}

    @property
    def busy_detectors(self) -> set[str]:
        """Return detectors that notice a mutant."""
        return {name for names in self.noticed_by.values() for name in names}

    @property
    def idle_sites(self) -> list[str]:
        """Places in the source that no detector evaluates: they would have no mutant."""
        return [
            f"{s.function}:{s.line}  {s.text}" for s in self.switchboard.sites if not s.evaluated
        ]


def _key(mutant: Mutant) -> MutantKey:
    return mutant.site.function, mutant.site.text, mutant.part, mutant.change


def find_noticed(board: Switchboard, general: list[Detector], special: list[Detector]) -> Outcome:
    """Ask about each mutant ``general`` detectors, then, if none noticed it, ``special`` ones."""
    false_alarms, reached, noticed_by = [], {}, {}
    for detector in (*general, *special):
        fails, reached[detector.name] = board.record(detector.notices)
        if fails:
            false_alarms.append(detector.name)
    for mutant in board.mutants:
        board.apply(mutant)

        def ask(group: list[Detector], mutant: Mutant = mutant) -> list[str]:
            return [d.name for d in group if mutant.switch in reached[d.name] and d.notices()]

        noticed_by[mutant] = ask(general) or ask(special)
    board.apply(None)
    return Outcome(board, list(reached), false_alarms, noticed_by)
