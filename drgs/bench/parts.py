"""What a step of several processes consists of; each of them runs this for ``drgs.bench.cluster``.

    mpiexec -n K python -m drgs.bench.parts TASK

TASK: the fields of :class:`Task` as JSON. The first process prints those of :class:`Measured`.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.bench.batches import RATES
from drgs.bench.scenes import BENCH_FIELD_OF_VIEW, bench_config, bench_gaussians
from drgs.config.changes import changed
from drgs.core.arrays import block_widths
from drgs.core.denormals import denormals_flushed
from drgs.core.processes import ending_together
from drgs.datasets.types import Dataset, View
from drgs.gaussians.parameters import Gaussians

DISTANCE, GAP = 4.0, 40.0
"""World units from a camera to the middle of its box, and from there to the next box."""

NEXT_TO_NOTHING = 1e-9
"""A learning rate: what is measured is to be the same in all steps."""

NUMBER = 4
"""Bytes."""

WARM_UP = 3
"""Steps, in which kernels are compiled."""


@dataclass(frozen=True)
class Task:
    """What is to be measured."""

    gaussians: int
    boxes: int  # that they are spread over; a view sees one
    size: int  # px, width and height of pictures
    views: int  # of a step
    threads: int
    steps: int


@dataclass(frozen=True)
class Part:
    """Of a step: milliseconds, and those of them in which a kernel ran."""

    all: float
    kernels: float


@dataclass(frozen=True)
class Measured:
    """Medians of steps, on the first process."""

    step_ms: float  # that nobody looks into
    project: Part  # a view
    render: Part  # a view
    go_back: Part  # a view
    optimize: Part  # a step
    renders_ms: list[float]  # of single views
    splats: float  # of a view, on its film
    splat_bytes: int  # of one that travels
    gradient_bytes: int  # of the derivatives with respect to one
    sent_bytes: float  # a step

    @staticmethod
    def from_json(text: str) -> Measured:
        """What a process has printed."""
        fields = json.loads(text.splitlines()[-1])
        parts = {name: Part(**value) for name, value in fields.items() if isinstance(value, dict)}
        return Measured(**{**fields, **parts})


# ----------------------------------------------------------------------------------------------
# The scene
# ----------------------------------------------------------------------------------------------


def boxes(task: Task) -> Gaussians:
    """A pile of boxes as ``drgs.bench.scenes`` has one, rows in any order.

    Gaussians are smaller where a box has more of them.
    """
    found = bench_gaussians(task.gaussians)
    means, rng = found.means.copy(), np.random.default_rng(1)
    means[:, 2] += np.float32(GAP) * rng.integers(0, task.boxes, task.gaussians)
    factor = np.float32(0.5 * np.log(100_000 * task.boxes / task.gaussians))
    return replace(found, means=means.astype(np.float32), log_scales=found.log_scales + factor)


def views_of(task: Task) -> tuple[View, ...]:
    """Cameras around the boxes, from above, which look at one each; photographs are noise."""
    rng, size, found = np.random.default_rng(2), task.size, []
    focal = size / (2 * np.tan(BENCH_FIELD_OF_VIEW / 2))
    for index in range(task.views):
        azimuth, height = 2 * np.pi * index / task.views, 0.4 + 0.1 * (index % 4)
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        away = np.array([np.cos(azimuth), np.sin(azimuth), 0]) * np.sqrt(1 - height**2)
        away[2] = height
        to_world = np.eye(4)
        to_world[:3, :3] = np.stack([right, np.cross(right, away), -away], axis=1)
        to_world[:3, 3] = DISTANCE * away + [0, 0, GAP * (index % task.boxes)]
        photograph, middle = rng.random((size, size, 3), np.float32), size / 2
        camera = focal, focal, middle, middle, size, size
        found.append(View(f"{index}", to_world, *camera, image=photograph))
    return tuple(found)


# ----------------------------------------------------------------------------------------------
# Measuring
# ----------------------------------------------------------------------------------------------


def measure(task: Task) -> Measured:
    """Times of steps, then of their parts, on one of several processes."""
    from drgs.training.parallel.ranks import Ranks, Times

    gaussians, views = boxes(task), views_of(task)
    dataset = Dataset(views, views[:1], "bench", (1.0, 1.0, 1.0), None, "bench")
    changes = {f"optimizer.{name}": NEXT_TO_NOTHING for name in RATES}
    config = changed(bench_config(gaussians), {"optimizer.views_per_step": task.views, **changes})
    trainer = _timed_trainer()(config, dataset, gaussians, Ranks.world())
    del gaussians
    _steps(trainer, WARM_UP)
    trainer.ranks.told(np.zeros(1))
    trainer.ranks.times = Times()
    steps = [_steps(trainer, 1) for _ in range(task.steps)]
    times, trainer.ranks.times = trainer.ranks.times, Times()
    clocked = [trainer.clocked_step() for _ in range(task.steps)]
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        looked_into = [trainer.clocked_step() for _ in range(task.steps)]

    def part(name: str, count: int) -> Part:
        """Of ``count`` in a step."""
        wall = statistics.median(sum(step.wall_ms[name]) for step in clocked)
        kernels = statistics.median(step.kernel_ms[name] for step in looked_into)
        return Part(wall / count, min(wall, kernels) / count)

    own = len(trainer.own_iterations())
    layout = trainer.layout
    return Measured(
        step_ms=statistics.median(steps),
        project=part("project", task.views),
        render=part("render", own),
        go_back=part("go back", task.views),
        optimize=part("optimize", 1),
        renders_ms=np.median([step.wall_ms["render"] for step in clocked], axis=0).tolist(),
        splats=trainer.num_splats / task.views,
        splat_bytes=NUMBER * sum(layout.widths),
        gradient_bytes=NUMBER * sum(block_widths(layout.num_gradients)),
        sent_bytes=times.sent_bytes / task.steps,
    )


def _steps(trainer: Any, count: int) -> float:
    """Milliseconds of some steps together."""
    start = time.perf_counter()
    for _ in range(count):
        trainer.step()
    dr.sync_thread()
    return 1e3 * (time.perf_counter() - start)


class StepClock:
    """Milliseconds of the parts of one step, without those that it was with others."""

    def __init__(self) -> None:
        names = ("project", "render", "go back", "optimize")
        self.wall_ms: dict[str, list[float]] = {name: [] for name in names}
        self.kernel_ms: dict[str, float] = dict.fromkeys(names, 0.0)


def _timed_trainer() -> type:
    """A class whose base can be imported where there is MPI."""
    from drgs.training.parallel.trainer import DistributedTrainer

    class TimedTrainer(DistributedTrainer):
        """Waits for the device after each part of a step, and writes down what it took."""

        clock: StepClock | None = None
        num_splats = 0  # of the last step's views

        def own_iterations(self) -> Sequence[int]:
            return self._own(self.iterations_of_step)

        def clocked_step(self) -> StepClock:
            self.clock = StepClock()
            with self._part("optimize"):
                self.step()
            clock, self.clock = self.clock, None
            others = sum(sum(clock.wall_ms[name]) for name in clock.wall_ms if name != "optimize")
            clock.wall_ms["optimize"][0] -= others
            return clock

        @contextmanager
        def _part(self, name: str) -> Iterator[None]:
            clock, times = self.clock, self.ranks.times
            if clock is None:
                yield
                return
            together = times.waiting + times.exchanging
            start = time.perf_counter()
            yield
            dr.sync_thread()
            spent = time.perf_counter() - start
            together = times.waiting + times.exchanging - together
            clock.wall_ms[name].append(1e3 * (spent - together))
            kernels = sum(kernel["execution_time"] for kernel in dr.kernel_history())
            clock.kernel_ms[name] += kernels

        def _sights(self, iteration: int) -> Any:
            with self._part("project"):
                return super()._sights(iteration)

        def _counts(self, sights: Any) -> Any:
            counts, self.layout = super()._counts(sights), sights[0][0].layout
            self.num_splats = sum(int(each.sum()) for each in counts)
            return counts

        def _render(self, *arguments: Any) -> Any:
            with self._part("render"):
                return super()._render(*arguments)

        def _add_gradients(self, *arguments: Any) -> None:
            with self._part("go back"):
                super()._add_gradients(*arguments)

    return TimedTrainer


@ending_together()
def main() -> None:
    """A process's part."""
    task = Task(**json.loads(sys.argv[1]))
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(task.threads)
    with denormals_flushed():
        found = measure(task)
    from drgs.training.parallel.ranks import Ranks

    if Ranks.world().is_first:
        print(json.dumps(asdict(found)))


if __name__ == "__main__":
    main()
