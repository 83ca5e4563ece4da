"""Whether there are enough blocks for more cores than this machine has: by counting, not by timing.

An iteration is timed on one thread, kernel by kernel; what more cores make of each follows from its
blocks: see :mod:`drgs.bench.blocks`, which also has the formula.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from functools import partial

import drjit as dr

from drgs.bench.blocks import Pool, busiest_share, costs_of_blocks
from drgs.bench.costs import COPIES
from drgs.bench.profile import STAGES, CountedLaunch, counted_launches
from drgs.bench.scenes import Scene
from drgs.bench.speed import clocked_step, time_iterations, warm_trainer
from drgs.core.private import lanes_of_a_block, vector_width

CORES = (2, 4, 8, 16, 32, 64)


@dataclass(frozen=True)
class KernelBlocks:
    """Of one kernel."""

    stage: str
    type: str
    size: int
    milliseconds: float  # on one thread
    blocks: dict[int, int]  # by number of cores
    share: dict[int, float]  # of its work, that the busiest core has


@dataclass(frozen=True)
class Speedups:
    """Of a training iteration."""

    kernels: list[KernelBlocks]
    host_ms: float  # in which no kernel runs

    def milliseconds(self, stage: str) -> float:
        """Of a stage's kernels, on one thread."""
        return sum(kernel.milliseconds for kernel in self.kernels if kernel.stage == stage)

    def bound(self, stage: str | None, cores: int) -> float:
        """Bound of the speed-up of one stage's kernels; None: of the whole iteration."""
        chosen = [kernel for kernel in self.kernels if stage in (None, kernel.stage)]
        serial = self.host_ms if stage is None else 0.0
        alone = serial + sum(kernel.milliseconds for kernel in chosen)
        return alone / (serial + sum(k.milliseconds * k.share[cores] for k in chosen))


def count_blocks(scene: Scene, rounds: int) -> Speedups:
    """Time an iteration on one thread, and count the blocks of its kernels for more.

    To be called in a process of its own: it leaves one thread behind.
    """
    dr.set_thread_count(1)
    launches = counted_launches(lambda: partial(clocked_step, warm_trainer(scene)))
    host_ms, times = _time_alone(scene, rounds)
    kernels = [
        _blocks_of(stage, counted, milliseconds)
        for stage in STAGES
        for counted, milliseconds in zip(_kernels(launches[stage]), times[stage], strict=True)
    ]
    return Speedups(kernels, host_ms)


def _kernels(launches: list[CountedLaunch]) -> list[CountedLaunch]:
    return [counted for counted in launches if counted.launch.type not in COPIES]


def _time_alone(scene: Scene, rounds: int) -> tuple[float, dict[str, list[float]]]:
    """Milliseconds without a kernel, and of each kernel by stage: medians."""
    walls, clocks = time_iterations(warm_trainer(scene), rounds)
    times = {
        stage: [
            statistics.median(launch.milliseconds for launch in same)
            for same in zip(*(_without_copies(c.launches[stage]) for c in clocks), strict=True)
        ]
        for stage in STAGES
    }
    kernels = statistics.median(sum(clock.kernel_ms.values()) for clock in clocks)
    return 1e3 * statistics.median(walls) - kernels, times


def _without_copies(launches: list) -> list:
    return [launch for launch in launches if launch.type not in COPIES]


def _blocks_of(stage: str, counted: CountedLaunch, milliseconds: float) -> KernelBlocks:
    blocks, share = {}, {}
    for cores in CORES:
        pool = Pool(cores, vector_width(), lanes_of_a_block())
        costs = costs_of_blocks(counted.launch, pool, counted.trips)
        blocks[cores], share[cores] = len(costs), busiest_share(costs, cores)
    launch = counted.launch
    return KernelBlocks(stage, launch.type, launch.size, milliseconds, blocks, share)
