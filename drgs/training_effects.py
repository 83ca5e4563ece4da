"""What a scene calls for between rendering and the loss: composed into a fit, or not there.

Layer 4. A :class:`TrainingEffect` takes part in each iteration of :class:`drgs.trainer.Trainer`.
``drgs.effects`` says which ones a configuration and a dataset call for, and imports them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.data.types import View

if TYPE_CHECKING:
    from drgs.trainer import Trainer, TrainingView


class TrainingEffect:
    """Does nothing; effects override what they need."""

    name = ""  # of its part of a checkpoint, and of what it uploads
    moves_sensors = False  # whether it changes the parameters of sensors
    aovs = ""  # what the integrator has to put out besides colour

    def upload(self, view: View) -> Any:
        """What the effect needs of a view, on the device; kept with the view."""
        del view

    def target_image(self, view: View, image: np.ndarray) -> np.ndarray:
        """The photograph (H, W, 3) that a rendering is compared with."""
        del view
        return image

    def place(self, view: TrainingView) -> None:
        """Put the view's sensor where the effect has it now; without derivatives."""

    def before(self, trainer: Trainer, view: TrainingView) -> None:
        """Called before the view is rendered."""

    def adjust(self, image: Any, view: TrainingView) -> Any:
        """What is compared with the photograph, from what was rendered; tensors (H, W, C)."""
        del view
        return image

    def penalties(self, view: TrainingView) -> Iterator[Any]:
        """Terms of the loss, Float of one value each; after :meth:`adjust`."""
        del view
        yield from ()

    def after(self, trainer: Trainer, view: TrainingView) -> None:
        """Called when the derivatives are known, to take a step of its own."""

    def repopulated(self, trainer: Trainer) -> None:
        """Called when Gaussians were added or removed, before the integrator gets the others."""

    def finish(self, trainer: Trainer) -> None:
        """Called before the Gaussians are taken out."""

    def measured(self, views: tuple[View, ...]) -> tuple[View, ...]:
        """Views of other photographs, with what the fit found out about their cameras."""
        return views

    def write(self, folder: Path, views: tuple[View, ...]) -> None:
        """Write what was found into the output folder; views: those of the training split."""

    def numbers_of(self, view: TrainingView) -> dict[str, Any]:
        """What it has optimised that the view depends on: Float by name, without derivatives."""
        del view
        return {}

    def values(self) -> dict[str, np.ndarray]:
        """All that it optimises, and its moments: a row for each training view, or for all."""
        return {}

    def state(self) -> dict[str, np.ndarray]:
        """What the coming iterations depend on."""
        return {}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from :meth:`state`."""
