"""Changes of a configuration: values by name, and the number of iterations.

Iterations at which something happens (the population may change, opacities are reset, the degree of
the spherical harmonics rises, coarse stages end) keep their share of the whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import reduce
from typing import Any

from drgs.config.schema import FitConfig
from drgs.config.section import Section

_COUNTS = (
    "densify.start",
    "densify.stop",
    "densify.adc.reset_every",
    "densify.adc.white_background_reset",
    "densify.prune.start",
    "densify.prune.stop",
    "model.sh_increase_every",
    "cameras.start",
)


def with_changes(config: FitConfig, changes: Mapping[str, object]) -> FitConfig:
    """Set values by names such as ``densify.every``, and check the result."""
    values = config.model_dump()
    for key, value in changes.items():
        *sections, name = key.split(".")
        target = values
        for section in sections:
            target = target[section]
        target[name] = value
    return FitConfig.model_validate(values)


def with_iterations(config: FitConfig, iterations: int) -> FitConfig:
    """Change the number of iterations, and everything else in proportion.

    ``densify.every`` stays, as statistics are gathered over views.
    """
    share = iterations / config.iterations

    def scale_count(count: int) -> int:
        return max(1, round(count * share)) if count else 0  # 0: from the start

    changes: dict[str, Any] = {"iterations": iterations, "stop_after": None}
    for key in _COUNTS:
        count = _value(config, key)
        changes[key] = count if count is None else scale_count(count)
    if config.coarse is not None:
        ends = {scale_count(stage.until): stage.factor for stage in reversed(config.coarse)}
        changes["coarse"] = [{"until": k, "factor": ends[k]} for k in sorted(ends)]
    changes["densify.stop"] = max(changes["densify.stop"], changes["densify.start"] + 1)
    if changes["densify.prune.stop"] is not None:
        least = max(changes["densify.stop"], changes["densify.prune.start"] or 0) + 1
        changes["densify.prune.stop"] = max(changes["densify.prune.stop"], least)
    return with_changes(config, changes)


OPEN = ("data.background", "model.near")
"""Values that depend on the dataset if they are null: see ``drgs.initialization.defaults``."""

OPEN_AT_START = (
    *OPEN,
    "init.num_points",
    "densify.budget.gaussians",
    "densify.mcmc.gaussians",
    "optimizer.scales_lr",
    "coarse",
)
"""The same, with those that only a fit needs."""


def is_open(config: FitConfig) -> bool:
    """Return whether a value that rendering needs depends on the dataset."""
    return any(_value(config, key) is None for key in OPEN)


def with_decisions(config: FitConfig, other: FitConfig) -> FitConfig:
    """Set the values that ``config`` leaves to the dataset to those of ``other``."""
    changes = {key: _value(other, key) for key in OPEN_AT_START if _value(config, key) is None}
    return with_changes(config, changes)


def _value(config: FitConfig, key: str) -> Any:
    return reduce(getattr, key.split("."), config)


def given_keys(config: FitConfig) -> set[str]:
    """Return the keys, as in ``colors.lr``, that the configuration's author has set.

    A null counts, unless it leaves the value to the dataset. Of a configuration that was loaded
    with all values, as a fit writes it, all are set.
    """
    keys = {f"extensions.{name}" for name in config.extensions} | set(_set_keys(config, ""))
    values = {key: reduce(getattr, key.split("."), config) for key in OPEN_AT_START}
    return keys - {key for key, value in values.items() if value is None}


def _set_keys(section: Section, prefix: str) -> Iterator[str]:
    for name in section.model_fields_set:
        value = getattr(section, name)
        if isinstance(value, Section):
            yield from _set_keys(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"
