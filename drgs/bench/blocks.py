"""Into how many blocks Dr.Jit cuts a kernel, and how much more cores could make of them.

A block is what one thread works on; cores beyond the number of blocks have nothing to do. The
rules are those of Dr.Jit's LLVM backend (``src/llvm_ts.cpp`` of drjit-core) in version 1.5: older
sources have one block a thread where it has two. A test counts what Dr.Jit submits.

The bound on the speed-up is Amdahl's (1967), with each kernel k in place of *the* parallel part:

    S(P) = (h + sum_k t_k) / (h + sum_k t_k m_k(P))

h: time of an iteration on one thread in which no kernel runs (Python, tracing, launching); t_k: of
kernel k on one thread; m_k(P): the share of its work that the busiest of P cores has, if each takes
the next block as soon as it is free. Equal blocks are assumed to take equally long; in kernels with
loops, each vector of lanes takes as many steps as the longest of its loops. What several cores
share (memory's bandwidth, caches, clock) is not in it, nor what the host does while a kernel of the
same stage runs, which faster kernels no longer hide: it is a bound, not a forecast.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

LANES_OF_A_BLOCK = 16_384
"""Where there are enough lanes: Dr.Jit's default, which its Python interface cannot change."""


@dataclass(frozen=True)
class Pool:
    """What the number of blocks depends on."""

    threads: int
    width: int  # lanes of a vector
    block: int = LANES_OF_A_BLOCK


def blocks_of_lanes(size: int, pool: Pool) -> tuple[int, int]:
    """(number of blocks, lanes of each but the last) of a compiled kernel of ``size`` lanes.

    With few lanes a block is a vector, with more there are two blocks a thread, until they have
    ``pool.block`` lanes. Some of the last ones can be empty.
    """
    vectors = -(-size // pool.width)
    if pool.threads <= 1:
        return 1, vectors * pool.width
    if vectors <= pool.threads:
        return vectors, pool.width
    if size <= 2 * pool.threads * pool.block:
        count = 2 * pool.threads
        return count, -(-vectors // count) * pool.width
    return -(-size // pool.block), pool.block


def blocks_of_sort(size: int, pool: Pool) -> int:
    """Blocks of a pass of ``dr.argsort`` that counts or moves keys; between these, one thread adds
    up the counts."""
    if pool.threads <= 1:
        return 1
    return -(-size // max(pool.block, -(-size // (4 * pool.threads))))


def blocks_of_sum(size: int, pool: Pool) -> int:
    """Blocks of a sum or a prefix sum over ``size`` numbers."""
    if pool.threads <= 1 or size <= 2 * pool.block:
        return 1
    return -(-size // pool.block)


def costs_of_blocks(kernel: Any, pool: Pool, trips: Sequence[np.ndarray] = ()) -> np.ndarray:
    """Work of each block of a launch, in any unit.

    kernel: a ``Launch`` of ``profile``; trips: of the lanes of each of its loops.
    """
    if kernel.ir is None:
        return np.ones(_blocks_of_own(kernel, pool))
    _, lanes = blocks_of_lanes(kernel.size, pool)
    steps = np.ones(-(-kernel.size // pool.width))
    for trip in trips:
        steps += _by_vector(trip, pool.width)
    starts = np.arange(0, len(steps), max(lanes // pool.width, 1))
    return np.add.reduceat(steps, starts)


def _by_vector(trips: np.ndarray, width: int) -> np.ndarray:
    """A vector is in a loop for as long as one of its lanes is."""
    padded = np.zeros(-(-len(trips) // width) * width)
    padded[: len(trips)] = trips
    return padded.reshape(-1, width).max(axis=1)


def vector_trips(trips: np.ndarray, width: int) -> int:
    """How often vectors have been through a loop."""
    return int(_by_vector(trips, width).sum())


def _blocks_of_own(kernel: Any, pool: Pool) -> int:
    """Of a kernel that Dr.Jit did not compile."""
    if kernel.type == "MkPerm":
        return 1 if kernel.counts_of_sort else blocks_of_sort(kernel.size, pool)
    if kernel.type in ("BlockReduce", "BlockPrefixReduce", "Compress"):
        return blocks_of_sum(kernel.size, pool)
    return 1  # Memset, Memcpy


def busiest_share(costs: np.ndarray, cores: int) -> float:
    """Share of the work that the busiest core has; each takes the next block when it is free."""
    loads = [0.0] * min(cores, len(costs))
    for cost in costs:
        heapq.heapreplace(loads, loads[0] + cost)
    return max(loads) / float(costs.sum())
