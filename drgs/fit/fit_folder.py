"""The output folder of a fit: a checkpoint is read before the fit, results are written after it."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.approximations import Approximations
from drgs.config.changes import given_keys, with_changes
from drgs.config.schema import FitConfig
from drgs.core.environment import processor
from drgs.core.errors import UserError
from drgs.core.files import atomic_path, refusal_reason, write_json
from drgs.core.folders import FolderRecord, sole_writer
from drgs.datasets.types import Dataset, evenly_spaced
from drgs.effects.smoothing import bake_smoothing
from drgs.fit.checkpoint import Checkpoint, load_checkpoint, remove_checkpoint
from drgs.fit.inputs import versions
from drgs.fit.loop import History
from drgs.fit.report import MAX_PICTURES, FitImages, write_images, write_results
from drgs.fit.viewers_fit import ForViewers
from drgs.gaussians.parameters import Gaussians
from drgs.results import folder
from drgs.results.history import HistoryRow, write_density, write_history
from drgs.results.html_viewer import DisplaySettings, shows_as_fitted
from drgs.results.metrics import FitMetrics, SplitMetrics, mean_of, mean_quality
from drgs.results.refined_cameras import write_pinholes, write_views
from drgs.training.trainer import Trainer


@dataclass(eq=False)
class FitFolder:
    """The output folder of one fit, which the session alone writes to."""

    path: Path
    command: str = ""  # the line that was typed, for the report
    resumes: bool = False  # a fit that was stopped, whatever its configuration
    overwrites: bool = False  # the run that the folder holds

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other commands from writing to the folder, from when it exists."""
        with sole_writer(self.path) as self._keep:
            yield

    def is_finished(self, config: FitConfig) -> bool:
        """Return whether the folder holds all results of the fit already."""
        if self.overwrites:
            return False
        if self.resumes:
            return self.iterations_done() >= config.last_iteration
        return folder.is_finished(self.path, config)

    def iterations_done(self) -> int:
        """Return the iterations of the results that a resumed fit has; 0: it has none."""
        path = self.path / folder.METRICS
        try:
            return int(json.loads(path.read_text())["iterations"]) if self.resumes else 0
        except FileNotFoundError:
            return 0
        except (OSError, ValueError, KeyError, TypeError):
            raise UserError(
                f"{path}: must be what a fit wrote, got something else; remove it, and resume"
            ) from None

    def history_so_far(self) -> History:
        """Return the table of the results in the folder; empty if it cannot be read."""
        with suppress(OSError, ValueError, IndexError):
            rows = np.genfromtxt(self.path / folder.HISTORY, delimiter=",", skip_header=1)
            rows = rows.reshape(-1, len(HistoryRow.__dataclass_fields__))
            return History.from_arrays(rows, np.zeros((0, 1)), rows[-1, 5])
        return History()

    def start_of_run(self, config: FitConfig) -> FitConfig:
        """Return the configuration of the start: if the fit goes on, its Gaussians."""
        if not self.iterations_done():
            return config
        start = {"start": "auto", "point_cloud": None, "half_extent": None}
        start |= {"max_point_error": None, "min_track_length": None}
        start["gaussians"] = folder.own_gaussians(self.path)
        return with_changes(config, {f"init.{name}": value for name, value in start.items()})

    def checkpoint_for(self, config: FitConfig, has_budget: bool) -> Checkpoint | None:
        """Return the checkpoint to continue from, if there is one.

        Raises ``UserError`` where the folder belongs to another fit. Nothing is written.
        """
        if self.overwrites:
            return None
        if has_budget:
            folder.require_no_run(self.path)
        elif not self.resumes:
            folder.check_output_folder(self.path, config)
        return load_checkpoint(self.path, config)

    def claim(self, config: FitConfig, dataset: Dataset) -> None:
        """Make the folder the fit's, or raise ``UserError`` and leave it unchanged."""
        self._keep()
        images = folder.image_names(dataset.test_split, [view.name for view in dataset.test])
        if self.overwrites:
            folder.remove_run(self.path, images)
        if self.resumes:
            folder.continue_run(self.path, config, images)
        else:
            folder.claim_output_folder(self.path, config, images)

    def write_text(self, name: str, text: str) -> None:
        """Write a plan, or what an examination chose, with the reasons."""
        with atomic_path(self.path / name) as temporary:
            temporary.write_text(text)

    def with_examination(self, config: FitConfig) -> FitConfig | None:
        """Return the configuration with what an examination chose for the run in the folder.

        None: there is no such run. Given values stay.
        """
        path = self.path / folder.EXAMINATION
        if self.overwrites or not path.is_file():
            return None
        try:
            changes, given = dict(json.loads(path.read_text())["changes"]), given_keys(config)
            changed = with_changes(config, {k: changes[k] for k in changes.keys() - given})
        except (ValueError, KeyError, TypeError):
            raise UserError(
                f"{path}: must be what an examination wrote, got something else; examine again "
                "with --overwrite, or choose another folder with --out"
            ) from None
        return changed if folder.is_run_of(self.path, changed) else None

    @property
    def remedy(self) -> str:
        """Advice after numbers that are not finite."""
        has_checkpoint = (self.path / folder.CHECKPOINT).exists()
        kept = "the last checkpoint is kept" if has_checkpoint else "nothing was saved yet"
        return (
            f"{kept}. --resume {self.path} --debug repeats this with range checks; lower learning "
            "rates (--set optimizer.means_lr=..., and so on) may avoid it"
        )

    def write_results(
        self,
        trainer: Trainer,
        history: History,
        gaussians: Gaussians,
        for_viewers: Mapping[str, ForViewers],
        wall_s: float,
    ) -> FitMetrics:
        """Write the results of a finished fit, and measure them; return ``metrics.json``.

        for_viewers: by file, where other viewers do not render as the fit does, or have a small
        file; wall_s: time of iterations.
        """
        out, config, dataset, render = self.path, trainer.config, trainer.dataset, trainer.images
        with suppress(OSError):  # of a fit that goes on: no longer true
            (out / folder.METRICS).unlink()
        own = saved_gaussians(gaussians, config)
        is_own = folder.GAUSSIANS not in for_viewers
        other = bake_smoothing(own) if is_own else for_viewers[folder.GAUSSIANS].gaussians
        write_gaussians(out, own, other)
        for effect in trainer.effects:
            effect.write(out, dataset)
        write_history(out / folder.HISTORY, history.rows)
        write_density(out / folder.DENSITY, history.density)
        write_views(out / folder.VIEWS, dataset)
        folder.write_run_config(out, config)
        write_pinholes(out, dataset)
        output, split = config.output, dataset.test_split
        scores = write_images(out, dataset, render, output.save_renders, output.report)
        test = SplitMetrics(**vars(mean_of(scores)), split=split)
        metrics = self._metrics(config, gaussians.num_gaussians, wall_s, test)
        for name, each in for_viewers.items():
            if name != folder.GAUSSIANS:
                each.gaussians.save(out / name)
                each = replace(each, gaussians=Gaussians.load(out / name))
            views = evenly_spaced(dataset.test, MAX_PICTURES)
            images = zip(each.images(views), views, strict=True)
            quality = mean_quality((image, view.image, view.mask) for image, view in images)
            found = SplitMetrics(**vars(quality), split=split)
            if name == folder.GAUSSIANS:
                metrics["viewers"] = found
            else:
                metrics["small_file"] = {**found, "bytes": (out / name).stat().st_size}
        if output.report:
            approximations = config.model.approximations
            shown = DisplaySettings(bake_smoothing(gaussians), approximations)
            if not shows_as_fitted(approximations):
                shown = DisplaySettings(other, Approximations())
            scene = trainer.full_scene()
            assert scene is not None, "rank 0 writes the results"
            fitted = FitImages(scene, gaussians, render, shown)
            write_results(out, dataset, fitted, scores, history, metrics)
        self.finish(metrics)
        return metrics

    def _metrics(
        self, config: FitConfig, num_gaussians: int, wall_s: float, test: SplitMetrics
    ) -> FitMetrics:
        known = versions()
        return {
            "iterations": config.last_iteration,
            "num_gaussians": num_gaussians,
            "wall_s": round(wall_s, 2),
            "test": test,
            "seed": config.seed,
            "versions": {
                "drgs": known["drgs"],
                "mitsuba": known["Mitsuba"],
                "drjit": known["Dr.Jit"],
                "numpy": known["numpy"],
                "python": platform.python_version(),
                "llvm": known["LLVM"],
            },
            "variant": mi.variant() or "",
            "threads": dr.thread_count(),
            "processor": processor(),
            "date": datetime.now().astimezone().isoformat(timespec="minutes"),
            "command": self.command,
            "config": config.model_dump(mode="json"),
        }

    def describe(self, metrics: FitMetrics) -> str:
        """Return the results in a few lines, and where they are."""
        test, viewers = metrics["test"], metrics.get("viewers")
        lines = [
            f"{test['num_views']} {test['split']} views: PSNR {test['psnr']:.2f} dB, "
            f"SSIM {test['ssim']:.4f}; {metrics['num_gaussians']:,} Gaussians; "
            f"{metrics['iterations']} iterations in {metrics['wall_s']:.0f} s"
        ]
        if viewers is not None:
            path = self.path / folder.GAUSSIANS
            lines.append(f"as other viewers show {path}: PSNR {viewers['psnr']:.2f} dB")
        if (small := metrics.get("small_file")) is not None:
            size = f"{small['bytes'] / 1e6:.2f} MB"
            lines.append(f"as its viewers show the small file, {size}: PSNR {small['psnr']:.2f} dB")
        lines.append(f"written: {self.path}")
        if cast("dict[str, object]", metrics["config"]["output"])["report"]:
            lines.append(f"open {self.path / folder.REPORT}")
        return "\n".join(lines)

    def finish(self, metrics: FitMetrics | None = None) -> None:
        """Write ``metrics.json`` (None: it exists), and end the run by removing the checkpoint."""
        if metrics is not None:
            write_json(self.path / folder.METRICS, metrics, indent=2)
        remove_checkpoint(self.path)
        FolderRecord(self.path, folder.COMMAND).seal()


def saved_gaussians(gaussians: Gaussians, config: FitConfig) -> Gaussians:
    """Return the fit's own Gaussians, as they are saved, from the trainer's.

    Their header records approximations that are not the default. They have no smoothing filter with
    ``output.bake_smoothing``.
    """
    gaussians = replace(gaussians, rendered_with=config.model.approximations.non_default or None)
    return bake_smoothing(gaussians) if config.output.bake_smoothing else gaussians


def write_gaussians(out: Path, own: Gaussians, for_viewers: Gaussians) -> None:
    """Write a fit's Gaussians, in an order in which either file is of its kind at all times."""
    differ = own.rendered_with is not None or own.smoothing is not None
    if differ:
        own.save(out / folder.OWN_GAUSSIANS)
    for_viewers.save(out / folder.GAUSSIANS)
    for name in (folder.EARLIER_FOR_VIEWERS, *(() if differ else (folder.OWN_GAUSSIANS,))):
        try:
            (out / name).unlink(missing_ok=True)
        except OSError as error:
            reason = refusal_reason(error)
            raise UserError(f"{out / name}: cannot be removed: {reason}") from error
