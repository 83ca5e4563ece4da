"""The section ``densify`` of a configuration, with sections of density strategies."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from drgs.config.extensions import STRATEGIES
from drgs.config.section import Count, ExtensibleSection, Resolved, Section, name_of, subsection

REFERENCE_START, REFERENCE_STOP = 500, 15_000  # iterations: the reference's schedule, for 30,000


class PruneConfig(Section):
    """Pruning to a given number of Gaussians, after any strategy.

    Opacities are lowered against the loss until enough Gaussians are transparent.
    """

    removed: ClassVar = {"method": "selection", "opacity": 0.005, "opacity_rate": 4.0}
    scaled: ClassVar = ("start", "stop")

    to: Count | None = Field(None, ge=1)
    """Maximum number of Gaussians at the end; null: no pruning."""
    start: Count | None = Field(None, ge=1)
    """Iteration after which it begins, at least densify.stop. null: densify.stop."""
    stop: Count | None = Field(None, ge=2)
    """Iteration of the last change. null: half of the remaining ones."""
    every: Count = Field(50, ge=1)
    """Iterations between two changes."""


class DensifyConfig(ExtensibleSection):
    """Changes of the number of Gaussians; with a section for each strategy, under its name."""

    registries: ClassVar = (STRATEGIES,)
    removed: ClassVar = {"stop_aims": []}
    scaled: ClassVar = ("start", "stop")

    strategy: Annotated[str, name_of(STRATEGIES)] = "budget"
    """How the population changes. adc: adaptive density control, as in the paper (Kerbl et al.
    2023); budget: growth to a given number of Gaussians, where errors are largest; mcmc: relocation
    and noise (Kheradmand et al. 2024). Or the name of an extension."""
    start: Resolved[Count] = Field(REFERENCE_START, ge=0)
    """Last iteration before the first change. Not given, or null: 500, but at most half of stop
    and, with budget and mcmc, a twentieth of all iterations."""
    stop: Resolved[Count] = Field(REFERENCE_STOP, ge=1)
    """Changes and resets end before this iteration; with budget, the last change is at this
    iteration. Not given, or null: 3/4 of the iterations with budget, else 5/7 of them; with adc at
    most 15,000."""
    every: Count = Field(100, ge=1)
    """Iterations between two changes."""
    max_gaussians: int = Field(1_000_000, ge=4, le=100_000_000)
    """Limit that the population never exceeds."""
    remove_floaters: bool = True
    """Remove Gaussians close before a few cameras, after 50, 70 and 90 % of the iterations."""
    prune: PruneConfig = subsection(PruneConfig)

    @property
    def settings(self) -> Section | None:
        """The section of the chosen strategy; None: it has no settings."""
        return self.sections.get(self.strategy)

    @property
    def has_goal(self) -> bool:
        """True if the strategy's section has a number of ``gaussians`` to which it grows."""
        return "gaussians" in type(self.settings or self).model_fields

    def prune_window(self, iterations: int) -> tuple[int, int]:
        """Return the iteration after which pruning begins, and that of its last change.

        iterations: of the fit. There is no pruning if it would begin after its end.
        """
        start = max(self.stop, self.prune.start or 0)
        return start, self.prune.stop or (start + iterations + 1) // 2

    def first_fixed_iteration(self, iterations: int) -> int:
        """Return the first iteration after the last change of rows; iterations: of the fit."""
        last = self.stop if self.prune.to is None else self.prune_window(iterations)[1]
        return max(self.stop, last) + 1
