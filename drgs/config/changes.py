"""Changes of a configuration: values by name, and the number of iterations.

Iterations at which something happens (the population may change, opacities are reset, the degree of
the spherical harmonics rises, coarse stages end) keep their share of the whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import reduce
from typing import Any

from drgs.config.schema import FitConfig
from drgs.config.section import Section, set_value


def with_changes(config: FitConfig, changes: Mapping[str, object]) -> FitConfig:
    """Set values by names such as ``densify.every``, and check the result."""
    values = config.model_dump()
    for key, value in changes.items():
        set_value(values, key, value)
    return FitConfig.model_validate(values)


def with_iterations(config: FitConfig, iterations: int) -> FitConfig:
    """Change the number of iterations, and everything else in proportion.

    ``densify.every`` stays, as statistics are gathered over views.
    """
    share = iterations / config.iterations

    def scale_count(count: int) -> int:
        return max(1, round(count * share)) if count else 0  # 0: from the start

    changes: dict[str, Any] = {"iterations": iterations, "stop_after": None}
    for prefix, section in _sections(config):
        for name in section.scaled:
            count = getattr(section, name)
            changes[f"{prefix}{name}"] = count if count is None else scale_count(count)
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


def open_at_start(config: FitConfig) -> list[str]:
    """Return the same, with those that only a fit needs."""
    densify = config.densify
    goal = [f"densify.{densify.strategy}.gaussians"] if densify.has_goal else []
    return [*OPEN, "init.num_points", "optimizer.scales_lr", "coarse", *goal]


def is_open(config: FitConfig) -> bool:
    """Return whether a value that rendering needs depends on the dataset."""
    return any(_value(config, key) is None for key in OPEN)


def with_decisions(config: FitConfig, other: FitConfig) -> FitConfig:
    """Set the values that ``config`` leaves to the dataset to those of ``other``."""
    open_keys = (key for key in open_at_start(config) if _value(config, key) is None)
    return with_changes(config, {key: _value(other, key) for key in open_keys})


def _value(config: FitConfig, key: str) -> Any:
    return reduce(lambda section, name: getattr(section, name, None), key.split("."), config)


def given_keys(config: FitConfig) -> set[str]:
    """Return the keys, as in ``colors.lr``, that the configuration's author has set.

    A null counts, unless it leaves the value to the dataset. Of a configuration that was loaded
    with all values, as a fit writes it, all are set.
    """
    keys = {f"{p}{n}" for p, section in _sections(config) for n in section.model_fields_set}
    left = {key for key in open_at_start(config) if _value(config, key) is None}
    empty = config.sections.keys() - {key.partition(".")[0] for key in keys if "." in key}
    sections = {prefix.removesuffix(".") for prefix, _ in _sections(config)}
    return keys - left - (sections - empty)


def _sections(section: Section, prefix: str = "") -> Iterator[tuple[str, Section]]:
    """Yield a section and all sections in it, with the prefixes of their keys."""
    yield prefix, section
    for name, value in section:
        if isinstance(value, Section):
            yield from _sections(value, f"{prefix}{name}.")
