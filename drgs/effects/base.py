"""Effects: the base class of those of a fit, and what all effects declare.

An effect is one file: what enables it, and its line in the summary; the section of its settings;
its part in a fit; its files; and its stage in an image, where it has one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.extensions import EFFECTS, section_of
from drgs.core.arrays import from_host
from drgs.core.errors import UserError
from drgs.core.types import Float, TensorXf

if TYPE_CHECKING:
    from drgs.config.schema import FitConfig
    from drgs.datasets.types import Dataset, Pixels, View
    from drgs.gaussians.parameters import Gaussians
    from drgs.results.alignment import Alignment
    from drgs.training.views import FitState, TrainingView


@dataclass(frozen=True)
class SimulatedEffect:
    """An effect in a summary, simulated or not."""

    name: str
    what: str | None  # description; None: not simulated
    why: str = ""  # the setting or data that it comes from
    ignored: bool = False  # whether a setting switches it off

    def unless_ignored(self, is_ignored: bool) -> SimulatedEffect:
        """Return the effect, not simulated if it ``is_ignored``."""
        if is_ignored and self.what is not None:
            return replace(self, what=None, ignored=True)
        return self

    @staticmethod
    def from_data(name: str, values: Sequence[object], what: str) -> SimulatedEffect:
        """Return an effect of data that some views have; values: of the views, or None."""
        count = sum(value is not None for value in values)
        why = f"the dataset's {name}, in {count} views"
        return SimulatedEffect(name, what if count else None, why)


def join_parts(*parts: str | None) -> str | None:
    """Join the parts that are not None by commas; None if there is none."""
    return ", ".join(part for part in parts if part) or None


def antialiasing_effect(opacities: str | None, smoothing: str | None) -> SimulatedEffect:
    """Summarise it from the reasons for compensated opacities and for the smoothing filter."""
    what = join_parts(
        "opacities compensated for the low-pass filter" if opacities else None,
        "3D smoothing filter" if smoothing else None,
    )
    return SimulatedEffect("antialiasing", what, join_parts(opacities, smoothing) or "")


@dataclass(frozen=True, eq=False)
class ShortFit:
    """A fit of few iterations to small photographs, some of which were held out."""

    config: FitConfig
    dataset: Dataset  # ``test``: the held-out training photographs, of all folds
    gaussians: Gaussians  # numpy arrays
    images: Sequence[np.ndarray]  # (H, W, 3) display space: renderings of the held-out views
    alignments: Sequence[Alignment]  # of these
    factor: int  # px of the dataset's photographs in one of the fit's
    wall_s: float  # of its iterations, in the first fold
    trained: Sequence[Alignment] = ()  # of the first fold's training views; without effects alone
    trained_images: Sequence[np.ndarray] = ()  # (H, W, 3) display space, of these
    num_folds: int = 1

    @property
    def psnr(self) -> np.ndarray:
        """The held-out views' PSNR, (V,) dB, with the differences of a camera removed."""
        return np.array([alignment.psnr for alignment in self.alignments])


@dataclass(frozen=True)
class Finding:
    """The evidence of a short fit for an effect that it does not simulate, or against it."""

    effect: str  # a name for the table
    evidence: str  # in a few words, with numbers
    is_likely: bool  # whether it is worth a short fit with the effect
    changes: Mapping[str, object]  # values of the configuration that simulate it, by key
    in_short_fits: Mapping[str, object] = field(default_factory=dict)  # further ones, such as rates
    advice: str = ""  # what to do where it is not chosen; in place of changes, if no fit has any
    confirm: Callable[[ShortFit], Finding | None] | None = None
    """Returns the finding with the evidence of the fit that has the effect; None: it has none."""
    is_measured: bool = False  # whether the evidence is enough to choose it, without such a fit


def trimmed_deviation(values: np.ndarray) -> float:
    """Return the root mean square of values, without the tenth of them that is largest."""
    squares = np.sort(np.square(values))
    return float(np.sqrt(squares[: len(squares) - math.ceil(len(squares) / 10)].mean()))


Progress = Callable[[str, int, int], None]  # what is tried, iterations done, and of how many


