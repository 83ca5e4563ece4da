"""Effects that a dataset needs, chosen by measurement: :func:`examine`.

A short fit leaves some training photographs out. What they differ by from its renderings shows
which effects are likely (:class:`drgs.effects.base.Finding`); each of these is simulated in a short
fit of its own, and chosen if the photographs that were left out are matched better. What can be
measured without is chosen at once. Test photographs are not looked at.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from types import NoneType
from typing import cast

import mitsuba as mi
import numpy as np
from pydantic import ValidationError
from scipy.stats import wilcoxon
from typing_extensions import override

from drgs.cli.execution import select_variant
from drgs.config.changes import given_keys, with_changes
from drgs.config.extensions import EFFECTS, EXAMINERS
from drgs.config.load import config_from
from drgs.config.schema import FitConfig
from drgs.core.environment import VARIANTS
from drgs.core.errors import UserError, check_type, one_line
from drgs.datasets.types import Dataset
from drgs.effects.base import Finding, Progress, ShortFit
from drgs.effects.photometry import camera_key
from drgs.examine import short_fits
from drgs.examine.photographs import look_for_bad_photographs, look_for_moving_things
from drgs.initialization.defaults import resolve_defaults
from drgs.training.finite_checks import NonFiniteError

MIN_VIEWS = 20  # photographs of an examination; with fewer there is none

MIN_GAIN_DB, CONFIDENCE, TRIMMED = 0.05, 0.99, 0.1
"""A gain that counts: in itself, and the confidence that gains of held-out photographs are above
zero, by Wilcoxon's signed ranks without the share of them that is farthest from their middle.
Leaving these out makes 0.97 of it, for normal gains."""

MIN_CAMERA_VIEWS = 8  # held-out, of a camera whose gains alone may count

MIN_RESEMBLANCE = 0.6  # of short fits; 0.89 to 0.98, and 0.36 of dark ones that stay blurred

BORDER_PX, BORDER_TOLERANCE, MIN_BORDER_SHARE = 2, 0.04, 0.6
"""A background of one colour: of each photograph's border, this share has it, but for this."""


@dataclass(frozen=True, kw_only=True)
class Decision:
    """A row of the table: an effect, the evidence, and what a short fit has gained with it."""

    effect: str
    evidence: str
    gain: float | None = None  # dB, middle of held-out photographs; None: it was not tried
    spread: float | None = None  # dB: standard error of this middle
    cost: float | None = None  # time of iterations, relative to those without the effect
    changes: Mapping[str, object]  # values of the configuration that simulate it, by key
    advice: str = ""  # where they are not chosen, or there are none
    chosen: bool = False


