"""A fit for a given time: strategy, number of iterations, and end.

``scenes/studies/training.py`` measures quality over time on the shipped scene: a curve for each
:class:`Strategy`, in the time of an iteration at the start of a fit, with full images and the first
Gaussians. A rehearsal of the planned fit converts it to seconds, and the strategy whose curve is
highest at the deadline is chosen. Curves of another scene predict a time to some ten or twenty per
cent, so the clock ends the fit (:func:`deadline`): it cuts the last phase, when rates are small, or
appends iterations at the final rates. Its configuration gives the same bytes without a clock.
"""

from __future__ import annotations

import csv
import math
import re
import time
from argparse import ArgumentTypeError
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from drgs.config.changes import with_changes, with_iterations
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError, note_user
from drgs.datasets.types import Dataset
from drgs.fit.inputs import share_inputs
from drgs.fit.loop import Continues
from drgs.fit.memory import room_for_targets
from drgs.fit.report import seconds_of_results
from drgs.fit.viewers_fit import ROUNDED_ITERATIONS, ROUNDING_SECONDS, TIME_SHARE
from drgs.gaussians.parameters import Gaussians
from drgs.training.contracts import NO_PARTS, GivenParts
from drgs.training.parallel.communicator import Communicator
from drgs.training.trainer import Trainer

CURVES = Path(__file__).parent / "training_curves.csv"

MIN_ITERATIONS = 50  # fewer fit nothing

MIN_SIDE_PX = 32  # images of coarse stages are not smaller than SSIM's windows need

WARM_UP_ITERATIONS, MIN_TIMED_ITERATIONS, REHEARSAL_VIEWS = 6, 20, 8
"""Iterations of a rehearsal: those that compile kernels, and the fewest that are timed; its views.
"""

REHEARSAL_SHARE, MAX_REHEARSAL_S = 0.03, 10.0  # of the time: what a rehearsal may take, at most

EXAMINATION_SHARE = 0.1  # of the time: what an examination of the photographs may take

NEVER = 1_000_000_000  # an iteration after all

MAX_IMAGES_SHARE = 0.33
"""Share of the time that ``--budget`` leaves: images that take more are left out."""

MAX_SECONDS = 7 * 24 * 3600.0


@dataclass(frozen=True)
class Budget:
    """The time that a fit may take, results included."""

    seconds: float  # as the user gave it
    end: float  # by time.perf_counter

    @property
    def rehearsal_s(self) -> float:
        """Seconds of a rehearsal."""
        return min(REHEARSAL_SHARE * self.seconds, MAX_REHEARSAL_S)

    @property
    def examination_s(self) -> float:
        """Seconds of an examination, from now."""
        return max(0.0, min(EXAMINATION_SHARE * self.seconds, self.end - time.perf_counter()))


@dataclass(frozen=True)
class Strategy:
    """A fast variant of a fit, besides the number of iterations."""

    name: str  # of its curve
    half_size: float | None = None  # share of the iterations, at the start, with small images
    share: float | None = None  # of the number of Gaussians; None: as configured

    def applies_to(self, config: FitConfig) -> bool:
        """Return whether it changes something: coarse stages that there are stay."""
        if self.half_size is not None and config.coarse:
            return False
        return self.share is None or target_of(config) is not None

    def apply(self, config: FitConfig, num_points: int) -> FitConfig:
        """Return ``config`` with this strategy; num_points: Gaussians at the start, the fewest."""
        changes: dict[str, object] = {}
        if self.half_size is not None:
            until = max(1, round(self.half_size * config.iterations))
            changes["coarse"] = [{"until": until, "factor": 2}]
        target = target_of(config)
        if self.share is not None and target is not None:
            least = max(num_points, config.init.num_points or 0)
            number = max(least, round(self.share * target))
            changes[f"densify.{config.densify.strategy}.gaussians"] = number
        return with_changes(config, changes)


def target_of(config: FitConfig) -> int | None:
    """Return the number of Gaussians that a fit grows to; None: its strategy has none."""
    number = getattr(getattr(config.densify, config.densify.strategy, None), "gaussians", None)
    return None if number is None else min(number, config.densify.max_gaussians)


STRATEGIES = (
    Strategy("as shipped"),
    Strategy("half size for the first quarter", half_size=0.25),
    Strategy("half as many Gaussians", share=0.5),
    Strategy("no more Gaussians than at the start", share=0.0),
)


