"""Effects between rendering and the loss, and the views and the state of a fit that they see."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.extensions import EFFECTS, extensions_in_use, section_of
from drgs.config.schema import FitConfig
from drgs.core.arrays import from_host
from drgs.core.errors import UserError
from drgs.core.types import Float, TensorXf
from drgs.datasets.images import with_arrays
from drgs.datasets.types import Dataset, View
from drgs.integrator.state import SplatsPlugin
from drgs.training.findings import Finding, ShortFit
from drgs.training.losses import Target, prepare_target


class TrainingView:
    """A photograph of the training split, at the size of one stage; in display space.

    Targets and uploads are computed from the dataset when an iteration needs them, and stay on the
    device while there is room: see :class:`drgs.training.steps.Stage`.
    """

    def __init__(
        self,
        view: View,
        index: int,
        sensor: mi.Sensor,
        effects: Sequence[TrainingEffect],
        window: tuple[int, float],
    ) -> None:
        """index: among the training views; window: width and sigma of SSIM's window, px."""
        self.name, self.width, self.height = view.name, view.width, view.height
        self.index, self.sensor = index, sensor
        self.uploads = Uploads(self, effects)
        self.replacement: Target | None = None  # an effect's
        self._view, self._effects, self._window = view, effects, window
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
            image = effect.target_image(view, image)
        return prepare_target(as_tensor(image), *self._window)

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
    begins_stage: bool  # whether the images have other sizes than in the step before
    rate_decay: float  # the means' learning rate, relative to the initial one
    integrator: SplatsPlugin  # renders the fit
    means: TensorXf  # (N, 3), world
    views: list[TrainingView]  # the training views, at the image size that is in use
    effects: Sequence[TrainingEffect]

    def sensors(self) -> list[mi.Sensor]:
        """Return the sensors of all training views, placed by the effects without derivatives."""
        for effect in self.effects:
            for view in self.views:
                effect.place(view)
        return [view.sensor for view in self.views]


