"""The summary of a fit, printed at its start: simulated effects, and the keys that enable them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from drgs.config.extensions import EFFECTS, LOSS_TERMS, LOSSES, STRATEGIES, extensions_in_use
from drgs.config.schema import FitConfig
from drgs.datasets.types import Dataset
from drgs.integrator.summary import (
    SimulatedEffect,
    antialiasing_effect,
    join_parts,
    lens_effect,
    motion_effect,
    view_dependence_effect,
)


def summary_of_fit(
    config: FitConfig, dataset: Dataset, reasons: Mapping[str, str] = MappingProxyType({})
) -> list[SimulatedEffect]:
    """Return the effects of a fit, in the order in which they are listed.

    reasons: evidence by which values were chosen, by key: see :mod:`drgs.examine.examination`.
    """
    views, model, ignored = dataset.train, config.model, dataset.ignored
    depths = _of_data("depth", [v.depth for v in views], "supervision", "the dataset's depth")
    depths = depths.unless_ignored(config.loss.depth_weight == 0)
    effects = [
        view_dependence_effect(model.sh_degree, f"model.sh_degree: {model.sh_degree}"),
        SimulatedEffect("background", "a random colour at each iteration", "data.random_background")
        if config.data.random_background
        else SimulatedEffect("background", f"{config.data.background}", "data.background"),
        replace(lens_effect(views), ignored="distortion" in ignored),
        replace(motion_effect(views), ignored="motion" in ignored),
        antialiasing_effect(
            "model.antialiased" if model.antialiased else None,
            "model.smoothing" if model.smoothing else None,
        ),
        *_approximations(config),
        SimulatedEffect(
            "exposure and white balance",
            None if config.colors.lr is None else "a colour transform for each training photograph",
            "colors.lr",
        ),
        *_photometry(config),
        replace(
            _of_data("masks", [v.mask for v in views], "pixels left out", "the dataset's masks"),
            ignored="masks" in ignored,
        ),
        replace(depths, ignored=depths.ignored or "depth" in ignored),
        SimulatedEffect(
            "camera refinement",
            _describe_refinement(config) if config.cameras.optimise else None,
            "cameras.optimise",
        ),
        *_extensions(config),
    ]
    return [
        replace(each, why=f"{each.why}: {reasons[each.why]}") if each.why in reasons else each
        for each in effects
    ]


def _photometry(config: FitConfig) -> list[SimulatedEffect]:
    rates = {"vignetting": config.colors.vignetting_lr, "response": config.colors.response_lr}
    keys = {name: f"colors.{name}_lr" for name, rate in rates.items() if rate is not None}
    return [SimulatedEffect(name, "of each camera", key) for name, key in keys.items()]


def _extensions(config: FitConfig) -> list[SimulatedEffect]:
    """Return the extensions that take part, with the key of each."""
    used = [
        (extension, f"extensions.{extension.name}")
        for registry in (EFFECTS, LOSS_TERMS)
        for extension in extensions_in_use(config.extensions, registry)
    ]
    chosen = (
        (STRATEGIES, config.densify.strategy, "densify.strategy"),
        (LOSSES, config.loss.type, "loss.type"),
    )
    for registry, name, key in chosen:
        if name not in registry.shipped_names:
            used.append((registry.get(name), f"{key}: {name}"))
    return [SimulatedEffect(e.name, f"{e.kind}: {e.summary}", why) for e, why in used]


def _approximations(config: FitConfig) -> list[SimulatedEffect]:
    """Return the approximations that are chosen by name and not the default, if there are any."""
    chosen = config.model.approximations.non_default
    values = {f"model.{k}": chosen[k] for k in chosen if k in ("projection", "falloff", "order")}
    words, keys = ", ".join(values.values()), ", ".join(values)
    return [SimulatedEffect("approximations", words, keys)] if values else []


def _of_data(name: str, values: Sequence[object], what: str, why: str) -> SimulatedEffect:
    count = sum(value is not None for value in values)
    return SimulatedEffect(name, what if count else None, f"{why}, in {count} views")


def _describe_refinement(config: FitConfig) -> str:
    rates = config.cameras
    return (
        join_parts(
            "poses" if rates.rotation_lr or rates.translation_lr else None,
            "focal lengths" if rates.focal_lr else None,
            "principal point" if rates.principal_lr else None,
        )
        or "nothing: all rates are 0"
    )