@dataclass(frozen=True)
class Curve:
    """Measured points of one strategy, by ascending number of iterations.

    Time is interpolated as a power of the number of iterations, PSNR in its logarithm.
    """

    iterations: tuple[int, ...]
    time: tuple[float, ...]  # in iterations of the initial Gaussians
    psnr: tuple[float, ...]  # dB, test views of the shipped scene

    def iterations_in(self, time: float) -> int:
        """Return the number of iterations that take ``time``."""
        log_n = _interpolate(math.log(time), np.log(self.time), np.log(self.iterations))
        return math.floor(math.exp(log_n) + 1e-9)

    def psnr_at(self, iterations: int) -> float:
        """Return the PSNR after a number of iterations."""
        return _interpolate(math.log(iterations), np.log(self.iterations), self.psnr)


def _interpolate(x: float, xs: ArrayLike, ys: ArrayLike) -> float:
    """Interpolate linearly; beyond the ends as in the last piece."""
    xs, ys = np.asarray(xs), np.asarray(ys)
    i = min(max(int(np.searchsorted(xs, x)), 1), len(xs) - 1)
    return float(ys[i - 1] + (x - xs[i - 1]) / (xs[i] - xs[i - 1]) * (ys[i] - ys[i - 1]))


def load_curves() -> dict[str, Curve]:
    """Read the curves of all strategies, by name."""
    with CURVES.open(newline="") as file:
        rows = list(csv.DictReader(file))
    points: dict[str, list[tuple[int, float, float]]] = {each.name: [] for each in STRATEGIES}
    for row in (row for row in rows if row["choice"] in points):
        seconds = float(row["wall_s"]) / float(row["start_s"])
        points[row["choice"]].append((int(row["iterations"]), seconds, float(row["psnr"])))
    return {name: Curve(*zip(*sorted(found), strict=True)) for name, found in points.items()}


@dataclass(frozen=True)
class Candidate:
    """A strategy, and the iterations and the PSNR that a given time allows."""

    strategy: Strategy
    iterations: int
    psnr: float  # dB, on the shipped scene


@dataclass(frozen=True)
class Plan:
    """A configuration without open values, and where it comes from."""

    config: FitConfig
    chosen: Candidate
    candidates: tuple[Candidate, ...]
    reasons: str  # as text
    end: float = math.inf  # of the iterations, by time.perf_counter


def make_plan(
    config: FitConfig,
    num_points: int,
    side: int,
    seconds: float,
    start_s: float,
    curves: Mapping[str, Curve],
) -> Plan:
    """Return the best plan for ``seconds`` of iterations, one of which takes ``start_s``.

    config: without open values. start_s: of the first iterations. num_points: Gaussians at the
    start. side: shortest side of the training images, px.

    Raises :class:`UserError` if the time is too short for any plan.
    """
    candidates = []
    for strategy in STRATEGIES:
        fits = strategy.half_size is None or side / 2 >= MIN_SIDE_PX
        if strategy.name in curves and fits and strategy.applies_to(config):
            curve = curves[strategy.name]
            iterations = curve.iterations_in(seconds / start_s) if seconds > 0 else 0
            if iterations >= MIN_ITERATIONS:
                candidates.append(Candidate(strategy, iterations, curve.psnr_at(iterations)))
    if not candidates:
        raise UserError(
            f"--budget: must leave time for {MIN_ITERATIONS} iterations, got "
            f"{max(seconds, 0):.0f} s where an iteration takes {1e3 * start_s:.0f} ms; give more "
            "time, or smaller images (--set data.image_size=...)"
        )
    chosen = max(candidates, key=lambda candidate: candidate.psnr)
    planned = with_iterations(config, chosen.iterations)
    planned = chosen.strategy.apply(planned, num_points)
    most = max(num_points, target_of(planned) or planned.densify.max_gaussians)
    stages = [f"1/{s.factor} size until iteration {s.until:,}" for s in planned.coarse]
    sizes = ", ".join([*stages, "then full size"]) if stages else "full size"
    reasons = [
        f"An iteration takes {1e3 * start_s:.0f} ms at the start here.",
        f"By the curves of the shipped scene, {seconds:.0f} s are enough for",
        *(
            f"  {c.iterations:7,} iterations, {c.psnr:.2f} dB there: {c.strategy.name}"
            + (" (chosen)" if c == chosen else "")
            for c in candidates
        ),
        f"Planned: {planned.iterations:,} iterations; {sizes}; at most {most:,} "
        f"Gaussians; the population changes until iteration {planned.densify.stop:,}.",
        "The fit ends when the time is up, some iterations earlier or later.",
    ]
    return Plan(planned, chosen, tuple(candidates), "\n".join(reasons))


