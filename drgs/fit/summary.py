"""The summary of a fit, printed at its start: simulated effects, and the keys that enable them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from drgs.config.extensions import EFFECTS, LOSS_TERMS, LOSSES, STRATEGIES
from drgs.config.schema import FitConfig
from drgs.datasets.types import Dataset
from drgs.effects.base import SimulatedEffect, antialiasing_effect
from drgs.integrator.summary import lens_effect, motion_effect, view_dependence_effect


def summary_of_fit(
    config: FitConfig, dataset: Dataset, reasons: Mapping[str, str] = MappingProxyType({})
) -> list[SimulatedEffect]:
    """Return the effects of a fit, in the order in which they are listed.

    reasons: evidence by which values were chosen, by key: see :mod:`drgs.examine.examination`.
    """
    views, model, ignored = dataset.train, config.model, dataset.ignored
    lines = [
        view_dependence_effect(model.sh_degree, f"model.sh_degree: {model.sh_degree}"),
        SimulatedEffect("background", f"{config.data.background}", "data.background"),
        replace(lens_effect(views), ignored="distortion" in ignored),
        replace(motion_effect(views), ignored="motion" in ignored),
        antialiasing_effect("model.antialiased" if model.antialiased else None, None),
        *_approximations(config),
    ]
    found = {line.name: line for line in lines}
    for effect in sorted(EFFECTS.all(), key=lambda effect: effect.value.order):
        found |= {line.name: line for line in effect.value.summarize(config, dataset)}
    return [
        replace(line, why=f"{line.why}: {reasons[line.why]}") if line.why in reasons else line
        for line in (*found.values(), *_extensions(config))
    ]


def _extensions(config: FitConfig) -> list[SimulatedEffect]:
    """Return the terms of the loss, and a strategy and a loss that drgs does not ship."""
    used = [(term, term.name) for term in LOSS_TERMS.all() if term.name in config.sections]
    chosen = (
        (STRATEGIES, config.densify.strategy, "densify.strategy"),
        (LOSSES, config.loss.type, "loss.type"),
    )
    for registry, name, key in chosen:
        if not (extension := registry.get(name)).is_shipped:
            used.append((extension, f"{key}: {name}"))
    return [SimulatedEffect(e.name, f"{e.kind}: {e.summary}", why) for e, why in used]


def _approximations(config: FitConfig) -> list[SimulatedEffect]:
    """Return the approximations that are chosen by name and not the default, if there are any."""
    chosen = config.model.approximations.non_default
    values = {f"model.{k}": chosen[k] for k in chosen if k in ("projection", "falloff", "order")}
    words, keys = ", ".join(values.values()), ", ".join(values)
    return [SimulatedEffect("approximations", words, keys)] if values else []
