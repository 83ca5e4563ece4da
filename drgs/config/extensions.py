"""Extension points of a fit, and the section ``extensions`` of a configuration.

``extensions`` contains a section for each extension, checked by its pydantic model. Effects and
loss terms are active if their section exists, be it empty; ``densify.strategy`` and ``loss.type``
select a strategy and a loss.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, SerializeAsAny, ValidationError

from drgs.config.section import Section, expectation, format_value
from drgs.core.errors import did_you_mean
from drgs.core.registry import HOW_TO_INSTALL, Extension, Registry, all_extensions

STRATEGIES: Registry[type] = Registry(
    "density strategy",
    {
        "adc": "drgs.training.density.adc",
        "budget": "drgs.training.density.budget",
        "mcmc": "drgs.training.density.mcmc",
        "importance": "drgs.training.density.pruning",
        "selection": "drgs.training.density.pruning",
        "floaters": "drgs.training.density.floaters",
    },
)
"""Subclasses of :class:`drgs.training.density.strategy.DensityStrategy`."""

EFFECTS: Registry[type] = Registry(
    "effect",
    {
        # In the order in which they act. The filter places all sensors: after it, cameras place
        # the one that is rendered, with derivatives.
        "depth": "drgs.training.effects.depth",
        "colors": "drgs.training.effects.colors",
        "photometry": "drgs.training.effects.photometry",
        "background": "drgs.training.effects.background",
        "masks": "drgs.training.effects.masks",
        "smoothing": "drgs.training.effects.smoothing",
        "cameras": "drgs.training.effects.cameras",
    },
)
"""Subclasses of :class:`drgs.training.effects.base.TrainingEffect`."""

LOSSES: Registry[type] = Registry("loss", {"photometric": "drgs.training.losses"})
"""Subclasses of :class:`drgs.training.losses.Loss`."""

LOSS_TERMS: Registry[type] = Registry("loss term")
"""Subclasses of :class:`drgs.training.losses.LossTerm`."""

READERS: Registry[type] = Registry(
    "dataset reader",
    {
        "nerf_synthetic": "drgs.datasets.nerf_synthetic",
        "nerfstudio": "drgs.datasets.nerfstudio",
        "colmap": "drgs.datasets.colmap",
    },
)
"""Subclasses of :class:`drgs.datasets.reader.DatasetReader`."""

GROWTH = ("adc", "budget", "mcmc")
"""Shipped strategies for ``densify.strategy``; the others prune after them."""


def _name_check(registry: Registry, shipped: tuple[str, ...]) -> AfterValidator:
    def check(name: str) -> str:
        if name not in shipped:
            known = [*shipped, *(extension.name for extension in registry.installed_extensions())]
            if name not in known:
                quoted = ", ".join(f"'{each}'" for each in known)
                raise ValueError(
                    f"must be one of {quoted}{did_you_mean(name, known)} ({HOW_TO_INSTALL})"
                )
        return name

    return AfterValidator(check)


StrategyName = Annotated[str, _name_check(STRATEGIES, GROWTH)]
LossName = Annotated[str, _name_check(LOSSES, ("photometric",))]
ReaderName = Annotated[str, _name_check(READERS, ("auto", *READERS.shipped_names))]


def _check_sections(sections: object) -> dict[str, BaseModel | None]:
    if not isinstance(sections, Mapping):
        raise ValueError("extensions must contain sections by the names of extensions")
    return {name: _check_section(str(name), values) for name, values in sections.items()}


def _check_section(name: str, values: object) -> BaseModel | None:
    known = {extension.name: extension for extension in all_extensions()}
    if name not in known:
        there_are = f"there are {', '.join(known)}" if known else "none is installed"
        raise ValueError(
            f"extensions.{name}: no extension has this name{did_you_mean(name, known)}; "
            f"{there_are} ({HOW_TO_INSTALL})"
        )
    section = known[name].section
    if section is None:
        if values:
            raise ValueError(f"extensions.{name} must be empty: it has no settings")
        return None
    if not issubclass(section, Section):
        raise ValueError(
            f"extensions.{name}: the extension's section must be a subclass of "
            f"{Section.__module__}.{Section.__name__}"
        )
    if isinstance(values, BaseModel):
        values = values.model_dump()
    try:
        return section.model_validate({} if values is None else values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(["extensions", name, *map(str, first["loc"])])
        if first["type"] == "extra_forbidden":
            hint = did_you_mean(str(first["loc"][-1]), section.model_fields)
            raise ValueError(f"unknown key {key}{hint}") from None
        text = f"{key} {expectation(first)}, got {format_value(first['input'])}"
        raise ValueError(text) from None


Sections = Annotated[dict[str, SerializeAsAny[BaseModel] | None], BeforeValidator(_check_sections)]
"""Sections of extensions by name, each as the extension's model; None: it has none."""


def extension_keys() -> list[str]:
    """Return the keys of sections of registered extensions, such as ``extensions.mine.rate``."""
    keys = []
    for extension in all_extensions():
        keys.append(f"extensions.{extension.name}")
        fields = extension.section.model_fields if extension.section else ()
        keys += [f"extensions.{extension.name}.{name}" for name in fields]
    return keys


def section_of(extension: Extension, sections: Mapping[str, BaseModel | None]) -> BaseModel | None:
    """Return the section of an extension, with defaults if it is not set; None: it has no model."""
    section = sections.get(extension.name)
    return extension.section() if section is None and extension.section else section


def extensions_in_use(
    sections: Mapping[str, BaseModel | None], registry: Registry
) -> list[Extension]:
    """Return the extensions of a registry that a configuration has a section for."""
    return [each for each in registry.installed_extensions() if each.name in sections]


def describe_extensions() -> str:
    """Return a line for each installed extension: kind, name, first line of its docstring."""
    lines = [f"  {each.kind} {each.name}: {each.summary}" for each in all_extensions()]
    return "\n".join(["installed extensions:", *(lines or ["  none"])])
