"""The processes that work together, and what they tell each other.

Arrays go as they are, by MPI's functions for buffers. Nothing blocks for good: whoever waits asks
again and again, so that Ctrl-C is seen and the other processes of a crowded machine can work.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

SPINS, LONGEST_NAP = 50, 1e-3
"""Questions without a pause, for answers that are nearly there; seconds between much later ones."""


@dataclass
class Times:
    """Seconds that a process has spent together with others."""

    waiting: float = 0.0  # for those that were not ready
    exchanging: float = 0.0  # copying, packing and sending
    sent_bytes: int = 0


@dataclass
class Ranks:
    """The processes of a run, numbered from 0; this one is ``rank``."""

    comm: MPI.Comm
    on_machine: int = 1  # of them, that run where this one does
    times: Times = field(default_factory=Times)

    @staticmethod
    def world() -> Ranks:
        """All processes that ``mpiexec`` has started."""
        here = MPI.COMM_WORLD.Split_type(MPI.COMM_TYPE_SHARED)
        return Ranks(MPI.COMM_WORLD.Dup(), here.Get_size())

    @property
    def rank(self) -> int:
        """The number of this process."""
        return self.comm.Get_rank()

    @property
    def size(self) -> int:
        """How many there are."""
        return self.comm.Get_size()

    @property
    def is_first(self) -> bool:
        """Whether this is the one that reads, writes and speaks for all."""
        return self.rank == 0

    @property
    def own_cores(self) -> int:
        """Cores for this process, where those of a machine are shared by all that run on it."""
        has_affinity = hasattr(os, "sched_getaffinity")  # Linux
        cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
        return max(1, cores // self.on_machine)

    @contextmanager
    def exchanging(self):
        """Count the time of a block."""
        waited, start = self.times.waiting, time.perf_counter()
        yield
        waited = self.times.waiting - waited
        self.times.exchanging += time.perf_counter() - start - waited

    # ------------------------------------------------------------------------------------------
    # All tell all
    # ------------------------------------------------------------------------------------------

    def told(self, numbers: np.ndarray) -> np.ndarray:
        """What each rank has to say: (K, ...), of arrays of one shape."""
        numbers = np.asarray(numbers, order="C")
        found = np.empty((self.size, *numbers.shape), numbers.dtype)
        start = time.perf_counter()
        wait(self.comm.Iallgather(numbers, found))
        self.times.waiting += time.perf_counter() - start
        return found

    def rows_of_all(self, rows: np.ndarray) -> np.ndarray:
        """All ranks' rows, in the order of the ranks: arrays that differ in their first size."""
        rows = np.ascontiguousarray(rows)
        counts = self.told(np.array(len(rows)))
        found = np.empty((int(counts.sum()), *rows.shape[1:]), rows.dtype)
        with self.exchanging():
            sizes = counts * _row_bytes(rows)
            wait(self.comm.Iallgatherv(_bytes(rows), _parts(found, sizes)))
        self.times.sent_bytes += rows.nbytes * (self.size - 1)
        return found

    def rows_on(self, rank: int, rows: np.ndarray) -> np.ndarray | None:
        """The same on one rank alone; None on the others."""
        rows = np.ascontiguousarray(rows)
        counts = self.told(np.array(len(rows)))
        found = into = None
        if rank == self.rank:
            found = np.empty((int(counts.sum()), *rows.shape[1:]), rows.dtype)
            into = _parts(found, counts * _row_bytes(rows))
        else:
            self.times.sent_bytes += rows.nbytes
        with self.exchanging():
            wait(self.comm.Igatherv(_bytes(rows), into, root=rank))
        return found

    def rows_from_first(self, rows: np.ndarray | None, like: np.ndarray) -> np.ndarray:
        """Of rows on the first rank, those that fit into ``like`` on each, in order."""
        counts = self.told(np.array(len(like)))
        found = np.empty_like(like)
        part = None
        if self.is_first:
            part = _parts(np.ascontiguousarray(rows), counts * _row_bytes(like))
        wait(self.comm.Iscatterv(part, _bytes(found)))
        return found

    def from_rank(self, rank: int, array: np.ndarray) -> np.ndarray:
        """The array of one rank, on all: others give one of its shape and type to put it into."""
        array = np.ascontiguousarray(array)
        with self.exchanging():
            wait(self.comm.Ibcast(_bytes(array), root=rank))
        if rank == self.rank:
            self.times.sent_bytes += array.nbytes * (self.size - 1)
        return array

    def text_of(self, rank: int, text: str) -> str:
        """What one rank says, on all."""
        size = self.told(np.array(len(text.encode())))[rank]
        words = np.zeros(int(size), np.uint8)
        if rank == self.rank:
            words[:] = np.frombuffer(text.encode(), np.uint8)
        return self.from_rank(rank, words).tobytes().decode()

    def exchanged(self, parts: Sequence[np.ndarray], dtype: Any, width: int) -> list[np.ndarray]:
        """Rows for each rank (M_k, width), for those from each rank."""
        counts = self.told(np.array([len(part) for part in parts]))[:, self.rank]
        own = np.concatenate([part.reshape(-1, width).astype(dtype, copy=False) for part in parts])
        found = np.empty((int(counts.sum()), width), dtype)
        row = width * own.itemsize
        sizes = [len(part) * row for part in parts]
        wait(self.comm.Ialltoallv(_parts(own, sizes), _parts(found, counts * row)))
        return np.split(found, np.cumsum(counts)[:-1])

    # ------------------------------------------------------------------------------------------
    # One tells another
    # ------------------------------------------------------------------------------------------

    def send(self, array: np.ndarray, to: int, tag: int) -> MPI.Request:
        """Begin to; the array has to stay as it is until the request is done."""
        self.times.sent_bytes += array.nbytes
        return self.comm.Isend(_bytes(array), dest=to, tag=tag)

    def receive(self, into: np.ndarray, of: int, tag: int) -> MPI.Request:
        """Begin to."""
        return self.comm.Irecv(_bytes(into), source=of, tag=tag)


def wait(*requests: MPI.Request) -> None:
    """Until all of them are done."""
    if not requests:
        return
    asked = 0
    while not MPI.Request.Testall(list(requests)):
        asked += 1
        if asked > SPINS:
            time.sleep(min(LONGEST_NAP, 1e-6 * asked))


def _bytes(array: np.ndarray) -> np.ndarray:
    """The memory of an array, for MPI; more than 2^31 of them take MPI 4."""
    return array.reshape(-1).view(np.uint8)


def _parts(array: np.ndarray, sizes: Sequence[int]) -> list[Any]:
    """The same, divided among processes; sizes: bytes."""
    return [_bytes(array), [int(size) for size in sizes], None, MPI.BYTE]


def _row_bytes(rows: np.ndarray) -> int:
    return rows.itemsize * int(np.prod(rows.shape[1:], dtype=np.int64))
