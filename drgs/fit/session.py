"""A fit from its configuration to its result: the program of ``drgs fit`` and ``drgs.train``.

    configuration -> dataset -> initial Gaussians -> (plan) -> trainer -> iterations -> results

:class:`drgs.fit.fit_folder.FitFolder` reads and writes files; without one nothing is written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import NoneType

import mitsuba as mi
from typing_extensions import override

from drgs.cli.ending import StopRequest
from drgs.cli.execution import select_variant
from drgs.cli.progress import RunProgress, StepProgress
from drgs.config.changes import with_changes
from drgs.config.extensions import EXAMINERS
from drgs.config.load import config_from, load_config
from drgs.config.schema import FitConfig
from drgs.core.environment import VARIANTS
from drgs.core.errors import UserError, check_type, note_user
from drgs.core.memory import release_unused_memory
from drgs.core.registry import reporting_extensions
from drgs.datasets import Dataset, load_dataset
from drgs.datasets.folders import config_for
from drgs.effects.base import ChosenEffects, Examiner, TrainingEffect
from drgs.fit.budget import Budget, Plan, deadline, plan_fit, rehearse
from drgs.fit.checkpoint import Checkpoint, check_fits, check_same_data, save_checkpoint
from drgs.fit.fingerprint import Fingerprint, fingerprint_of
from drgs.fit.fit_folder import FitFolder, saved_gaussians
from drgs.fit.inputs import share_gaussians, share_inputs
from drgs.fit.loop import (
    Continues,
    HeldOutQuality,
    History,
    Iteration,
    Observer,
    iterations,
    smoother,
    until_planned_end,
)
from drgs.fit.memory import room_for_targets
from drgs.fit.summary import summary_of_fit
from drgs.fit.viewers_fit import ForViewers, fit_small_file, for_viewers
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.start import description_of_start, gaussians_at, start_of
from drgs.integrator.scene import check_lenses
from drgs.integrator.summary import format_effects
from drgs.results.folder import BUDGET_PLAN, EXAMINATION, GAUSSIANS, small_file_name
from drgs.results.history import HistoryRow
from drgs.training.contracts import NO_PARTS, GivenParts
from drgs.training.density.strategy import DensityStrategy
from drgs.training.finite_checks import NonFiniteError
from drgs.training.losses import Loss, LossTerm
from drgs.training.parallel.communicator import Communicator
from drgs.training.trainer import StepReport, Trainer


class ProgressLine(Observer):
    """Draws the progress of a fit: see :class:`drgs.fit.loop.Observer`."""

    def __init__(self, progress: RunProgress) -> None:
        self._progress = progress
        self._psnr: float | None = None  # dB, smooth

    @override
    def after_iteration(self, done: Iteration, stops: Callable[[], bool]) -> None:
        if (row := done.row) is not None:
            self._psnr = smoother(self._psnr, row.psnr)
            status = f"loss {row.loss:.4f}  PSNR {self._psnr:5.2f} dB  "
            status += f"Gaussians {row.num_gaussians:,}"
            total = row.iteration if done.is_last else done.trainer.config.last_iteration
            self._progress.update(row.iteration, max(row.iteration, total), status)


@dataclass(eq=False)
class FitSession:
    """A fit, by one process or several, which all run the same session.

    Rank 0 alone has a configuration, a folder and a terminal, and decides when to stop.
    """

    config: FitConfig | None
    dataset: Dataset | None = None  # None: the configured one
    folder: FitFolder | None = None  # for results and checkpoints
    uses_terminal: bool = False  # prints, draws progress, and takes Ctrl-C as a request to stop
    variant: str | None = None  # of Mitsuba; None: the active one
    budget: Budget | None = None  # the time for which the fit is planned
    check_ranges: Callable[[], None] = lambda: None  # called after each iteration
    on_start: Callable[[FitSession], None] = lambda session: None  # before the first iteration
    comm: Communicator = field(default_factory=Communicator)
    parts: GivenParts = NO_PARTS
    examines: bool = False  # whether an examination of the dataset chooses effects
    examination: ChosenEffects | None = field(init=False, default=None)
    trainer: Trainer = field(init=False)
    history: History = field(init=False)
    continues: Continues = field(init=False, default_factory=lambda: until_planned_end)
    observers: list[Observer] = field(init=False, default_factory=list)
    _fingerprint: Fingerprint | None = field(init=False, default=None)

    @property
    def _inputs(self) -> tuple[FitConfig, Dataset]:
        assert self.config is not None and self.dataset is not None, "they are loaded"
        return self.config, self.dataset

    def _print(self, text: str) -> None:
        if self.uses_terminal:
            print(text)

    def run(self) -> bool:
        """Fit, and write the results; False if Ctrl-C stopped the fit, with its state saved."""
        folder = self.folder
        with nullcontext() if folder is None else folder.lock():
            if self._is_finished():
                return True
            plan = self.prepare()
            if folder is not None:
                folder.claim(*self._inputs)
                if self.examination is not None:
                    folder.write_text(EXAMINATION, self.examination.to_json())
            if plan is not None:
                self.continues = deadline(plan.end, self.comm)
                if folder is not None and self.budget is not None:
                    text = f"--budget {self.budget.seconds:g}s\n{plan.reasons}\n"
                    folder.write_text(BUDGET_PLAN, text)
            self.on_start(self)
            try:
                if not self.iterate():
                    return False
                self._finish()
            except NonFiniteError as error:
                remedy = "" if folder is None else f"; {folder.remedy}"
                raise UserError(f"{error}{remedy}") from None
        return True

    def _is_finished(self) -> bool:
        finished, folder = False, self.folder
        if folder is not None and self.config is not None:
            finished = folder.is_finished(self.config)
            if finished:
                folder.finish()  # a process that was killed after its last file has not
                self._print(f"{folder.path}: this fit is finished; --overwrite does it again")
        return bool(self.comm.broadcast_numbers(finished))

    def prepare(self) -> Plan | None:
        """Load the data, initialize the Gaussians, make the trainer; return the plan, if any.

        Raises ``UserError`` for input that cannot be used. Nothing is written.
        """
        comm, checkpoint, gaussians, plan = self.comm, None, None, None
        given = self.config
        if comm.is_root:
            checkpoint = self._load()
        if self.variant is not None or mi.variant() is None:
            select_variant(self.variant or VARIANTS[0])
        if comm.is_root:
            if self.examines and given is not None and checkpoint is None:
                self._examine(given)
            gaussians = self._initial_gaussians()
        gaussians = share_gaussians(comm, gaussians)
        if self.budget is not None:
            plan = self._plan(gaussians, self.budget)
        self.config, self.dataset = share_inputs(comm, self.config, self.dataset)
        room = room_for_targets(self.config, self.dataset, gaussians.num_gaussians, comm)
        self.trainer = Trainer(self.config, self.dataset, gaussians, comm, self.parts, room=room)
        self.history = History()  # starts its clock
        if comm.broadcast_numbers(checkpoint is not None):
            self._restore(checkpoint)
        else:
            done = 0 if self.folder is None else self.folder.iterations_done()
            self._go_on(int(comm.broadcast_numbers(done)))
        return plan

    def _load(self) -> Checkpoint | None:
        """Load the dataset and complete the configuration; return the checkpoint, if any."""
        folder, config, checkpoint = self.folder, self.config, None
        assert config is not None, "rank 0 has one"
        if folder is not None:
            checkpoint = folder.checkpoint_for(config, self.budget is not None)
        if checkpoint is not None and checkpoint.config is not None:
            config = checkpoint.config
        if self.dataset is None:
            self.dataset = load_dataset(config.data_for_training, sections=config.sections)
        if folder is not None:
            self._fingerprint = fingerprint_of(self.dataset)
            if checkpoint is not None:
                check_same_data(folder.path, config.data.path, checkpoint.data, self._fingerprint)
        self.config = resolve_defaults(config, self.dataset)
        small_file_name(self.config)  # refuses formats now
        return checkpoint

    def _examine(self, given: FitConfig) -> None:
        """Choose the effects that the photographs call for; given: not completed."""
        _, dataset = self._inputs
        if not (names := EXAMINERS.names()):
            self._print("not examined: no examiner is installed")
            return
        examine: Examiner = EXAMINERS.get(names[0]).value
        with StepProgress("examining: ") if self.uses_terminal else nullcontext() as steps:
            update = None if steps is None else steps.update
            seconds = None if self.budget is None else self.budget.examination_s
            self.examination = examine(dataset, given, update, seconds)
        self._print(str(self.examination))
        changes = self.examination.changes
        if changes:
            given = with_changes(given, changes)
        if any(key.startswith("data.") for key in changes):
            self.dataset = load_dataset(given.data_for_training, sections=given.sections)
            if self.folder is not None:
                self._fingerprint = fingerprint_of(self.dataset)
        self.config = resolve_defaults(given, self._inputs[1])

    def _plan(self, gaussians: Gaussians, budget: Budget) -> Plan | None:
        """Plan the fit, and make the plan its configuration; None on other ranks than 0."""
        start = self.config, self.dataset, gaussians, self.comm
        trainer, iteration_s = rehearse(*start, self.parts, seconds=budget.rehearsal_s)
        scene = trainer.full_scene()  # gathered from all ranks
        if scene is None:
            return None
        plan = plan_fit(*self._inputs, gaussians, budget.end, scene, iteration_s)
        self.config = plan.config
        self._print(plan.reasons)
        return plan

    def _initial_gaussians(self) -> Gaussians:
        """Print data, start and simulated effects; return the initial Gaussians.

        Raises ``UserError`` for lenses that the projection cannot render.
        """
        config, dataset = self._inputs
        self._print(dataset.description)
        self._print(
            f"{len(dataset.train)} views to train on, {len(dataset.test)} of split "
            f"'{dataset.test_split}' to measure on; background {config.data.background}; "
            f"scene extent {dataset.extent:.3g}"
        )
        start = start_of(self.folder.start_of_run(config) if self.folder else config, dataset)
        self._print(description_of_start(config, start))
        reasons = {} if self.examination is None else self.examination.reasons
        self._print(format_effects(summary_of_fit(config, dataset, reasons)))
        views, remedy = (*dataset.train, *dataset.test), "set data.ignore_distortion"
        check_lenses(config.model, views, f"{config.data.path}: ", remedy)
        return gaussians_at(start, config)

    def _restore(self, checkpoint: Checkpoint | None) -> None:
        """Continue from the checkpoint of rank 0."""
        start, state = self.trainer.state(), {}
        if checkpoint is not None and self.folder is not None:
            check_fits(self.folder.path, checkpoint, start)
            past = checkpoint.history, checkpoint.density, checkpoint.wall_s
            state, self.history = checkpoint.trainer, History.from_arrays(*past)
        self.trainer.restore(state)
        self._print(f"continues at iteration {self.trainer.iteration}")

    def _go_on(self, done: int) -> None:
        """Continue after so many iterations of a fit that had ended, with its Gaussians alone."""
        if done:
            at_once = self.trainer.config.optimizer.views_per_step
            self.trainer.iteration = -(-done // at_once) * at_once  # a step begins after it
            self._print(
                f"goes on after {done:,} iterations with the rates of a fit of "
                f"{self.trainer.config.iterations:,}; Adam's moments, the numbers of effects, and "
                "the table of changes begin anew"
            )
        if done and self.folder is not None:
            self.history = self.folder.history_so_far()

    def iterate(self) -> bool:
        """Run the iterations that are left, with checkpoints; False if Ctrl-C stopped them.

        The state is saved then, and after the last iteration, before results are written.
        """
        trainer, comm, stop = self.trainer, self.comm, StopRequest()
        with ExitStack() as blocks:
            observers: list[Observer] = [HeldOutQuality(trainer.dataset.test), *self.observers]
            if self.uses_terminal:
                total = trainer.config.last_iteration
                progress = RunProgress("iteration", total, trainer.iteration)
                observers.insert(0, ProgressLine(blocks.enter_context(progress)))
                blocks.enter_context(stop)
            for done in iterations(trainer, self.history, self.continues):
                self.check_ranges()
                for observer in observers:
                    observer.after_iteration(done, lambda: stop.requested)
                stops = bool(comm.broadcast_numbers(stop.requested))
                every = trainer.config.output.checkpoint_every
                is_due = done.is_last or (every is not None and done.report.passes(every))
                if stops or is_due:
                    self._save_checkpoint()
                if stops:
                    return False
        return True

    def _save_checkpoint(self) -> None:
        state, history = self.trainer.state(), self.history
        if self.folder is not None and self._fingerprint is not None:
            past = *history.arrays(), history.wall_s
            checkpoint = Checkpoint(state, *past, self._fingerprint)
            save_checkpoint(self.folder.path, self.trainer.config, checkpoint)

    def _finish(self) -> None:
        """Fit the file for other viewers, if one is needed; measure and write the results."""
        trainer, wall_s = self.trainer, self.history.wall_s
        gaussians, wanted = trainer.gaussians(), trainer.config.densify.prune.to
        if self.comm.is_root and wanted is not None and trainer.num_gaussians > wanted:
            note_user(
                f"time was up before there were only densify.prune.to = {wanted:,} Gaussians: "
                f"there are {trainer.num_gaussians:,}; give --budget more time"
            )
        release_unused_memory()  # encoding the orbit's frames takes as much as iterations do
        trainer.full_scene()  # gathered from all ranks
        others, config = {}, trainer.config
        if not config.model.approximations.is_default:
            others[GAUSSIANS] = self._fit_for_viewers(for_viewers, gaussians)
        if name := small_file_name(config):
            others[name] = self._fit_for_viewers(fit_small_file, gaussians)
        if self.folder is not None:
            results = trainer, self.history, gaussians, others, wall_s
            metrics = self.folder.write_results(*results)
            self._print(self.folder.describe(metrics))

    def _fit_for_viewers(self, fit: Callable[..., ForViewers], gaussians: Gaussians) -> ForViewers:
        """Return Gaussians for other viewers; the trainer is released, and renders the fit's."""
        if not self.uses_terminal:
            return fit(self.trainer, gaussians)
        with RunProgress("iteration for viewers") as shown:
            return fit(self.trainer, gaussians, shown.update)


