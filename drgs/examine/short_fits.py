"""Short fits to small photographs, of which some are left out, within a given time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import repeat

import drjit as dr
import numpy as np

from drgs.config.changes import with_changes, with_iterations
from drgs.config.schema import FitConfig
from drgs.datasets.images import smaller_view, with_arrays
from drgs.datasets.types import Dataset, evenly_spaced
from drgs.effects.base import ShortFit
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.start import gaussians_at, start_of
from drgs.results.alignment import align
from drgs.training.trainer import Trainer

SHORT_FIT_WIDTH_PX = 135  # about: of photographs in short fits
NUM_GAUSSIANS = 15_000
SHARE_OF_ITERATIONS, MAX_ITERATIONS, MIN_ITERATIONS = 1 / 6, 400, 250
"""A short fit has this share of the fit's iterations, within these bounds; a fit that is shorter
than six times the least is not examined."""

MIN_ITERATIONS_OF_FIT = round(MIN_ITERATIONS / SHARE_OF_ITERATIONS)

MAX_VIEWS = 160  # photographs of an examination
NUM_HELD_OUT, HELD_OUT_STRIDE, MAX_HELD_OUT = 10, (4, 8), 20
"""Photographs that are left out, about: one in four to one in eight, and by so many folds that they
are 20. Those after the first are fitted for an effect that it leaves undecided."""

WARM_UP_ITERATIONS = 20  # of a short fit, whose time does not count: kernels are compiled

TIMED_ITERATIONS, GROWTH = 10, 1.6
"""Iterations by which the time of a short fit is predicted, and the time of later ones and of
renderings, relative to these."""


class OutOfTimeError(Exception):
    """The time of an examination is over."""


def check_time(end: float) -> None:
    """Raise :class:`OutOfTimeError` after ``end``, by ``time.perf_counter``."""
    if time.perf_counter() > end:
        raise OutOfTimeError


def split_views(dataset: Dataset) -> tuple[list[Dataset], int]:
    """Return folds of training photographs, small, that leave their ``test`` out; the divisor."""
    views = evenly_spaced(dataset.train, MAX_VIEWS)
    factor = max(1, round(max(view.width for view in views) / SHORT_FIT_WIDTH_PX))
    stride = int(np.clip(len(views) // NUM_HELD_OUT, *HELD_OUT_STRIDE))
    small = [with_arrays(smaller_view(view, factor)) for view in views]
    num_folds = min(stride, -(-MAX_HELD_OUT * stride // len(views)))
    folds = []
    for first in np.roll(np.arange(stride), -(stride // 2))[:num_folds]:
        train = tuple(view for index, view in enumerate(small) if index % stride != first)
        test = tuple(v for v in small[first::stride] if v.mask is None or np.any(v.mask))
        folds.append(replace(dataset, train=train, test=test))
    return folds, factor


def fit_fold(
    config: FitConfig,
    folds: Sequence[Dataset],
    number: int,
    factor: int,
    progress: Callable[[int, int], None],
    end: float = math.inf,
    with_trained: bool = False,
) -> ShortFit:
    """Fit the training views of a fold, and render its test views; config: of a short fit.

    Photographs that the configuration leaves out are tested in the first fold. with_trained: render
    the training views as well. Raises :class:`OutOfTimeError` after ``end``, by
    ``time.perf_counter``.
    """
    left_out, fold = {*config.data.leave_out}, folds[number]
    train = tuple(view for view in fold.train if view.name not in left_out)
    others = () if number else tuple(view for view in fold.train if view.name in left_out)
    split = with_background(replace(fold, train=train, test=(*fold.test, *others)), config)
    trainer = _make_trainer(config, split)
    started = time.perf_counter()
    while trainer.iteration < config.iterations:
        trainer.step()
        progress(trainer.iteration, config.iterations)
        check_time(end)
        if trainer.iteration in (WARM_UP_ITERATIONS, WARM_UP_ITERATIONS + TIMED_ITERATIONS):
            dr.sync_thread()
            now, left = time.perf_counter(), config.iterations - trainer.iteration
            if trainer.iteration == WARM_UP_ITERATIONS:
                started = now
            else:
                check_time(end - GROWTH * left * (now - started) / TIMED_ITERATIONS)
    trainer.check()  # waits for the device
    wall_s, count = time.perf_counter() - started, len(split.test)
    views = (*split.test, *split.train) if with_trained else split.test
    images = [np.asarray(image)[..., :3] for image in trainer.images(views)]
    with ThreadPoolExecutor() as pool:
        found = list(pool.map(align, views, images, repeat(split.background)))
    tested, trained = (images[:count], found[:count]), (found[count:], images[count:])
    gaussians = trainer.gaussians()
    trainer.release()
    return ShortFit(trainer.config, split, gaussians, *tested, factor, wall_s, *trained)


def add_fold(
    fit: ShortFit, folds: Sequence[Dataset], progress: Callable[[int, int], None], end: float
) -> ShortFit:
    """Return a fit with the test views of the next fold; the same errors."""
    more = fit_fold(fit.config, folds, fit.num_folds, fit.factor, progress, end)
    return replace(
        fit,
        dataset=replace(fit.dataset, test=(*fit.dataset.test, *more.dataset.test)),
        images=[*fit.images, *more.images],
        alignments=[*fit.alignments, *more.alignments],
        num_folds=fit.num_folds + 1,
    )


def _make_trainer(config: FitConfig, split: Dataset) -> Trainer:
    config = resolve_defaults(config, split)
    start = start_of(config, split)
    every = -(-len(start.means) // NUM_GAUSSIANS)  # at most as many points as Gaussians
    colors = None if start.colors is None else start.colors[::every]
    start = replace(start, means=start.means[::every], colors=colors, gaussians=None)
    return Trainer(config, split, gaussians_at(start, config))


def shorten(config: FitConfig) -> FitConfig:
    """Return the configuration of a short fit."""
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