@dataclass(frozen=True)
class Examination:
    """Decisions about a dataset, with the evidence."""

    decisions: tuple[Decision, ...]
    num_held_out: int  # training photographs
    wall_s: float
    note: str = ""  # why nothing was examined, if so

    @property
    def bad_photographs(self) -> list[str]:
        """Names of photographs that should be left out, chosen or not."""
        tried = [each.changes for each in self.decisions if each.gain is not None]
        named = [cast("list[str]", changes.get("data.leave_out", [])) for changes in tried]
        return [name for names in named for name in names]

    @property
    def changes(self) -> dict[str, object]:
        """Values of the configuration that were chosen, by key."""
        chosen = [decision.changes for decision in self.decisions if decision.chosen]
        return {key: value for changes in chosen for key, value in changes.items()}

    @property
    def reasons(self) -> dict[str, str]:
        """The evidence for each of these, by key."""
        return {
            key: decision.evidence + ("" if decision.gain is None else f": {decision.gain:+.2f} dB")
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
            last = keys if one.chosen else one.advice or "no"
            rows.append((one.effect, one.evidence, gain, cost, last))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = (
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        )
        title = f"examined in {self.wall_s:.0f} s, on {self.num_held_out} held-out views"
        return "\n  ".join([f"{title}:", *lines])


@EXAMINERS.register("short_fits")
def examine(
    dataset: Dataset,
    config: FitConfig | Mapping[str, object] | None = None,
    progress: Progress | None = None,
    seconds: float | None = None,
) -> Examination:
    """Return which effects the dataset's training photographs need, with the evidence.

    config: of the fit, or nested mappings, by default all defaults; effects whose keys it gives are
    not examined. With a fit that is too short, or fewer than 20 training photographs, nothing is
    examined, and ``note`` says so. seconds: that the examination may take, which is smaller then,
    or none. Activates the Mitsuba variant ``llvm_ad_rgb`` where none is active.

    Effects look for themselves: ``drgs.effects.base.TrainingEffect.look_for``.
    """
    check_type("examine()", "dataset", dataset, Dataset)
    check_type("examine()", "config", config, FitConfig, Mapping, NoneType)
    check_type("examine()", "seconds", seconds, int, float, NoneType)
    started = time.perf_counter()
    end = math.inf if seconds is None else started + seconds
    if not isinstance(config, FitConfig):
        values = dict(config or {})
        values["data"] = {"path": ".", **cast("Mapping[str, object]", values.get("data", {}))}
        config = config_from(values, "examine(): config")
    if note := _reason_not_examined(config, dataset):
        return Examination((), 0, 0.0, note)
    given, short = given_keys(config), short_fits.shorten(resolve_defaults(config, dataset))
    folds, factor = short_fits.split_views(dataset)
    progress = progress or (lambda what, done, total: None)
    if mi.variant() is None:
        select_variant(VARIANTS[0])
    try:
        steps = partial(progress, "baseline")
        base = short_fits.fit_fold(short, folds, 0, factor, steps, end, True)
    except short_fits.OutOfTimeError:
        note = f"short fits take longer than the {seconds:.0f} s that --budget leaves for them"
        return Examination((), 0, time.perf_counter() - started, note)
    # The share of training photographs' variance that aligned renderings do not explain.
    pairs = zip(base.dataset.train, base.trained, strict=True)
    left = [10 ** (-one.psnr / 10) / np.var(np.asarray(view.image)) for view, one in pairs]
    if (alike := 1 - np.median(left)) < MIN_RESEMBLANCE:
        note = f"short fits have {alike:.0%} of the photographs' variance, too little to compare"
        return Examination((), 0, time.perf_counter() - started, note)
    decisions = []
    for finding in _findings(base):
        if any(overlaps(key, other) for key in finding.changes for other in given):
            continue
        decision, base = _try(finding, base, folds, partial(progress, finding.effect), end)
        decisions.append(decision)
    chosen = {key for each in decisions if each.chosen for key in each.changes}
    if "data.background" not in chosen:  # beside one colour, all of the object differs
        decisions.append(_reject(look_for_moving_things(base)))
    num_held_out = sum(len(fold.test) for fold in folds[: base.num_folds])
    return Examination(tuple(decisions), num_held_out, time.perf_counter() - started)


def _try(
    finding: Finding,
    base: ShortFit,
    folds: Sequence[Dataset],
    progress: Callable[[int, int], None],
    end: float,
) -> tuple[Decision, ShortFit]:
    """Return the decision about a finding, and the fit beside which the next one is tried.

    A fold after the first is fitted while the effect gains, but not enough.
    """
    if not finding.is_likely or finding.is_measured:
        return replace(_reject(finding), chosen=finding.is_likely), base
    tried = decision = None
    try:
        while decision is None or (not decision.chosen and (decision.gain or 0) > MIN_GAIN_DB):
            short_fits.check_time(end - base.wall_s)
            if tried is None:
                changed = with_changes(base.config, {**finding.changes, **finding.in_short_fits})
                tried = short_fits.fit_fold(changed, folds, 0, base.factor, progress, end)
            elif tried.num_folds < len(folds):
                if base.num_folds == tried.num_folds:
                    base = short_fits.add_fold(base, folds, progress, end)
                tried = short_fits.add_fold(tried, folds, progress, end)
            else:
                break
            confirmed = finding if finding.confirm is None else finding.confirm(tried)
            if confirmed is None:
                return _reject(finding, "; a fit with it does not confirm it"), base
            decision = decide(confirmed, base, tried, len(folds))
    except short_fits.OutOfTimeError:
        if decision is None:
            return _reject(finding, "; no time was left to try it"), base
    except (ValidationError, UserError, NonFiniteError) as error:
        return _reject(finding, f"; could not be tried: {one_line(error, 100)}"), base
    assert tried is not None and decision is not None, "a fit was tried"
    return decision, tried if decision.chosen else base


def decide(finding: Finding, without: ShortFit, fitted: ShortFit, num_looks: int = 1) -> Decision:
    """Return the decision about an effect from two short fits: the second one simulates it.

    num_looks: so often it may be decided, after one fold and after more. Each decision has its
    share of the chance of a false alarm (Bonferroni).

    The gain is the median of the mean gains of all pairs of held-out photographs, by ranks (Hodges
    and Lehmann 1963), which a few that differ do not move, nor do they spread it. It counts where
    it does over all photographs, or over those of one camera while others do not lose.
    """
    pairs = (zip(fit.dataset.test, fit.psnr, strict=True) for fit in (without, fitted))
    before, after = ({view.name: psnr for view, psnr in each} for each in pairs)
    kept = before.keys() - {*fitted.config.data.leave_out}
    views = [view for view in fitted.dataset.test if view.name in kept]
    gains = np.array([after[view.name] - before[view.name] for view in views])
    keys = [camera_key(view) for view in views]
    cameras = [gains[[key == other for other in keys]] for key in dict.fromkeys(keys)]
    cameras = [each for each in cameras if len(each) >= MIN_CAMERA_VIEWS]
    (gain, spread), chance = middle_of(gains), (1 - CONFIDENCE) / num_looks
    alone = any(_counts(each, chance / len(cameras)) for each in cameras)
    agree = all(middle_of(each)[0] > -MIN_GAIN_DB for each in cameras)
    chosen, cost = _counts(gains, chance) or (alone and agree), fitted.wall_s / without.wall_s
    return replace(_reject(finding), gain=gain, spread=spread, cost=cost, chosen=chosen)


def middle_of(gains: np.ndarray) -> tuple[float, float]:
    """Return Hodges and Lehmann's estimate of the gains' middle, and its standard error.

    The error is that of the normal distribution which has its interval of ranks.
    """
    count = len(gains)
    rows, columns = np.triu_indices(count)
    means = np.sort((gains[rows] + gains[columns]) / 2)
    off = np.sqrt(count * (count + 1) * (2 * count + 1) / 24)  # of the ranks' sum
    ends = np.clip(len(means) / 2 + off * np.array([-1, 1]), 0, len(means) - 1).round().astype(int)
    return float(np.median(means)), float(np.diff(means[ends])[0] / 2)


def _counts(gains: np.ndarray, max_chance: float) -> bool:
    middle, _ = middle_of(gains)
    order = np.argsort(np.abs(gains - middle), kind="stable")
    kept = gains[order[: len(gains) - int(TRIMMED * len(gains))]]
    if middle <= MIN_GAIN_DB:  # ranks of zeros have no deviation
        return False
    _, chance = cast("tuple[float, float]", wilcoxon(kept, alternative="greater"))
    return bool(chance <= max_chance)


def _reject(finding: Finding, reason: str = "") -> Decision:
    row = {name: getattr(finding, name) for name in ("effect", "changes", "advice")}
    return Decision(evidence=finding.evidence + reason, **row)


def _reason_not_examined(config: FitConfig, dataset: Dataset) -> str:
    count, least = len(dataset.train), short_fits.MIN_ITERATIONS_OF_FIT
    if count < MIN_VIEWS:
        return f"{count} training photographs are fewer than {MIN_VIEWS}"
    if config.iterations < least:
        return f"{config.iterations} iterations are fewer than {least}"
    return ""


def overlaps(key: str, other: str) -> bool:
    """Return whether two keys are the same, or one is that of a section with the other."""
    return f"{key}.".startswith(f"{other}.") or f"{other}.".startswith(f"{key}.")


# Findings


def _findings(fit: ShortFit) -> Iterator[Finding]:
    """Yield the findings of what is shipped and of installed extensions."""
    effects = sorted((extension.value for extension in EFFECTS.all()), key=lambda e: e.order)
    looks = [_look_for_background, look_for_bad_photographs, *(e.look_for for e in effects)]
    for look in looks:
        found = look(fit)
        yield from [found] if isinstance(found, Finding) else found or ()


def _look_for_background(fit: ShortFit) -> Finding | None:
    """Compare each pixel at the border of opaque photographs with the median of its border."""
    views = (*fit.dataset.train, *fit.dataset.test)
    if any(view.alpha is not None or view.mask is not None for view in views):
        return None
    borders = []
    for view in views:
        inner = np.zeros((view.height, view.width), bool)
        inner[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
        borders.append(np.asarray(view.image)[~inner])  # (N, 3)
    colors = np.array([np.median(border, axis=0) for border in borders])
    deviations = [border - color for border, color in zip(borders, colors, strict=True)]
    share = float((np.abs(np.concatenate(deviations)) < BORDER_TOLERANCE).all(axis=1).mean())
    color = np.median(colors, axis=0)
    spread = np.median(np.abs(colors - color), axis=0)  # by exposure
    other = np.abs(color - fit.config.data.background_rgb) - 3 * spread
    is_likely = share >= MIN_BORDER_SHARE and bool(other.max() > BORDER_TOLERANCE)
    shown = ", ".join(f"{value:.2f}" for value in color)
    evidence = f"{share:.0%} of each border has one colour, mostly {shown}"
    changes = {"data.background": tuple(round(float(value), 3) for value in color)}
    return Finding("background of one colour", evidence, is_likely, changes)
