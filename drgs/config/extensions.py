"""Extension points by name; a configuration has a section for each extension that has settings.

A section stands at its kind's place under the extension's name, no matter who ships it: those of
strategies in ``densify``, all others at the top level. Effects and loss terms are active if their
section exists, be it empty, unless they decide otherwise; ``densify.strategy``, ``loss.type`` and
``data.type`` select a strategy, a loss and a reader.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from drgs.core.registry import ClassRegistry, Extension, Registry, all_extensions

if TYPE_CHECKING:
    from pydantic import BaseModel

STRATEGIES: Registry[type] = Registry("density strategy", "drgs.strategies")
"""Subclasses of :class:`drgs.training.density.strategy.DensityStrategy`."""

EFFECTS: Registry[type] = ClassRegistry("effect", "drgs.effects", attribute="name")
"""Subclasses of :class:`drgs.effects.base.TrainingEffect`."""

LOSSES: Registry[type] = Registry("loss", "drgs.losses")
"""Subclasses of :class:`drgs.training.losses.Loss`."""

LOSS_TERMS: Registry[type] = Registry("loss term", "drgs.loss_terms")
"""Subclasses of :class:`drgs.training.losses.LossTerm`."""

READERS: Registry[type] = Registry("dataset reader", "drgs.readers")
"""Subclasses of :class:`drgs.datasets.reader.DatasetReader`."""

EXAMINERS: Registry = Registry("examiner", "drgs.examiners")
"""Functions that choose effects by evidence: see :class:`drgs.effects.base.Examiner`."""

Sections = Mapping[str, "BaseModel"]
"""Sections of extensions by name, each as the extension's model."""


def section_of(extension: Extension, sections: Sections) -> BaseModel | None:
    """Return the section of an extension, with defaults if it is not set; None: it has no model."""
    if extension.section is None:
        return None
    return sections.get(extension.name) or extension.section()


def describe_extensions() -> str:
    """Return a line for each installed extension: kind, name, first line of its docstring."""
    lines = [f"  {each.kind} {each.name}: {each.summary}" for each in all_extensions()]
    return "\n".join(["installed extensions:", *(lines or ["  none"])])
