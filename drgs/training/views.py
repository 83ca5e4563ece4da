"""A training photograph: its sensor, the target of its rendering, and effects' uploads.

Targets and uploads are computed from the dataset when an iteration needs them, and stay on the
device while there is room: see :class:`drgs.training.steps.Stage`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np

from drgs.datasets.types import View
from drgs.training.losses import Target


class TrainingView:
    """A photograph of the training split, at the size of one stage; in display space."""

    def __init__(
        self,
        view: View,
        index: int,
        sensor: mi.Sensor,
        make_target: Callable[[], Target],
        makers: Mapping[str, Callable[[], object]],
    ) -> None:
        """index: among the training views; makers: by effect, make its upload."""
        self.name, self.width, self.height = view.name, view.width, view.height
        self.index, self.sensor = index, sensor
        self.uploads = Uploads(makers)
        self.replacement: Target | None = None  # an effect's
        self._view, self._make_target = view, make_target

    @cached_property
    def counted_share(self) -> float:
        """The share of pixels that are not masked."""
        mask = self._view.mask
        return 1.0 if mask is None else max(float(np.asarray(mask).mean()), 1e-10)

    @cached_property
    def photograph(self) -> Target:
        """The photograph on the device."""
        return self._make_target()

    @property
    def target(self) -> Target:
        """The photograph that renderings are compared with, unless an effect replaces it."""
        return self.photograph if self.replacement is None else self.replacement

    def free(self) -> None:
        """Free target and uploads; they are computed again when needed."""
        self.__dict__.pop("photograph", None)
        self.uploads.clear()


class Uploads(dict[str, Any]):
    """Device arrays of a view by effect, in any PyTree, made when they are needed."""

    def __init__(self, makers: Mapping[str, Callable[[], object]]) -> None:
        super().__init__()
        self._makers = makers

    def __missing__(self, effect: str) -> object:
        """Make the upload of an effect."""
        self[effect] = made = self._makers[effect]()
        return made
