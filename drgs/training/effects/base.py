"""What a scene calls for between rendering and the loss: composed into a fit, or not there.

A :class:`TrainingEffect` takes part in each iteration of a fit, of which it knows a
:class:`FitState`. ``drgs.training.effects.registry`` chooses those that a configuration and a
dataset use, and imports them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import mitsuba as mi
import numpy as np

from drgs.config.schema import FitConfig
from drgs.core.arrays import from_host
from drgs.datasets.types import Dataset, View
from drgs.training.views import TrainingView


@dataclass(frozen=True)
class FitState:
    """State of a fit at one iteration, as effects may know it."""

    iteration: int  # from 1
    iterations_of_step: range
    begins_stage: bool  # whether the images have other sizes than in the step before
    rate_decay: float  # the means' learning rate, relative to the initial one
    integrator: Any  # splats, which renders the fit
    means: Any  # TensorXf (N, 3), world
    views: list[TrainingView]  # the training views, at the image size that is in use
    effects: Sequence[TrainingEffect]

    def sensors(self) -> list[mi.Sensor]:
        """Return the sensors of all training views, placed by the effects without derivatives."""
        for effect in self.effects:
            for view in self.views:
                effect.place(view)
        return [view.sensor for view in self.views]


class TrainingEffect(Protocol):
    """What the trainer asks of an effect; effects derive from it and override what they need.

    As it is here, an effect does nothing. Images are tensors (H, W, C) in display space.
    """

    @classmethod
    def from_config(cls, config: FitConfig, dataset: Dataset, section: Any) -> Any:
        """Return the effect of a fit.

        section: the section that the effect has registered, with the values of the configuration;
        by default the only argument of the class. None: the effect has no section.
        """
        del config, dataset
        return cls() if section is None else cls(section)

    name = ""  # of its part of a checkpoint, and of what it uploads
    moves_sensors = False  # whether it changes the parameters of sensors
    aovs = ""  # what the integrator has to put out besides colour
    upload_bytes = 0  # of a pixel: what it uploads of a view's pictures, at most
    by_row: frozenset[str] = frozenset()  # names in its state that have a row for each Gaussian

    def upload(self, view: View) -> Any:
        """What the effect needs of a view, on the device: see ``TrainingView.uploads``."""
        del view

    def target_image(self, view: View, image: np.ndarray) -> np.ndarray:
        """The photograph (H, W, 3) that a rendering is compared with."""
        del view
        return image

    def place(self, view: TrainingView) -> None:
        """Put the view's sensor where the effect has it now; without derivatives."""

    def begin(self, fit: FitState) -> None:
        """Called before the views of a step are rendered."""

    def before(self, fit: FitState, view: TrainingView) -> None:
        """Called before the view is rendered."""

    def adjust(self, image: Any, view: TrainingView) -> Any:
        """What is compared with the photograph, from what was rendered; tensors (H, W, C)."""
        del view
        return image

    def penalties(self, view: TrainingView) -> Iterator[Any]:
        """Terms of the loss, Float of one value each; after :meth:`adjust`."""
        del view
        yield from ()

    def leaves(self, view: TrainingView) -> dict[str, Any]:
        """What it optimises of the view, as :meth:`before` has left it: by name, with derivatives.

        Where several processes fit, each knows the numbers of all views.
        """
        del view
        return {}

    def after(self, fit: FitState, view: TrainingView, derivatives: dict[str, Any]) -> None:
        """Called when those of all views of a step are known, to take a step of its own.

        derivatives: of the step's loss, with respect to the view's :meth:`leaves`. Called in the
        order of the views, of which this process may have rendered some alone.
        """

    def repopulated(self, fit: FitState) -> None:
        """Called when Gaussians were added or removed, before the integrator gets the others."""

    def finish(self, fit: FitState) -> None:
        """Called before the Gaussians are taken out."""

    def measured(self, views: tuple[View, ...]) -> tuple[View, ...]:
        """Views of other photographs, with what the fit found out about their cameras."""
        return views

    def write(self, folder: Path, dataset: Dataset) -> None:
        """Write what was found for the training views into the output folder."""

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


def as_tensor(values: np.ndarray) -> mi.TensorXf:
    """Upload an array of any shape."""
    return mi.TensorXf(from_host(mi.Float, values), values.shape)