class TrainingEffect(Protocol):
    """Base class of effects, which does nothing; images are (H, W, C) in display space."""

    @classmethod
    def is_used(cls, config: FitConfig, dataset: Dataset) -> bool:
        """Return whether the effect takes part in a fit.

        Called for effects of installed packages whose section the configuration contains.
        """
        return True

    @classmethod
    def from_config(cls, config: FitConfig, dataset: Dataset, section: Any) -> TrainingEffect:
        """Return the effect of a fit.

        section: the section that the effect has registered, with the values of the configuration;
        by default the only argument of the class. None: the effect has no section.
        """
        make = cast("Callable[..., TrainingEffect]", cls)
        return make() if section is None else make(section)

    @classmethod
    def look_for(cls, fit: ShortFit) -> Finding | None:
        """Return what a short fit without the effect shows of it; None: nothing can be said.

        See :mod:`drgs.examine.examination`, which tries and chooses what is likely.
        """
        return None

    name = ""  # of its part of a checkpoint, and of its uploads
    moves_sensors = False  # whether it changes the parameters of sensors
    aovs = ""  # outputs of the integrator besides colour
    upload_bytes = 0  # of a pixel: its upload of a view, at most
    by_row: frozenset[str] = frozenset()  # names in its state that have a row for each Gaussian

    def upload(self, view: View) -> object:
        """Return the effect's data of a view, on the device: see ``TrainingView.uploads``."""

    def target_image(self, view: View, image: np.ndarray) -> np.ndarray:
        """Return the photograph (H, W, 3) that a rendering is compared with."""
        return image

    def place(self, view: TrainingView) -> None:
        """Put the view's sensor where the effect has it now; without derivatives."""

    def begin(self, fit: FitState) -> None:
        """Called before the views of a step are rendered."""

    def before_render(self, fit: FitState, view: TrainingView) -> None:
        """Called before the view is rendered."""

    def adjust(self, image: TensorXf, view: TrainingView) -> TensorXf:
        """Return the image that is compared with the photograph, from the rendered one."""
        return image

    def penalties(self, view: TrainingView) -> Iterator[Float]:
        """Yield terms of the loss, Float of one value each; called after :meth:`adjust`."""
        yield from ()

    def leaves(self, view: TrainingView) -> Mapping[str, dr.ArrayBase]:
        """Return the optimised numbers of a view, attached, as :meth:`before_render` has them.

        With several processes, each has the numbers of all views.
        """
        return {}

    def after_backward(
        self, fit: FitState, view: TrainingView, derivatives: Mapping[str, dr.ArrayBase]
    ) -> None:
        """Take a step, when the derivatives of all views of the fit's step are known.

        derivatives: of the step's loss, with respect to the view's :meth:`leaves`. Called in the
        order of the views, on all processes.
        """

    def on_population_change(self, fit: FitState) -> None:
        """Called after Gaussians were added or removed, before the integrator is updated."""

    def finish(self, fit: FitState) -> None:
        """Called before the Gaussians are taken out."""

    def correct_views(self, views: tuple[View, ...]) -> tuple[View, ...]:
        """Return views that were not trained on, with the cameras' corrections by the fit."""
        return views

    def write(self, folder: Path, dataset: Dataset) -> None:
        """Write the effect's results for the training views into the output folder."""

    def numbers_of(self, view: TrainingView) -> Mapping[str, dr.ArrayBase]:
        """Return the optimised numbers of a view: Float by name, without derivatives."""
        return {}

    def values(self) -> dict[str, np.ndarray]:
        """Return all optimised numbers and moments: a row for each training view, or for all."""
        return {}

    def state(self) -> dict[str, np.ndarray]:
        """Return the state that the coming iterations depend on."""
        return {}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from :meth:`state`."""


def training_effects(
    config: FitConfig, dataset: Dataset, given: Sequence[TrainingEffect] = ()
) -> list[TrainingEffect]:
    """Return the effects that take part in a fit, in the order in which they act.

    given: effects besides those of the configuration, which act first.
    """
    installed = extensions_in_use(config.extensions, EFFECTS)
    used = [each for each in installed if each.value.is_used(config, dataset)]
    used += [EFFECTS.get(n) for n in EFFECTS.shipped_names if _is_shipped_used(n, config, dataset)]
    effects = [*given]
    for extension in used:
        section = section_of(extension, config.extensions)
        effects.append(extension.value.from_config(config, dataset, section))
    names = [effect.name for effect in effects]
    if "" in names or len({*names}) < len(names):
        raise UserError(f"effects: names must be unique, got {', '.join(names)}")
    return effects


def _is_shipped_used(name: str, config: FitConfig, dataset: Dataset) -> bool:
    """Return whether a shipped effect is used; its module is imported only then."""
    views = dataset.train
    if name == "depth":
        return config.loss.depth_weight > 0 and any(view.depth is not None for view in views)
    if name == "masks":
        return any(view.mask is not None for view in views)
    return {
        "colors": config.colors.lr is not None,
        "photometry": (config.colors.vignetting_lr, config.colors.response_lr) != (None, None),
        "background": config.data.random_background,
        "smoothing": config.model.smoothing,
        "cameras": config.cameras.optimise,
    }[name]


def integrator_settings(effects: Sequence[TrainingEffect]) -> dict[str, str]:
    """Return the settings of the integrator that effects need."""
    aovs = ", ".join(effect.aovs for effect in effects if effect.aovs)
    return {"aovs": aovs} if aovs else {}


def as_numbers(values: np.ndarray) -> Float:
    """Upload an array as a flat one."""
    return cast(Float, from_host(mi.Float, values))


def as_tensor(values: np.ndarray) -> TensorXf:
    """Upload an array of any shape."""
    return cast(TensorXf, mi.TensorXf(from_host(mi.Float, values), values.shape))


def opacity_of(view: View) -> TensorXf | None:
    """Upload a photograph's opacity, (H, W, 3); None where it is opaque everywhere."""
    if view.alpha is None:
        return None
    return as_tensor(np.repeat(np.asarray(view.alpha)[:, :, None], 3, axis=2))
