"""The iterations of a fit: what the command and the library run alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import mitsuba as mi

from drgs.config.load import config_from, load_config
from drgs.config.schema import FitConfig
from drgs.datasets import Dataset, load_dataset
from drgs.datasets.folders import config_for
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.start import initial_gaussians
from drgs.integrator.scene import check_lenses
from drgs.training.budget import AllIterations
from drgs.training.history import History, HistoryRow
from drgs.training.trainer import StepReport, Trainer


class Length(Protocol):
    """When a fit ends: see :class:`drgs.training.budget.AllIterations`."""

    def goes_on(self, trainer: Trainer) -> bool:
        """Whether there is another iteration."""

    def total(self, trainer: Trainer) -> int:
        """Iterations in all."""


@dataclass(frozen=True)
class Iteration:
    """A step that is done, of an iteration or several."""

    report: StepReport
    row: HistoryRow | None  # of the history, where this iteration is written down
    is_last: bool


class Observer(Protocol):
    """Somebody who is told of a fit as it runs; its result has the same bytes without them."""

    def after(
        self, trainer: Trainer, history: History, done: Iteration, stops: Callable[[], bool]
    ) -> None:
        """Called after an iteration, by the thread that fits; history: with its row, if it has one.

        stops: whether the fit is to stop at once, which an observer that waits has to ask.
        """


def iterations(trainer: Trainer, history: History, length: Length) -> Iterator[Iteration]:
    """Run the iterations that are left, a step each time that the next one is asked for.

    Rows are added to ``history`` every ``output.history_every`` iterations, and for the last one.

    Raises ``NonFiniteError``, at a row of the history or at a change of the population, if a loss,
    a gradient or a value is not finite.
    """
    goes_on = length.goes_on(trainer)
    while goes_on:
        report, row = trainer.step(), None
        if report.density is not None:
            history.add_density(report.iteration, report.density)
        goes_on = length.goes_on(trainer)
        if not goes_on or report.passes(trainer.config.output.history_every):
            row = history.add(report)
            trainer.check_iterations()  # reading the row has waited for the device
        yield Iteration(report, row, is_last=not goes_on)


def as_saved(gaussians: Gaussians, trainer: Trainer) -> Gaussians:
    """What ``point_cloud.ply`` holds: with ``output.bake_smoothing``, the filter in the Gaussians.

    Its header says which approximations are not the default. gaussians: what
    ``trainer.gaussians()`` gave.
    """
    others = trainer.config.model.approximations.others_than_default
    gaussians = replace(gaussians, rendered_with=others or None)
    if not trainer.config.output.bake_smoothing:
        return gaussians
    from drgs.effects.smoothing import baked

    return baked(gaussians)


@dataclass(frozen=True)
class FitResult:
    """What a fit in memory gives."""

    gaussians: Gaussians  # numpy arrays: what ``point_cloud.ply`` of the command holds
    history: tuple[HistoryRow, ...]  # as in ``history.csv``
    trainer: Trainer  # goes on from here with ``trainer.step()``, renders with ``pictures(views)``


def train(
    config: FitConfig | Mapping[str, object] | str | Path,
    dataset: Dataset | None = None,
    callback: Callable[[StepReport], bool | None] | None = None,
) -> FitResult:
    """Fit Gaussians to photographs, in memory: the bytes that ``drgs fit`` writes to its PLY file.

    config: what to fit, and how: the path of a YAML file, or of the folder of a dataset, to have
    that chosen (``drgs.datasets.folders``); the same as nested mappings, or a
    :class:`drgs.config.schema.FitConfig`; dataset: the photographs, whose background is that of
    the splats, by default those of the configuration's section ``data``; callback: called after
    each iteration with what it did, a :class:`drgs.training.trainer.StepReport`; the fit ends early
    where it returns True.

    Where no Mitsuba variant is active, ``llvm_ad_rgb`` is made so. Nothing is written.

    Raises ``drgs.core.errors.UserError`` (a ValueError) for wrong input, naming the key and the
    remedy, and ``drgs.training.finite_checks.NonFiniteError`` if a number is not finite.
    """
    if isinstance(config, (str, Path)):
        is_folder = Path(config).is_dir()
        config = config_for(Path(config))[0] if is_folder else load_config(config)
    elif not isinstance(config, FitConfig):
        config = config_from(config, "train(): config")
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    if dataset is None:
        dataset = load_dataset(config.data_for_training)
    views, remedy = (*dataset.train, *dataset.test), "set data.ignore_distortion"
    check_lenses(config.model, views, "train(): ", remedy)
    trainer = Trainer(config, dataset, initial_gaussians(config, dataset))
    history = History()
    for done in iterations(trainer, history, AllIterations()):
        if callback is not None and callback(done.report):
            break
    gaussians = as_saved(trainer.gaussians(), trainer)
    return FitResult(gaussians, tuple(history.rows), trainer)
