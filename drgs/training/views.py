"""A photograph as training needs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from drgs.training.losses import Target


@dataclass(eq=False)
class TrainingView:
    """A view as training needs it."""

    name: str
    index: int  # among the training views
    sensor: mi.Sensor
    photograph: Target
    target: Target  # what is compared with: the photograph, unless an effect replaces it
    width: int  # px
    height: int  # px
    counted: float  # share of the pixels that count: those that no mask leaves out
    uploads: dict[str, Any]  # what effects need, by their names
