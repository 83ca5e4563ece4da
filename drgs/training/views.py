"""The views of a fit, and its state at an iteration, as effects get them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np

from drgs.cameras.camera import Camera
from drgs.core.types import TensorXf
from drgs.datasets.images import with_arrays
from drgs.datasets.types import View
from drgs.effects.base import TrainingEffect, as_tensor
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.integrator.state import SplatsPlugin
from drgs.training.contracts import checked_image
from drgs.training.losses import Target, prepare_target


class TrainingView:
    """A photograph of the training split, at the size of one stage; in display space.

    Targets and uploads are computed from the dataset when an iteration needs them, and stay on the
    device while there is room: see :class:`drgs.training.steps.ResolutionPhase`.
    """

    def __init__(
        self, view: View, index: int, sensor: mi.Sensor, effects: Sequence[TrainingEffect]
    ) -> None:
        """index: among the training views"""
        self.name, self.width, self.height = view.name, view.width, view.height
        self.index, self.sensor = index, sensor
        self.uploads = Uploads(self, effects)
        self.replacement: Target | None = None  # an effect's
        self._view, self._effects = view, effects
        self._ahead: Future[View] | None = None

    def read_ahead(self, thread: Executor) -> None:
        """Let a thread compute the images, which are on disk, for the next use of them."""
        if self._ahead is None:
            self._ahead = thread.submit(with_arrays, self._view)

    @property
    def dataset_view(self) -> View:
        """The dataset's view; its images are arrays if they were read ahead."""
        return self._view if self._ahead is None else self._ahead.result()

    @cached_property
    def counted_share(self) -> float:
        """The share of pixels that are not masked."""
        mask = self.dataset_view.mask
        return 1.0 if mask is None else max(float(np.asarray(mask).mean()), 1e-10)

    @cached_property
    def photograph(self) -> Target:
        """The photograph on the device."""
        view = self.dataset_view
        image = np.asarray(view.image)
        for effect in self._effects:
            image = checked_image(effect, "target_image", effect.target_image(view, image), image)
        return prepare_target(as_tensor(image))

    def replace_photograph(self, image: TensorXf) -> None:
        """Compare the coming rendering with another image, (H, W, 3)."""
        self.replacement = prepare_target(image)

    @property
    def target(self) -> Target:
        """The photograph that renderings are compared with, unless an effect replaces it."""
        return self.photograph if self.replacement is None else self.replacement

    def free(self) -> None:
        """Free target and uploads; they are computed again when needed."""
        self.__dict__.pop("photograph", None)
        self.uploads.clear()
        self._ahead = None


class Uploads(dict[str, Any]):
    """Device arrays of a view by effect, in any PyTree, made when they are needed."""

    def __init__(self, owner: TrainingView, effects: Sequence[TrainingEffect]) -> None:
        super().__init__()
        self._owner, self._effects = owner, {effect.name: effect for effect in effects}

    def __missing__(self, name: str) -> object:
        self[name] = upload = self._effects[name].upload(self._owner.dataset_view)
        return upload


@dataclass(frozen=True)
class FitState:
    """State of a fit at one iteration, for effects."""

    iteration: int  # from 1
    iterations_of_step: range
    begins_phase: bool  # whether the images have other sizes than in the step before
    rate_decay: float  # the means' learning rate, relative to the initial one
    integrator: SplatsPlugin  # renders the fit
    means: TensorXf  # (N, 3), world
    views: list[TrainingView]  # the training views, at the image size that is in use
    effects: Sequence[TrainingEffect]

    def cameras(self) -> Iterator[Camera]:
        """Yield the cameras of all training views, placed by the effects without derivatives."""
        for effect in self.effects:
            for view in self.views:
                effect.place(view)
        for view in self.views:
            yield camera_from_sensor(read_sensor(view.sensor, self.integrator.near))
