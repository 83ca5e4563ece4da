"""Whether there are enough blocks for more cores than this machine has: by counting, not by timing.

An iteration is timed on one thread, kernel by kernel; what more cores make of each follows from its
blocks: see :mod:`drgs.bench.blocks`, which also has the formula.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import drjit as dr

from drgs.bench.blocks import Pool, busiest_share, costs_of_blocks
from drgs.bench.limits import vector_width
from drgs.bench.profile import STAGES, CountedLaunch, counted_launches
from drgs.bench.scenes import Scene
from drgs.bench.speed import clocked_step, warm_trainer

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
    trainer = warm_trainer(scene)
    clocks = [clocked_step(trainer) for _ in range(rounds)]
    fastest = min(clocks, key=lambda clock: sum(clock.kernel_ms.values())).kernel_ms
    kernels, width = [], vector_width()
    for stage in STAGES:
        # Counted once, timed often: entries of other iterations need not be the same ones.
        once = sum(counted.launch.milliseconds for counted in launches[stage])
        factor = fastest[stage] / once
        kernels += [_blocks_of(stage, counted, width, factor) for counted in launches[stage]]
    return Speedups(kernels, min(clock.host_ms for clock in clocks))


def _blocks_of(stage: str, counted: CountedLaunch, width: int, factor: float) -> KernelBlocks:
    """width: lanes of a vector; factor: of the launch's time."""
    blocks, share = {}, {}
    for cores in CORES:
        pool = Pool(cores, width)
        costs = costs_of_blocks(counted.launch, pool, counted.trips)
        blocks[cores], share[cores] = len(costs), busiest_share(costs, cores)
    launch = counted.launch
    milliseconds = factor * launch.milliseconds
    return KernelBlocks(stage, launch.type, launch.size, milliseconds, blocks, share)
