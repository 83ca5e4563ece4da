"""Time and count the work of a computation."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import drjit as dr
import numpy as np

SLOW_S, SLOW_ROUNDS = 1.0, 3  # slower tasks are timed in SLOW_ROUNDS
VERY_SLOW_S = 15.0  # slower tasks are called once


def seconds(function: Callable[[], object]) -> float:
    """Time one call."""
    started = time.perf_counter()
    function()
    return time.perf_counter() - started


def count_operations(function: Callable[[], object]) -> int:
    """Count the operations in the kernels that a call launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        function()
        return sum(kernel["operation_count"] for kernel in dr.kernel_history([dr.KernelType.JIT]))


def time_in_turns(tasks: Sequence[Sequence[Callable[[], object]]], rounds: int) -> list[np.ndarray]:
    """Return the seconds (R, F) of each task's F functions in R rounds.

    In turns, so that other load affects all tasks, and in random order, as caches depend on the
    previous call. Slow tasks have fewer rounds. A first call, which compiles kernels, does not
    count.
    """

    def call(task: Sequence[Callable[[], object]]) -> list[float]:
        return [seconds(function) for function in task]

    first = [call(task) for task in tasks]
    times = [[spent] if sum(spent) > VERY_SLOW_S else [] for spent in first]
    rng = np.random.default_rng(0)
    for turn in range(rounds):
        for k in rng.permutation(len(tasks)):
            fastest = min(map(sum, times[k]), default=0.0)
            if fastest < SLOW_S or (turn < SLOW_ROUNDS and fastest < VERY_SLOW_S):
                times[k].append(call(tasks[k]))
    return [np.array(each) for each in times]
