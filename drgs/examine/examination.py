"""Effects that a dataset needs, chosen by measurement: :func:`examine`.

A short fit leaves some training photographs out. What they differ by from its renderings shows
which effects are likely (:class:`drgs.effects.base.Finding`); each of these is simulated in a
short fit of its own, and chosen if the photographs that were left out are matched better. Test
photographs are not looked at.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import ValidationError
from scipy.special import stdtrit
from typing_extensions import override

from drgs.cli.execution import select_variant
from drgs.config.changes import given_keys, with_changes, with_iterations
from drgs.config.extensions import EFFECTS, EXAMINERS
from drgs.config.load import config_from
from drgs.config.schema import FitConfig
from drgs.core.environment import VARIANTS
from drgs.core.errors import UserError, one_line
from drgs.datasets.images import smaller_view, with_arrays
from drgs.datasets.types import Dataset, evenly_spaced
from drgs.effects.base import Finding, Progress, ShortFit
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.start import Start, gaussians_at, start_of
from drgs.results.alignment import align
from drgs.training.finite_checks import NonFiniteError
from drgs.training.trainer import Trainer

SHORT_FIT_WIDTH_PX = 135  # about: of photographs in short fits
NUM_GAUSSIANS = 15_000
SHARE_OF_ITERATIONS, MAX_ITERATIONS, MIN_ITERATIONS = 1 / 6, 500, 250
"""A short fit has this share of the fit's iterations, within these bounds; a fit that is shorter
than six times the least is not examined."""

MAX_VIEWS, MIN_VIEWS = 160, 20  # photographs of an examination; with fewer there is none
NUM_HELD_OUT, HELD_OUT_STRIDE = 10, (4, 8)
"""Photographs that are left out, about: one in four to one in eight."""

MIN_GAIN_DB, CONFIDENCE = 0.05, 0.975
"""A gain that counts: in itself, and the confidence that the mean over held-out photographs is
above zero, by Student's t."""

WARM_UP_ITERATIONS = 20  # of a short fit, whose time does not count: kernels are compiled

BORDER_PX, BORDER_TOLERANCE, MIN_BORDER_SHARE = 2, 0.04, 0.6
"""A background of one colour: of each photograph's border, this share has it, but for this."""


@dataclass(frozen=True, kw_only=True)
class Decision:
    """A row of the table: an effect, the evidence, and what a short fit has gained with it."""

    effect: str
    evidence: str
    gain: float | None = None  # dB, mean over the held-out photographs; None: it was not tried
    spread: float | None = None  # dB: standard error of this mean
    cost: float | None = None  # time of iterations, relative to those without the effect
    changes: Mapping[str, object]  # values of the configuration that simulate it, by key
    chosen: bool = False


@dataclass(frozen=True)
class Examination:
    """Decisions about a dataset, with the evidence."""

    decisions: tuple[Decision, ...]
    num_held_out: int  # training photographs
    wall_s: float
    note: str = ""  # why nothing was examined, if so

    @property
    def changes(self) -> dict[str, object]:
        """Values of the configuration that were chosen, by key."""
        chosen = [decision.changes for decision in self.decisions if decision.chosen]
        return {key: value for changes in chosen for key, value in changes.items()}

    @property
    def reasons(self) -> dict[str, str]:
        """The evidence for each of these, by key."""
        return {
            key: f"{decision.evidence}: {decision.gain:+.2f} dB"
            for decision in self.decisions
            for key in decision.changes
            if decision.chosen
        }

    def to_json(self) -> str:
        """Return everything as JSON."""
        return json.dumps(asdict(self) | {"changes": self.changes}, indent=1) + "\n"

    @override
    def __str__(self) -> str:
        if self.note:
            return f"not examined: {self.note}"
        rows = [("effect", "evidence", "gain, dB", "time", "chosen")]
        for one in self.decisions:
            gain, cost = "", ""
            if one.gain is not None and one.cost is not None:
                gain, cost = f"{one.gain:+.2f} ± {one.spread:.2f}", f"x {one.cost:.2f}"
            keys = ", ".join(f"{key}: {value}" for key, value in one.changes.items())
            rows.append((one.effect, one.evidence, gain, cost, keys if one.chosen else "no"))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = (
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        )
        return "\n  ".join(
            [f"examined in {self.wall_s:.0f} s, on {self.num_held_out} held-out views:", *lines]
        )