def rehearse(
    config: FitConfig | None,
    dataset: Dataset | None,
    gaussians: Gaussians,
    comm: Communicator | None = None,
    parts: GivenParts = NO_PARTS,
    seconds: float = 0.0,
) -> tuple[Trainer, float]:
    """Run iterations on a few of the views, for some seconds; return their trainer, and one's time.

    An iteration has full images and the first Gaussians. The arguments are those of
    :class:`Trainer`; configuration and dataset are None on other ranks than 0.
    """
    comm = comm or Communicator()
    if config is not None and dataset is not None:
        views_per_step = config.optimizer.views_per_step
        count = max(REHEARSAL_VIEWS, views_per_step)
        views = dataset.train[:: max(1, len(dataset.train) // count)][:count]
        dataset = replace(dataset, train=views)
        still = {"densify.start": NEVER, "densify.stop": NEVER + 1, "densify.prune.to": None}
        config = with_changes(config, {"coarse": [], **still})
    config, dataset = share_inputs(comm, config, dataset)
    room = room_for_targets(config, dataset, gaussians.num_gaussians, comm)
    trainer = Trainer(config, dataset, gaussians, comm, deepcopy(parts), room=room)
    views_per_step = config.optimizer.views_per_step
    least = math.ceil(MIN_TIMED_ITERATIONS / views_per_step)
    run_steps(trainer, max(2, math.ceil(WARM_UP_ITERATIONS / views_per_step)))
    step_s = run_steps(trainer, max(2, least)) / max(2, least)
    more = int(comm.broadcast_numbers(math.floor(seconds / step_s)))
    if more > least:
        step_s = run_steps(trainer, more) / more
    return trainer, step_s / views_per_step


def run_steps(trainer: Trainer, count: int) -> float:
    """Run some steps of a trainer; return their seconds."""
    start = time.perf_counter()
    reports = [trainer.step() for _ in range(count)]
    _ = reports[-1].loss  # waits for the device
    return time.perf_counter() - start


def plan_fit(
    config: FitConfig,
    dataset: Dataset,
    gaussians: Gaussians,
    end: float,
    scene: mi.Scene,
    start_s: float,
) -> Plan:
    """Plan a fit, results included, until ``end``, by ``time.perf_counter``.

    scene: of the first Gaussians; start_s: of an iteration at the start.
    """
    num_points, most = gaussians.num_gaussians, target_of(config) or 0
    results = seconds_of_results(scene, dataset, max(num_points, most), config.model.sh_degree)
    images = results.renders if config.output.save_renders else 0.0
    images += results.report if config.output.report else 0.0
    if images > MAX_IMAGES_SHARE * (end - time.perf_counter()):
        note_user(
            "--budget: the time is needed for iterations: no report, orbit and images are "
            "written (output.report, output.save_renders); python -m drgs.render OUT_DIR --out DIR "
            "makes images"
        )
        config = with_changes(config, {"output.report": False, "output.save_renders": False})
    else:
        end -= images
    end -= results.measuring
    if not config.model.approximations.is_default:
        end -= results.viewers
        end -= TIME_SHARE * max(0.0, end - time.perf_counter())
    if config.output.small_file is not None:  # whose iterations are as the last ones
        iteration_s = 2 * start_s + ROUNDING_SECONDS * max(num_points, most)
        end -= results.viewers + ROUNDED_ITERATIONS * iteration_s
    side = min(min(view.width, view.height) for view in dataset.train)
    plan = make_plan(config, num_points, side, end - time.perf_counter(), start_s, load_curves())
    return replace(plan, end=end)


def deadline(end: float, comm: Communicator) -> Continues:
    """Let a fit run until ``end``, by ``time.perf_counter`` of rank 0."""

    def is_time_left(trainer: Trainer) -> bool:
        return bool(comm.broadcast_numbers(time.perf_counter() < end or trainer.iteration == 0))

    return is_time_left


_NUMBER = r"(\d+(?:\.\d+)?)"

_DURATION = re.compile(f"(?:{_NUMBER}h)?(?:{_NUMBER}m)?(?:{_NUMBER}s)?|{_NUMBER}", re.ASCII)


def parse_duration(text: str) -> float:
    """Return the seconds of ``90``, ``5m`` or ``1h30m``; raise ``ArgumentTypeError`` for others."""
    match = _DURATION.fullmatch(text.strip())
    parts = match.groups(default="0") if match else ()
    seconds = sum(scale * float(part) for scale, part in zip((3600, 60, 1, 1), parts, strict=False))
    if not 0 < seconds <= MAX_SECONDS:
        raise ArgumentTypeError(
            f"must be a time such as 90s, 5m or 1h30m, a week at most, got {text!r}"
        )
    return seconds
