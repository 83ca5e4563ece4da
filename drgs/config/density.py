"""The section ``densify`` of a configuration: which strategy changes the population, and how.

Each strategy has a section of its own in it; what all of them share stands beside these.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, model_validator

from drgs.config.section import Count, Section

REFERENCE_START, REFERENCE_STOP = 500, 15_000
"""Iterations: the reference's schedule, for 30,000."""


class AdcConfig(Section):
    """The strategy adc, adaptive density control: clone, split, prune, opacity reset."""

    grad_threshold: float = Field(
        2e-4,
        gt=0,
        description="A Gaussian is cloned or split if the mean norm of its 2D position gradient, "
        "in NDC units, over the views that saw it reaches this.",
    )
    clone_scale: float = Field(
        0.01,
        gt=0,
        description="Cloned if its largest scale is at most this, split if larger; x extent.",
    )
    split_count: int = Field(
        2, ge=2, le=1_000_000, description="Samples that replace a Gaussian that is split."
    )
    split_shrink: float = Field(1.6, gt=1, description="Their scales are the parent's / this.")
    prune_opacity: float = Field(0.005, ge=0, lt=1, description="Removed if less opaque.")
    prune_scale: float = Field(
        0.1,
        gt=0,
        description="Removed after the first reset if its largest scale is larger; x extent.",
    )
    reset_every: Count = Field(
        3000, ge=1, description="Iterations between opacity resets, which end with densify.stop."
    )
    reset_opacity: float = Field(0.01, gt=0, lt=1, description="A reset lowers opacities to this.")
    white_background_reset: Count | None = Field(
        500, ge=1, description="Iteration of an extra reset if the background is white; null: none."
    )


class BudgetConfig(Section):
    """The strategy budget: growth to a number of Gaussians, where errors are."""

    gaussians: Count | None = Field(
        None,
        ge=4,
        description="How many there are to be at densify.stop. null: as many as suit the pictures' "
        "size, 250 times the root of their pixels: 100,000 for 400 x 400 px.",
    )
    error_every: Count = Field(
        10,
        ge=1,
        description="Iterations between those whose errors count. Each of them takes half as long "
        "again.",
    )
    prune_opacity: float = Field(0.005, ge=0, lt=1, description="Removed if less opaque.")
    prune_scale: float = Field(
        0.1, gt=0, description="Removed if the largest scale is larger; x extent."
    )


EARLIER_KEYS = {f"densify.{name}": f"densify.adc.{name}" for name in AdcConfig.model_fields}
"""Names of values in files of earlier versions, which had one strategy, and what they are now."""


class DensifyConfig(Section):
    """How the number of Gaussians changes."""

    strategy: Literal["adc", "budget"] = Field(
        "adc",
        description="What changes the population. adc: adaptive density control, as in the paper "
        "(Kerbl et al. 2023); budget: growth to a number of Gaussians, where errors are.",
    )
    start: Count | None = Field(
        REFERENCE_START,
        ge=0,
        description="The population changes only after this iteration. Not given, or null: 500, or "
        "half of stop if that is less.",
    )
    stop: Count | None = Field(
        REFERENCE_STOP,
        ge=1,
        description="It changes, and is reset, only before this iteration. Not given, or null: "
        "15,000, or 5/7 of fewer than 21,000 iterations.",
    )
    every: Count = Field(100, ge=1, description="Iterations between two changes.")
    max_gaussians: int = Field(
        1_000_000, ge=4, le=100_000_000, description="Cap that is never exceeded."
    )
    adc: AdcConfig = Field(default_factory=AdcConfig)
    budget: BudgetConfig = Field(default_factory=BudgetConfig)

    @model_validator(mode="before")
    @classmethod
    def _as_now(cls, values: Any) -> Any:
        """Values of earlier versions, which had only adc, where they are now."""
        earlier = [name for name in AdcConfig.model_fields if name in _keys(values)]
        if not earlier:
            return values
        given = values.get("adc", {})
        if not isinstance(given, Mapping):  # refused by its own check
            return values
        if twice := [name for name in earlier if name in given]:
            raise ValueError(
                f"must hold {twice[0]} in the section adc or, as in earlier versions, beside it, "
                "not twice"
            )
        others = {name: value for name, value in values.items() if name not in earlier}
        return {
            "strategy": "adc",
            **others,
            "adc": {**given, **{name: values[name] for name in earlier}},
        }


def _keys(values: Any) -> Mapping[str, Any]:
    return values if isinstance(values, Mapping) else {}
