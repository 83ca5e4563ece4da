"""A fit from its configuration to its result: the program of ``drgs fit`` and ``drgs.train``.

    configuration -> dataset -> initial Gaussians -> (plan) -> trainer -> iterations -> results

Two collaborators touch the world outside: :class:`drgs.training.fit_folder.FitFolder` reads and
writes files, :class:`Console` prints, draws progress and takes Ctrl-C. Without a folder nothing is
written; the trainer is called alike with and without them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from drgs.cli.execution import select_variant
from drgs.cli.interrupts import StopRequest
from drgs.cli.progress import RunProgress
from drgs.config.load import config_from, load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError, UserNote
from drgs.core.memory import release_unused_memory
from drgs.core.variants import VARIANTS
from drgs.datasets import Dataset, load_dataset
from drgs.datasets.fingerprint import fingerprint_of
from drgs.datasets.folders import config_for
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.defaults import completed
from drgs.initialization.start import description_of_start, gaussians_at, start_of
from drgs.integrator.scene import check_lenses
from drgs.integrator.summary import described
from drgs.results.files import GAUSSIANS_FOR_VIEWERS, REPORT
from drgs.results.metrics import Quality, mean_of
from drgs.results.report import Fitted, score, write_pictures, write_results
from drgs.training.budget import Deadline, Plan, plan_fit
from drgs.training.checkpoint import Checkpoint, check_fits, check_same_data, save_checkpoint
from drgs.training.finite_checks import NonFiniteError
from drgs.training.fit_folder import (
    FitFolder,
    fit_metrics,
    gaussians_on_page,
    saved_gaussians,
    split_metrics,
)
from drgs.training.history import History, HistoryRow, smoother
from drgs.training.loop import AllIterations, Iteration, Observer, StopCriterion, iterations
from drgs.training.quality import HeldOutQuality
from drgs.training.summary import summary_of_fit
from drgs.training.trainer import StepReport, Trainer

MakeTrainer = Callable[[FitConfig, Dataset, Gaussians], Trainer]
"""From the configuration, the photographs and the initial Gaussians."""


class Console:
    """The terminal of a command: printed lines, a progress bar, Ctrl-C as a request to stop."""

    def say(self, text: str) -> None:
        """Print a line."""
        print(text)

    def progress(self, what: str, total: int, done: int = 0) -> AbstractContextManager[RunProgress]:
        """See :class:`drgs.cli.progress.RunProgress`."""
        return RunProgress(what, total, done)

    def stop_request(self) -> AbstractContextManager[StopRequest]:
        """See :class:`drgs.cli.interrupts.StopRequest`."""
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


class FitSession:
    """One fit; ``trainer``, ``history`` and ``criterion`` exist once it is prepared."""

    trainer: Trainer
    history: History
    criterion: StopCriterion

    def __init__(
        self,
        config: FitConfig,
        dataset: Dataset | None = None,
        *,
        folder: FitFolder | None = None,
        console: Console | Silence | None = None,
        variant: str | None = None,
        budget_s: float | None = None,
        started: float = 0.0,
        on_start: Callable[[FitSession], None] | None = None,
        check_ranges: Callable[[], None] = lambda: None,
        make_trainer: MakeTrainer = Trainer,
    ) -> None:
        """dataset: by default that of the configuration; folder: for results and checkpoints.

        variant: of Mitsuba, by default the active one; budget_s: the fit is planned to be done,
        results written, so many seconds after ``started``, by ``time.perf_counter``; on_start:
        called before the first iteration, to add ``observers`` or replace ``criterion``;
        check_ranges: called after each iteration, raises ``UserError``.
        """
        self.config, self.dataset, self.folder = config, dataset, folder
        self.console = Silence() if console is None else console
        self.observers: list[Observer] = []
        self._budget_s, self._end = budget_s, started + (budget_s or 0.0)
        self._variant, self._on_start = variant, on_start
        self._check_ranges, self._make_trainer = check_ranges, make_trainer
        self._plan: Plan | None = None

    def run(self, command: str) -> bool:
        """Fit, and write the results to the folder; False if Ctrl-C stopped it, its state saved.

        command: the line that was typed, for the report.
        """
        folder = self.folder
        with folder.locked():
            if folder.is_finished(self.config):
                folder.finish()  # a process that was killed after its last file has not
                self.console.say(f"{folder.path}: this fit is finished; --overwrite does it again")
                return True
            self.prepare()
            folder.take(self.config, self.dataset)
            if self._plan is not None:
                folder.write_plan(f"--budget {self._budget_s:g}s\n{self._plan.reasons}\n")
                self.criterion = Deadline(self.trainer, self._end, self._plan.curve)
            if self._on_start is not None:
                self._on_start(self)
            try:
                if not self.iterate():
                    return False
                wall_s, gaussians = self.history.wall_s, self.trainer.gaussians()
            except NonFiniteError as error:
                raise UserError(f"{error}; {folder.remedy}") from None
            self._write_results(gaussians, wall_s, command)
        return True

    def prepare(self) -> None:
        """Load the data, initialize the Gaussians, plan, make the trainer; writes nothing.

        Input that cannot be used raises ``UserError`` here.
        """
        checkpoint = None
        if self.folder is not None:
            checkpoint = self.folder.checkpoint_for(self.config, self._budget_s is not None)
        config = self.config if checkpoint is None else checkpoint.config
        place = "train()" if self.dataset is not None else config.data.path
        if self.dataset is None:
            self.dataset = load_dataset(config.data_for_training)
        self._fingerprint = None if self.folder is None else fingerprint_of(self.dataset)
        if checkpoint is not None:
            path = self.folder.path
            check_same_data(path, config.data.path, checkpoint.data, self._fingerprint)
        self.config = completed(config, self.dataset)
        self._select_variant()
        gaussians = self._initial_gaussians(f"{place}: ")
        if self._budget_s is not None:
            self._end, self._plan = plan_fit(
                self.config, self.dataset, gaussians, self._end, self._make_trainer
            )
            self.config = self._plan.config
            self.console.say(self._plan.reasons)
        self.trainer = self._make_trainer(self.config, self.dataset, gaussians)
        self.dataset = self.trainer.dataset  # of which others may have a part
        self.history, self.criterion = History(), AllIterations()
        if checkpoint is not None:
            self._restore(checkpoint)

    def _select_variant(self) -> None:
        if self._variant is not None or mi.variant() is None:
            select_variant(self._variant or VARIANTS[0])

    def _initial_gaussians(self, place: str) -> Gaussians:
        """Describe the data, the start and what is simulated; return the Gaussians to start from.

        place: precedes errors about lenses that the projection cannot render.
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
        check_lenses(config.model, views, place, remedy)
        return gaussians_at(start, config)

    def _restore(self, checkpoint: Checkpoint) -> None:
        check_fits(self.folder.path, checkpoint, self.trainer.state())
        self.trainer.restore(checkpoint.trainer)
        self.console.say(f"continues at iteration {self.trainer.iteration}")
        self.history = History.from_array(checkpoint.history, checkpoint.wall_s, checkpoint.density)

    def iterate(self) -> bool:
        """Run the iterations that are left, with checkpoints; False if Ctrl-C stopped them.

        The state is saved then, and after the last iteration: from then on the configuration
        specifies what was done, which half-written results belong to.
        """
        trainer, criterion, console = self.trainer, self.criterion, self.console
        total = criterion.num_iterations(trainer)
        shown = console.progress("iteration", total, trainer.iteration)
        with shown as progress, console.stop_request() as stop:
            observers = [ShownProgress(progress, criterion), HeldOutQuality(self.dataset.test)]
            observers += self.observers
            for done in iterations(trainer, self.history, criterion):
                self._check_ranges()
                for observer in observers:
                    observer.after(trainer, self.history, done, lambda: stop.requested)
                if stop.requested or self._is_checkpoint_due(done):
                    self._save_checkpoint()
                if stop.requested:
                    return False
        return True

    def _is_checkpoint_due(self, done: Iteration) -> bool:
        every = self.trainer.config.output.checkpoint_every
        return every is not None and (done.is_last or done.report.passes(every))

    def _save_checkpoint(self) -> None:
        state, history = self.trainer.state(), self.history
        rows, changes = history.as_array(), history.density_array()
        checkpoint = Checkpoint(state, rows, history.wall_s, self._fingerprint, changes)
        save_checkpoint(self.folder.path, self.trainer.config, checkpoint)

    def _write_results(self, gaussians: Gaussians, wall_s: float, command: str) -> None:
        """Measure what was fitted, write it, and say so."""
        trainer, dataset, folder, say = self.trainer, self.dataset, self.folder, self.console.say
        config, output = trainer.config, trainer.config.output
        _warn_if_not_pruned(trainer)
        release_unused_memory()  # encoding the orbit's frames takes as much as iterations do
        scene, render, out = trainer.scene_of_all(), trainer.pictures, folder.path
        folder.write_fit(trainer, dataset, self.history, gaussians)
        scores = write_pictures(out, dataset, render, output.save_renders, output.report)
        quality = mean_of(scores)
        metrics = fit_metrics(config, dataset, gaussians.num_gaussians, wall_s, quality, command)
        for_viewers = None
        if not config.model.approximations.are_usual:
            for_viewers, as_seen = self._fit_for_viewers(gaussians)
            metrics["viewers"] = split_metrics(as_seen, dataset)
        if output.report:
            shown = gaussians_on_page(gaussians, config.model.approximations, for_viewers)
            fitted = Fitted(scene, gaussians, render, shown)
            write_results(out, dataset, fitted, scores, self.history, metrics)
        folder.finish(metrics)
        say(
            f"{quality.num_views} {dataset.test_split} views: PSNR {quality.psnr:.2f} dB, "
            f"SSIM {quality.ssim:.4f}; {gaussians.num_gaussians:,} Gaussians; "
            f"{config.iterations} iterations in {wall_s:.0f} s"
        )
        if for_viewers is not None:
            seen_at = out / GAUSSIANS_FOR_VIEWERS
            say(f"as other viewers show {seen_at}: PSNR {as_seen.psnr:.2f} dB")
        say(f"written: {out}")
        if output.report:
            say(f"open {out / REPORT}")

    def _fit_for_viewers(self, gaussians: Gaussians) -> tuple[Gaussians, Quality]:
        """Write the Gaussians for other viewers; return them, and how these show the test views.

        The trainer is released by it, and goes on rendering what it has fitted.
        """
        from drgs.training.viewers import for_viewers, num_iterations

        total, views = num_iterations(self.trainer.config), self.dataset.test
        with self.console.progress("iteration for viewers", total) as shown:
            found = for_viewers(self.trainer, gaussians, lambda done: shown.update(done, total))
        found.gaussians.save(self.folder.path / GAUSSIANS_FOR_VIEWERS)
        scores = [score(i, v) for i, v in zip(found.pictures(views), views, strict=True)]
        return found.gaussians, mean_of(scores)


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
    session = FitSession(config, dataset)
    session.prepare()
    trainer, history = session.trainer, session.history
    for done in iterations(trainer, history, session.criterion):
        if callback is not None and callback(done.report):
            break
    gaussians = saved_gaussians(trainer.gaussians(), trainer.config)
    return FitResult(gaussians, tuple(history.rows), trainer)