@dataclass(frozen=True)
class FitResult:
    """The result of a fit in memory."""

    gaussians: Gaussians  # numpy arrays, as the command writes the fit's own
    history: tuple[HistoryRow, ...]  # as in ``history.csv``
    trainer: Trainer  # ``step()`` continues the fit, ``images(views)`` renders


def train(
    config: FitConfig | Mapping[str, object] | str | Path,
    dataset: Dataset | None = None,
    callback: Callable[[StepReport], bool | None] | None = None,
    *,
    strategy: DensityStrategy | None = None,
    effects: Sequence[TrainingEffect] = (),
    loss: Loss | None = None,
    terms: Sequence[LossTerm] = (),
) -> FitResult:
    """Fit Gaussians to photographs, in memory: the bytes that ``drgs fit`` writes as its own.

    config: the path of a YAML file, or of a dataset's folder (``drgs.datasets.folders`` chooses the
    configuration, and :func:`drgs.examine` the effects if the folder is all that is given); nested
    mappings, or a :class:`drgs.config.schema.FitConfig`. dataset: the photographs and their
    background, by default those of the section ``data``, which mappings then do not need.
    callback: called after each iteration with its :class:`drgs.training.trainer.StepReport`; the
    fit ends early where it returns True.

    strategy: changes the population, instead of ``densify.strategy``; effects: take part in the fit
    besides those of the configuration; loss: of an image and its photograph, instead of ``loss``;
    terms: added to the loss, besides those of the configuration.

    Activates the Mitsuba variant ``llvm_ad_rgb`` where none is active. Nothing is written.

    Raises ``drgs.core.errors.UserError`` (a ValueError) for wrong input, naming the key and the
    remedy, and ``drgs.training.finite_checks.NonFiniteError`` if a number is not finite.
    """
    check_type("train()", "config", config, FitConfig, Mapping, str, Path)
    check_type("train()", "dataset", dataset, Dataset, NoneType)
    check_type("train()", "callback", callback, Callable, NoneType)
    is_folder, parts = False, GivenParts(strategy, effects, loss, terms)
    if isinstance(config, (str, Path)):
        is_folder = Path(config).is_dir()
        config = config_for(Path(config))[0] if is_folder else load_config(config)
    elif not isinstance(config, FitConfig):
        if dataset is not None and isinstance(data := config.get("data", {}), Mapping):
            config = {**config, "data": {"path": ".", **data}}
        config = config_from(config, "train(): config")
    is_examined = is_folder and dataset is None and not parts
    session = FitSession(config, dataset, parts=parts, examines=is_examined)
    with reporting_extensions():
        session.prepare()
        trainer, history = session.trainer, session.history
        for done in iterations(trainer, history, session.continues):
            if callback is not None and callback(done.report):
                break
    gaussians = saved_gaussians(trainer.gaussians(), trainer.config)
    return FitResult(gaussians, tuple(history.rows), trainer)