class ChosenEffects(Protocol):
    """Values of a configuration that were chosen for a dataset, with the evidence."""

    @property
    def changes(self) -> Mapping[str, object]:
        """The values by key."""
        ...

    @property
    def reasons(self) -> Mapping[str, str]:
        """The evidence for each of these, by key."""
        ...

    def to_json(self) -> str:
        """Return everything as JSON, with ``changes``."""
        ...


Examiner = Callable[["Dataset", "FitConfig", Progress | None, float | None], ChosenEffects]
"""Chooses effects for a dataset and a configuration, whose own values stay, within some seconds."""


class TrainingEffect(Protocol):
    """Base class of effects of a fit, which does nothing; images are (H, W, C), display space."""

    name: ClassVar[str] = ""  # under which it is registered; of its part of a checkpoint
    order: ClassVar[int] = 0  # effects act in ascending order
    moves_sensors = False  # whether it changes the parameters of sensors
    aovs = ""  # outputs of the integrator besides colour
    upload_bytes = 0  # of a pixel: its upload of a view, at most
    by_row: frozenset[str] = frozenset()  # names in its state that have a row for each Gaussian
    has_numbers: ClassVar[bool] = False  # whether :meth:`write` writes NAME.json by default
    files: ClassVar[tuple[str, ...]] = ()  # that :meth:`write` writes instead

    @classmethod
    def is_used(cls, config: FitConfig, dataset: Dataset) -> bool:
        """Return whether the effect takes part in a fit: by default, if the summary has it."""
        return any(line.what is not None for line in cls.summarize(config, dataset))

    @classmethod
    def summarize(cls, config: FitConfig, dataset: Dataset) -> list[SimulatedEffect]:
        """Return the effect's lines in the summary of a fit, with what enables it.

        By default, its section does. A line of a name that the summary has replaces that line.
        """
        if cls.name not in config.sections:
            return []
        extension = EFFECTS.get(cls.name)
        return [SimulatedEffect(cls.name, f"{extension.kind}: {extension.summary}", cls.name)]

    @classmethod
    def from_config(cls, config: FitConfig, dataset: Dataset, section: Any) -> TrainingEffect:
        """Return the effect of a fit.

        section: the section that the effect has registered, with the values of the configuration;
        by default the only argument of the class. None: the effect has no section.
        """
        make = cast("Callable[..., TrainingEffect]", cls)
        return make() if section is None else make(section)

    @classmethod
    def look_for(cls, fit: ShortFit) -> Finding | Sequence[Finding] | None:
        """Return what a short fit without the effect shows of it; None: nothing can be said.

        ``drgs examine`` tries what is likely, and chooses what is worth it.
        """
        return None

    def check(self, dataset: Dataset) -> None:
        """Raise :class:`UserError` for a dataset whose views the effect does not fit."""

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
    """Return a fit's effects in the order in which they act; given: besides the configuration's."""
    effects = [*given]
    for extension in EFFECTS.all():
        if extension.value.is_used(config, dataset):
            section = section_of(extension, config.sections)
            effects.append(extension.value.from_config(config, dataset, section))
    effects.sort(key=lambda effect: effect.order)
    for effect in effects:
        effect.check(dataset)
    names = [effect.name for effect in effects]
    if "" in names or len({*names}) < len(names):
        raise UserError(f"effects: names must be unique, got {', '.join(names)}")
    return effects


def integrator_settings(effects: Sequence[TrainingEffect]) -> dict[str, str]:
    """Return the settings of the integrator that effects need."""
    aovs = ", ".join(effect.aovs for effect in effects if effect.aovs)
    return {"aovs": aovs} if aovs else {}


def entries(values: Float) -> list[mi.Float]:
    """Return the entries as arrays of one, that are not compiled into the kernel."""
    return [dr.gather(mi.Float, values, mi.UInt32(k)) for k in range(dr.width(values))]


def as_numbers(values: np.ndarray) -> Float:
    """Upload an array as a flat one."""
    return cast(Float, from_host(mi.Float, values))


def as_tensor(values: np.ndarray) -> TensorXf:
    """Upload an array of any shape."""
    return cast(TensorXf, mi.TensorXf(from_host(mi.Float, values), values.shape))


def as_channels(plane: Pixels) -> TensorXf:
    """Upload a plane (H, W) for each of three channels, (H, W, 3)."""
    return as_tensor(np.repeat(np.asarray(plane)[:, :, None], 3, axis=2))