@EXAMINERS.register("short_fits")
def examine(
    dataset: Dataset,
    config: FitConfig | Mapping[str, object] | None = None,
    progress: Progress | None = None,
) -> Examination:
    """Return which effects the dataset's training photographs need, with the evidence.

    config: of the fit, or nested mappings, by default all defaults; effects whose keys it gives are
    not examined. With a fit that is too short, or fewer than 20 training photographs, nothing is
    examined, and ``note`` says so. Activates the Mitsuba variant ``llvm_ad_rgb`` where none is
    active.

    Effects look for themselves: ``drgs.effects.base.TrainingEffect.look_for``.
    """
    started = time.perf_counter()
    if not isinstance(config, FitConfig):
        values = dict(config or {})
        values["data"] = {"path": ".", **cast("Mapping[str, object]", values.get("data", {}))}
        config = config_from(values, "examine(): config")
    if note := _reason_not_examined(config, dataset):
        return Examination((), 0, 0.0, note)
    given, short = given_keys(config), _shorten(resolve_defaults(config, dataset))
    split, factor = split_views(dataset)
    progress = progress or (lambda what, done, total: None)
    if mi.variant() is None:
        select_variant(VARIANTS[0])
    base = short_fit(short, split, factor, partial(progress, "baseline"))
    decisions = []
    for finding in _findings(base):
        if any(overlaps(key, other) for key in finding.changes for other in given):
            continue
        if not finding.is_likely:
            decisions.append(_reject(finding))
            continue
        try:
            changed = with_changes(base.config, {**finding.changes, **finding.in_short_fits})
            tried = short_fit(changed, split, factor, partial(progress, finding.effect))
        except (ValidationError, UserError, NonFiniteError) as error:
            decisions.append(_reject(finding, f"; could not be tried: {one_line(error, 100)}"))
            continue
        decision = decide(finding, base, tried)
        decisions.append(decision)
        if decision.chosen:  # the next one is tried beside it
            base = tried
    wall_s = time.perf_counter() - started
    return Examination(tuple(decisions), len(split.test), wall_s)


def decide(finding: Finding, without: ShortFit, fitted: ShortFit) -> Decision:
    """Return the decision about an effect from two short fits: the second one simulates it."""
    gains = fitted.psnr - without.psnr
    gain, spread = float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains)))
    return Decision(
        effect=finding.effect,
        evidence=finding.evidence,
        gain=gain,
        spread=spread,
        cost=fitted.wall_s / without.wall_s,
        changes=finding.changes,
        chosen=gain > max(MIN_GAIN_DB, spread * float(stdtrit(len(gains) - 1, CONFIDENCE))),
    )


def _reject(finding: Finding, reason: str = "") -> Decision:
    evidence = finding.evidence + reason
    return Decision(effect=finding.effect, evidence=evidence, changes=finding.changes)


def _reason_not_examined(config: FitConfig, dataset: Dataset) -> str:
    count, least = len(dataset.train), round(MIN_ITERATIONS / SHARE_OF_ITERATIONS)
    if count < MIN_VIEWS:
        return f"{count} training photographs are fewer than {MIN_VIEWS}"
    if config.iterations < least:
        return f"{config.iterations} iterations are fewer than {least}"
    return ""


def overlaps(key: str, other: str) -> bool:
    """Return whether two keys are the same, or one is that of a section with the other."""
    return f"{key}.".startswith(f"{other}.") or f"{other}.".startswith(f"{key}.")


# Short fits


