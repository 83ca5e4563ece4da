"""One training photograph: its sensor, what is rendered is compared with, and effects' uploads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from drgs.training.losses import Target


@dataclass(eq=False)
class TrainingView:
    """A photograph of the training split, at the size of one stage; in display space."""

    name: str
    index: int  # among the training views
    sensor: mi.Sensor
    photograph: Target
    target: Target  # what is compared with: the photograph, unless an effect replaces it
    width: int  # px
    height: int  # px
    counted: float  # share of the pixels that count: those that no mask leaves out
    uploads: dict[str, Any]  # by effect: what it needs of the view, Dr.Jit arrays in any PyTree
