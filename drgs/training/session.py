"""A fit from its configuration to its result: the program of ``drgs fit`` and ``drgs.train``.

    configuration -> dataset -> initial Gaussians -> (plan) -> trainer -> iterations -> results

Two collaborators touch the world outside: :class:`drgs.training.fit_folder.FitFolder` reads and
writes files, :class:`Console` prints, draws progress and takes Ctrl-C. Without a folder nothing is
written; the trainer is called alike with and without them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi

from drgs.cli.ending import StopRequest
from drgs.cli.execution import select_variant
from drgs.cli.progress import RunProgress
from drgs.config.load import config_from, load_config
from drgs.config.schema import FitConfig
from drgs.core.environment import VARIANTS
from drgs.core.errors import UserError, UserNote
from drgs.core.memory import release_unused_memory
from drgs.core.registry import reporting_extensions
from drgs.datasets import Dataset, load_dataset
from drgs.datasets.fingerprint import Fingerprint, fingerprint_of
from drgs.datasets.folders import config_for
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.defaults import completed
from drgs.initialization.start import description_of_start, gaussians_at, start_of
from drgs.integrator.scene import check_lenses
from drgs.integrator.summary import described
from drgs.training.budget import Budget, Deadline, Plan, plan_fit, rehearse
from drgs.training.checkpoint import Checkpoint, check_fits, check_same_data, save_checkpoint
from drgs.training.density.strategy import DensityStrategy
from drgs.training.effects.base import TrainingEffect
from drgs.training.finite_checks import NonFiniteError
from drgs.training.fit_folder import FitFolder, saved_gaussians
from drgs.training.history import History, HistoryRow, smoother
from drgs.training.loop import (
    AllIterations,
    Iteration,
    Observer,
    RootDecides,
    StopCriterion,
    iterations,
)
from drgs.training.losses import Loss
from drgs.training.parallel.communicator import Communicator
from drgs.training.parallel.inputs import share_gaussians, share_inputs
from drgs.training.quality import HeldOutQuality
from drgs.training.summary import summary_of_fit
from drgs.training.trainer import StepReport, Trainer

if TYPE_CHECKING:  # imported where it is needed
    from drgs.training.viewers import ForViewers


class Console:
    """The terminal of a command: printed lines, a progress bar, Ctrl-C as a request to stop."""

    def say(self, text: str) -> None:
        """Print a line."""
        print(text)

    def progress(self, what: str, total: int, done: int = 0) -> AbstractContextManager[RunProgress]:
        """See :class:`drgs.cli.progress.RunProgress`."""
        return RunProgress(what, total, done)

    def stop_request(self) -> AbstractContextManager[StopRequest]:
        """See :class:`drgs.cli.ending.StopRequest`."""
        return StopRequest()


class Silence:
    """A console that prints nothing and leaves Ctrl-C to others: of a fit within a program."""

    requested = False

    def say(self, text: str) -> None:
        """Print nothing."""

    def progress(self, what: str, total: int, done: int = 0) -> AbstractContextManager[Silence]:
        """Return what draws no progress."""
        return nullcontext(self)

    def update(self, done: int, total: int, status: str = "") -> None:
        """Draw nothing."""

    def stop_request(self) -> AbstractContextManager[Silence]:
        """Return a request that is never made."""
        return nullcontext(self)


class ShownProgress:
    """Draws the progress of a fit: see :class:`drgs.training.loop.Observer`."""

    def __init__(self, progress: RunProgress | Silence, criterion: StopCriterion) -> None:
        self._progress, self._criterion = progress, criterion
        self._psnr: float | None = None  # dB, smooth

    def after(
        self, trainer: Trainer, history: History, done: Iteration, stops: Callable[[], bool]
    ) -> None:
        """Draw the last row of the history."""
        del history, stops
        if (row := done.row) is not None:
            self._psnr = smoother(self._psnr, row.psnr)
            status = f"loss {row.loss:.4f}  PSNR {self._psnr:5.2f} dB  "
            status += f"Gaussians {row.num_gaussians:,}"
            self._progress.update(row.iteration, self._criterion.num_iterations(trainer), status)


@dataclass(eq=False)
class FitSession:
    """One fit, by one process or several, which all run the same session.

    Rank 0 alone is given a configuration, a folder and a console, and decides when to stop.
    """

    config: FitConfig | None
    dataset: Dataset | None = None  # None: that of the configuration
    folder: FitFolder | None = None  # for results and checkpoints
    console: Console | Silence = field(default_factory=Silence)
    variant: str | None = None  # of Mitsuba; None: the active one
    budget: Budget | None = None  # the time for which the fit is planned
    check_ranges: Callable[[], None] = lambda: None  # called after each iteration
    on_start: Callable[[FitSession], None] = lambda session: None  # before the first iteration
    comm: Communicator = field(default_factory=Communicator)
    strategy: DensityStrategy | None = None  # of density; None: that of the configuration
    effects: Sequence[TrainingEffect] = ()  # besides those of the configuration
    loss: Loss | None = None  # None: that of the configuration
    trainer: Trainer = field(init=False)
    history: History = field(init=False)
    criterion: StopCriterion = field(init=False, default_factory=AllIterations)
    observers: list[Observer] = field(init=False, default_factory=list)
    _fingerprint: Fingerprint | None = field(init=False, default=None)

    def run(self) -> bool:
        """Fit, and write the results; False if Ctrl-C stopped the fit, with its state saved."""
        folder = self.folder
        with nullcontext() if folder is None else folder.locked():
            if self._is_finished():
                return True
            plan = self.prepare()
            if folder is not None:
                folder.take(self.config, self.dataset)
            if plan is not None:
                self._follow(plan)
            self.on_start(self)
            try:
                if not self.iterate():
                    return False
                self._finish(self.history.wall_s, self.trainer.gaussians())
            except NonFiniteError as error:
                remedy = "" if folder is None else f"; {folder.remedy}"
                raise UserError(f"{error}{remedy}") from None
        return True

    def _is_finished(self) -> bool:
        finished = self.folder is not None and self.folder.is_finished(self.config)
        if finished:
            self.folder.finish()  # a process that was killed after its last file has not
            path = self.folder.path
            self.console.say(f"{path}: this fit is finished; --overwrite does it again")
        return bool(self.comm.of_root(finished))

    def prepare(self) -> Plan | None:
        """Load the data, initialize the Gaussians, make the trainer; return the plan, if any.

        Input that cannot be used raises ``UserError`` here; nothing is written.
        """
        comm, checkpoint, gaussians, plan = self.comm, None, None, None
        if comm.is_root:
            checkpoint = self._load()
        if self.variant is not None or mi.variant() is None:
            select_variant(self.variant or VARIANTS[0])
        if comm.is_root:
            gaussians = self._initial_gaussians()
        gaussians = share_gaussians(comm, gaussians)
        if self.budget is not None:
            plan = self._plan(gaussians)
        self.config, self.dataset = share_inputs(comm, self.config, self.dataset)
        objects = self.strategy, self.effects, self.loss
        self.trainer = Trainer(self.config, self.dataset, gaussians, comm, *objects)
        self.history = History()  # whose clock begins
        if comm.of_root(checkpoint is not None):
            self._restore(checkpoint)
        return plan

    def _load(self) -> Checkpoint | None:
        """Load the dataset and complete the configuration; return the checkpoint, if any."""
        folder, checkpoint = self.folder, None
        if folder is not None:
            checkpoint = folder.checkpoint_for(self.config, self.budget is not None)
        config = self.config if checkpoint is None else checkpoint.config
        if self.dataset is None:
            self.dataset = load_dataset(config.data_for_training, sections=config.extensions)
        if folder is not None:
            self._fingerprint = fingerprint_of(self.dataset)
        if checkpoint is not None:
            before = checkpoint.data
            check_same_data(folder.path, config.data.path, before, self._fingerprint)
        self.config = completed(config, self.dataset)
        return checkpoint

    def _plan(self, gaussians: Gaussians) -> Plan | None:
        """Plan the fit, and make the plan its configuration; None on other ranks than 0."""
        rehearsal = rehearse(self.config, self.dataset, gaussians, self.comm)
        rehearsal.trainer.full_scene()  # gathered from all ranks
        if not self.comm.is_root:
            return None
        plan = plan_fit(self.config, self.dataset, gaussians, self.budget.end, rehearsal)
        self.config = plan.config
        self.console.say(plan.reasons)
        return plan

    def _follow(self, plan: Plan) -> None:
        """End the fit when the time of its plan is up."""
        self.criterion = Deadline(self.trainer, plan.end, plan.chosen.curve)
        if self.folder is not None:
            self.folder.write_plan(f"--budget {self.budget.seconds:g}s\n{plan.reasons}\n")

    def _initial_gaussians(self) -> Gaussians:
        """Describe the data, the start and what is simulated; return the Gaussians to start from.

        Raises ``UserError`` for lenses that the projection cannot render.
        """
        config, dataset, say = self.config, self.dataset, self.console.say
        say(dataset.description)
        say(
            f"{len(dataset.train)} views to train on, {len(dataset.test)} of split "
            f"'{dataset.test_split}' to measure on; background {config.data.background}; "
            f"scene extent {dataset.extent:.3g}"
        )
        start = start_of(config, dataset)
        say(description_of_start(config, start))
        say(described(summary_of_fit(config, dataset)))
        views, remedy = (*dataset.train, *dataset.test), "set data.ignore_distortion"
        check_lenses(config.model, views, f"{config.data.path}: ", remedy)
        return gaussians_at(start, config)

    def _restore(self, checkpoint: Checkpoint | None) -> None:
        """Continue from the checkpoint of rank 0."""
        start, state = self.trainer.state(), {}
        if checkpoint is not None:
            check_fits(self.folder.path, checkpoint, start)
            state, past = checkpoint.trainer, (checkpoint.history, checkpoint.wall_s)
            self.history = History.from_array(*past, checkpoint.density)
        self.trainer.restore(state)
        self.console.say(f"continues at iteration {self.trainer.iteration}")

    def iterate(self) -> bool:
        """Run the iterations that are left, with checkpoints; False if Ctrl-C stopped them.

        The state is saved then, and after the last iteration: from then on the configuration
        specifies what was done, which half-written results belong to.
        """
        trainer, console, comm = self.trainer, self.console, self.comm
        criterion = RootDecides(self.criterion, comm)
        total = criterion.num_iterations(trainer)
        shown = console.progress("iteration", total, trainer.iteration)
        with shown as progress, console.stop_request() as stop:
            observers = [ShownProgress(progress, criterion), HeldOutQuality(self.dataset.test)]
            observers += self.observers
            for done in iterations(trainer, self.history, criterion):
                self.check_ranges()
                for observer in observers:
                    observer.after(trainer, self.history, done, lambda: stop.requested)
                stops = bool(comm.of_root(stop.requested))
                if stops or self._is_checkpoint_due(done):
                    self._save_checkpoint()
                if stops:
                    return False
        return True

    def _is_checkpoint_due(self, done: Iteration) -> bool:
        every = self.trainer.config.output.checkpoint_every
        return every is not None and (done.is_last or done.report.passes(every))

    def _save_checkpoint(self) -> None:
        state, history = self.trainer.state(), self.history
        if self.folder is not None:
            rows, changes = history.as_array(), history.density_array()
            checkpoint = Checkpoint(state, rows, history.wall_s, self._fingerprint, changes)
            save_checkpoint(self.folder.path, self.trainer.config, checkpoint)

    def _finish(self, wall_s: float, gaussians: Gaussians) -> None:
        """Fit the file for other viewers, if one is needed; measure and write the results."""
        if self.comm.is_root:
            _warn_if_not_pruned(self.trainer)
        release_unused_memory()  # encoding the orbit's frames takes as much as iterations do
        self.trainer.full_scene()  # gathered from all ranks
        for_viewers = None
        if not self.trainer.config.model.approximations.are_usual:
            for_viewers = self._fit_for_viewers(gaussians)
        if self.folder is not None:
            metrics = self.folder.write_results(
                self.trainer, self.dataset, self.history, gaussians, for_viewers, wall_s
            )
            self.console.say(self.folder.describe(metrics))

    def _fit_for_viewers(self, gaussians: Gaussians) -> ForViewers:
        """Return Gaussians for other viewers.

        The trainer is released by it, and goes on rendering what it has fitted.
        """
        from drgs.training.viewers import for_viewers, num_iterations

        total = num_iterations(self.trainer.config)
        with self.console.progress("iteration for viewers", total) as shown:
            return for_viewers(self.trainer, gaussians, lambda done: shown.update(done, total))


def _warn_if_not_pruned(trainer: Trainer) -> None:
    """Note where a plan was revised and time was up before the last phase had ended."""
    wanted = trainer.config.densify.prune.to
    if wanted is not None and trainer.num_gaussians > wanted:
        note = (
            f"time was up before there were only densify.prune.to = {wanted:,} Gaussians: there "
            f"are {trainer.num_gaussians:,}; give --budget more time"
        )
        warnings.warn(UserNote(note), stacklevel=2)


@dataclass(frozen=True)
class FitResult:
    """The result of a fit in memory."""

    gaussians: Gaussians  # numpy arrays: what ``point_cloud.ply`` of the command contains
    history: tuple[HistoryRow, ...]  # as in ``history.csv``
    trainer: Trainer  # goes on from here with ``trainer.step()``, renders with ``images(views)``


def train(
    config: FitConfig | Mapping[str, object] | str | Path,
    dataset: Dataset | None = None,
    callback: Callable[[StepReport], bool | None] | None = None,
    *,
    strategy: DensityStrategy | None = None,
    effects: Sequence[TrainingEffect] = (),
    loss: Loss | None = None,
) -> FitResult:
    """Fit Gaussians to photographs, in memory: the bytes that ``drgs fit`` writes to its PLY file.

    config: what to fit, and how: the path of a YAML file, or of the folder of a dataset, to have
    that chosen (``drgs.datasets.folders``); the same as nested mappings, or a
    :class:`drgs.config.schema.FitConfig`; dataset: the photographs, whose background is that of
    the splats, by default those of the configuration's section ``data``; callback: called after
    each iteration with what it did, a :class:`drgs.training.trainer.StepReport`; the fit ends early
    where it returns True.

    strategy: changes the population, instead of ``densify.strategy``; effects: take part in the
    fit besides those of the configuration; loss: of an image and its photograph, instead of
    ``loss``.

    Where no Mitsuba variant is active, ``llvm_ad_rgb`` is made so. Nothing is written.

    Raises ``drgs.core.errors.UserError`` (a ValueError) for wrong input, naming the key and the
    remedy, and ``drgs.training.finite_checks.NonFiniteError`` if a number is not finite.
    """
    if isinstance(config, (str, Path)):
        is_folder = Path(config).is_dir()
        config = config_for(Path(config))[0] if is_folder else load_config(config)
    elif not isinstance(config, FitConfig):
        config = config_from(config, "train(): config")
    session = FitSession(config, dataset, strategy=strategy, effects=effects, loss=loss)
    with reporting_extensions():
        session.prepare()
        trainer, history = session.trainer, session.history
        for done in iterations(trainer, history, session.criterion):
            if callback is not None and callback(done.report):
                break
    gaussians = saved_gaussians(trainer.gaussians(), trainer.config)
    return FitResult(gaussians, tuple(history.rows), trainer)