def split_views(dataset: Dataset) -> tuple[Dataset, int]:
    """Return the training photographs, small, with some left out as ``test``, and their divisor."""
    views = evenly_spaced(dataset.train, MAX_VIEWS)
    factor = max(1, round(max(view.width for view in views) / SHORT_FIT_WIDTH_PX))
    stride = int(np.clip(len(views) // NUM_HELD_OUT, *HELD_OUT_STRIDE))
    small = [with_arrays(smaller_view(view, factor)) for view in views]
    held_out = range(stride // 2, len(small), stride)
    train = tuple(view for index, view in enumerate(small) if index not in held_out)
    test = [small[index] for index in held_out]
    test = tuple(view for view in test if view.mask is None or np.any(view.mask))
    return replace(dataset, train=train, test=test), factor


def short_fit(
    config: FitConfig, split: Dataset, factor: int, progress: Callable[[int, int], None]
) -> ShortFit:
    """Fit the training views of ``split``, and render its test views; config: of a short fit."""
    split = with_background(split, config)
    config = resolve_defaults(config, split)
    trainer = Trainer(config, split, gaussians_at(_fewer(start_of(config, split)), config))
    started = time.perf_counter()
    while trainer.iteration < config.iterations:
        trainer.step()
        progress(trainer.iteration, config.iterations)
        if trainer.iteration == WARM_UP_ITERATIONS:
            dr.sync_thread()
            started = time.perf_counter()
    trainer.check()  # waits for the device
    wall_s = time.perf_counter() - started
    images = [np.asarray(image)[..., :3] for image in trainer.images(split.test)]
    pairs = zip(split.test, images, strict=True)
    alignments = [align(view, image, split.background) for view, image in pairs]
    gaussians = trainer.gaussians()
    trainer.release()
    return ShortFit(config, split, gaussians, images, alignments, factor, wall_s)


def _fewer(start: Start) -> Start:
    """Return at most as many points as a short fit has Gaussians."""
    every = -(-len(start.means) // NUM_GAUSSIANS)
    colors = None if start.colors is None else start.colors[::every]
    return replace(start, means=start.means[::every], colors=colors)


def _shorten(config: FitConfig) -> FitConfig:
    iterations = min(MAX_ITERATIONS, round(SHARE_OF_ITERATIONS * config.iterations))
    goal = getattr(config.densify.settings, "gaussians", None) or NUM_GAUSSIANS
    changes = {
        "densify.strategy": "budget",
        "densify.budget.gaussians": min(goal, NUM_GAUSSIANS),
        "densify.prune.to": None,
        "init.num_points": None,
        "coarse": None,
        "optimizer.views_per_step": 1,
    }
    return with_changes(with_iterations(config, iterations), changes)


def with_background(dataset: Dataset, config: FitConfig) -> Dataset:
    """Return the dataset with the configured background behind opaque photographs."""
    if any(view.alpha is not None for view in dataset.train) or config.data.background is None:
        return dataset
    return replace(dataset, background=config.data.background_rgb)


# Findings


def _findings(fit: ShortFit) -> list[Finding]:
    """Return the findings of what is shipped and of installed extensions."""
    effects = sorted((extension.value for extension in EFFECTS.all()), key=lambda e: e.order)
    found = [look(fit) for look in (_look_for_background, *(e.look_for for e in effects))]
    return [finding for finding in found if finding is not None]


def _look_for_background(fit: ShortFit) -> Finding | None:
    """Compare each pixel at the border of opaque photographs with the median of its border."""
    views = (*fit.dataset.train, *fit.dataset.test)
    if any(view.alpha is not None or view.mask is not None for view in views):
        return None
    borders = [_border(np.asarray(view.image)) for view in views]
    colors = [np.median(border, axis=0) for border in borders]
    deviations = [border - color for border, color in zip(borders, colors, strict=True)]
    share = float((np.abs(np.concatenate(deviations)) < BORDER_TOLERANCE).all(axis=1).mean())
    color = np.median(colors, axis=0)
    is_other = np.abs(color - fit.config.data.background_rgb).max() > BORDER_TOLERANCE
    background = tuple(round(float(value), 3) for value in color)
    shown = ", ".join(f"{value:.2f}" for value in background)
    return Finding(
        "background of one colour",
        f"{share:.0%} of each border has one colour, mostly {shown}",
        is_likely=share >= MIN_BORDER_SHARE and bool(is_other),
        changes={"data.background": background},
    )


def _border(image: np.ndarray) -> np.ndarray:
    """Return the outermost pixels (N, 3) of an image."""
    inner = np.zeros(image.shape[:2], bool)
    inner[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    return image[~inner]
