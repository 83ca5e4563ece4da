"""The same fit in fewer or more iterations. Layer 4.

What a configuration says in iterations (when the population may change, when opacities are reset,
when the degree of the spherical harmonics rises, where coarse stages end) keeps its share of the
whole.
"""

from __future__ import annotations

from typing import Any

from drgs.config import FitConfig

_COUNTS = (
    "densify.start",
    "densify.stop",
    "densify.reset_every",
    "densify.white_background_reset",
    "model.sh_increase_every",
)


def with_iterations(config: FitConfig, iterations: int) -> FitConfig:
    """``config`` with another number of iterations, and everything else in proportion.

    The iterations between two changes of the population (``densify.every``) stay: what a change
    needs to know is gathered over views.
    """
    share = iterations / config.iterations

    def scaled(count: int | None) -> int | None:
        return None if count is None else max(1, round(count * share))

    values: dict[str, Any] = config.model_dump()
    values["iterations"] = iterations
    for key in _COUNTS:
        section, name = key.split(".")
        values[section][name] = scaled(values[section][name])
    for stage in values["coarse"]:
        stage["until"] = scaled(stage["until"])
    return FitConfig.model_validate(values)
