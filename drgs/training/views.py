"""One training photograph: its sensor, what is rendered is compared with, and effects' uploads.

What depends on pictures is made when an iteration asks for it, from what the dataset keeps, and
stays on the device as long as there is room: see :class:`drgs.training.stages.Stage`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import mitsuba as mi

from drgs.training.losses import Target


class TrainingView:
    """A photograph of the training split, at the size of one stage; in display space."""

    def __init__(
        self,
        name: str,
        index: int,
        sensor: mi.Sensor,
        size: tuple[int, int],
        count: Callable[[], float],
        make_target: Callable[[], Target],
        makers: Mapping[str, Callable[[], Any]],
    ) -> None:
        """index: among the training views; size: W, H, px; count: makes ``counted``.

        make_target: makes the photograph's target; makers: by effect, make its upload.
        """
        self.name, self.index, self.sensor = name, index, sensor
        self.width, self.height = size
        self.uploads = Uploads(makers)
        self.replacement: Target | None = None  # an effect's
        self._make_target, self._photograph, self._count = make_target, None, count

    @cached_property
    def counted(self) -> float:
        """The share of the pixels that count: those that no mask leaves out."""
        return self._count()

    @property
    def photograph(self) -> Target:
        """The photograph on the device."""
        if self._photograph is None:
            self._photograph = self._make_target()
        return self._photograph

    @property
    def target(self) -> Target:
        """What is compared with: the photograph, unless an effect replaces it."""
        return self.photograph if self.replacement is None else self.replacement

    def let_go(self) -> None:
        """Free what was made of the pictures; it is made again when it is asked for."""
        self._photograph = None
        self.uploads.clear()


class Uploads(dict[str, Any]):
    """By effect: what it needs of a view, Dr.Jit arrays in any PyTree, made when it is needed."""

    def __init__(self, makers: Mapping[str, Callable[[], Any]]) -> None:
        super().__init__()
        self._makers = makers

    def __missing__(self, effect: str) -> Any:
        """What the effect of this name uploads."""
        self[effect] = made = self._makers[effect]()
        return made
