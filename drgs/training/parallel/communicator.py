"""The processes that share a fit, and the arrays that they exchange.

Arrays travel by MPI's functions for buffers. No call blocks in C: a process that waits polls, so
that it can handle Ctrl-C, and leaves the cores of a crowded machine to other processes.
"""

# ruff: noqa: N802 (mpi4py's names)

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from drgs.core.errors import UserError
from drgs.training.finite_checks import NonFiniteError

NUM_SPINS, MAX_PAUSE_S = 50, 1e-3
"""Polls without a pause, for messages that have nearly arrived; the longest pause between polls."""

NO_ITERATION = 2**62  # iteration of an error that did not occur

T = TypeVar("T")


class SingleProcess:
    """The used part of ``mpi4py.MPI.Comm``, for a process that is alone: sends are copies."""

    def Ibcast(self, array: np.ndarray, root: int) -> None:
        """Do nothing: there is one process."""

    def Iallgather(self, sent: Any, received: Any, root: int = 0) -> None:
        """Copy the numbers; each an array, or a list that begins with one: see :func:`_parts`."""
        sent, received = (b[0] if isinstance(b, list) else b for b in (sent, received))
        received[:] = sent

    Iallgatherv = Igatherv = Iscatterv = Ialltoallv = Iallgather


@dataclass
class Communicator:
    """The processes of a fit, numbered by ``rank`` from 0; by default this one alone."""

    comm: Any = field(default_factory=SingleProcess)  # mpi4py.MPI.Comm
    rank: int = 0  # the number of this process
    size: int = 1  # the number of processes
    num_on_machine: int = 1  # of the processes, those on this machine

    @classmethod
    def world(cls) -> Communicator:
        """Return all processes that ``mpiexec`` has started."""
        from mpi4py import MPI

        here, comm = MPI.COMM_WORLD.Split_type(MPI.COMM_TYPE_SHARED), MPI.COMM_WORLD.Dup()
        return cls(comm, comm.Get_rank(), comm.Get_size(), here.Get_size())

    @property
    def is_root(self) -> bool:
        """True on rank 0, which reads, writes and prints."""
        return self.rank == 0

    @property
    def num_own_cores(self) -> int:
        """Cores for this process, of those that all processes on its machine share."""
        has_affinity = hasattr(os, "sched_getaffinity")  # Linux
        cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
        return max(1, cores // self.num_on_machine)

    # All ranks make these collective calls, in the same order.

    def all_gather(self, numbers: np.ndarray) -> np.ndarray:
        """Return the numbers of each rank: (size, ...), from arrays of one shape."""
        numbers = np.asarray(numbers, order="C")
        gathered = np.empty((self.size, *numbers.shape), numbers.dtype)
        wait(self.comm.Iallgather(numbers, gathered))
        return gathered

    def all_gather_rows(self, rows: np.ndarray) -> np.ndarray:
        """Return the rows of all ranks in their order; the numbers of rows may differ."""
        rows = np.ascontiguousarray(rows)
        counts = self.all_gather(np.array(len(rows)))
        gathered = np.empty((int(counts.sum()), *rows.shape[1:]), rows.dtype)
        wait(self.comm.Iallgatherv(_bytes(rows), _parts(gathered, counts)))
        return gathered

    def broadcast_numbers(self, numbers: ArrayLike) -> np.ndarray:
        """Return the numbers of rank 0; other ranks give as many, of the same type."""
        return self.all_gather(np.array(numbers))[0]

    def gather_rows(self, rows: np.ndarray, root: int = 0) -> np.ndarray | None:
        """Return the rows of all ranks on rank ``root``, None on the others."""
        rows = np.ascontiguousarray(rows)
        counts = self.all_gather(np.array(len(rows)))
        gathered = into = None
        if root == self.rank:
            gathered = np.empty((int(counts.sum()), *rows.shape[1:]), rows.dtype)
            into = _parts(gathered, counts)
        wait(self.comm.Igatherv(_bytes(rows), into, root=root))
        return gathered

    def scatter_rows(self, rows: np.ndarray | None, like: np.ndarray) -> np.ndarray:
        """Return this rank's part of the rows on rank 0: as many as ``like`` has."""
        counts = self.all_gather(np.array(len(like)))
        own = np.empty_like(like)
        parts = _parts(np.ascontiguousarray(rows), counts) if self.is_root else None
        wait(self.comm.Iscatterv(parts, _bytes(own)))
        return own

    def broadcast(self, array: np.ndarray, root: int = 0) -> np.ndarray:
        """Return the array of rank ``root``; other ranks pass one of its shape and type."""
        array = np.ascontiguousarray(array)
        wait(self.comm.Ibcast(_bytes(array), root=root))
        return array

    def broadcast_text(self, text: str, root: int = 0) -> str:
        """Return the text of rank ``root``."""
        size = self.all_gather(np.array(len(text.encode())))[root]
        words = np.zeros(int(size), np.uint8)
        if root == self.rank:
            words[:] = np.frombuffer(text.encode(), np.uint8)
        return self.broadcast(words, root).tobytes().decode()

    def exchange_rows(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Send rows to each rank, and return those from each rank."""
        sent, num_sent = np.concatenate(parts), [len(part) for part in parts]
        counts = self.all_gather(np.array(num_sent))[:, self.rank]
        received = np.empty((int(counts.sum()), *sent.shape[1:]), sent.dtype)
        wait(self.comm.Ialltoallv(_parts(sent, num_sent), _parts(received, counts)))
        return np.split(received, np.cumsum(counts)[:-1])

    def collective(self, call: Callable[[], T]) -> T:
        """Return ``call()``, which must not communicate; a UserError is raised by all ranks.

        If several ranks raise one, it is that of the earliest iteration, on the lowest rank.
        """
        if self.size == 1:
            return call()
        result: T | None = None
        error: UserError | None = None
        try:
            result = call()
        except UserError as caught:
            error = caught
        iteration = NO_ITERATION if error is None else getattr(error, "iteration", 0)
        errors = self.all_gather(np.array([iteration, isinstance(error, NonFiniteError)]))
        first = int(errors[:, 0].argmin())
        iteration, is_non_finite = errors[first]
        if iteration == NO_ITERATION:
            return cast(T, result)
        text = self.broadcast_text("" if error is None else str(error), first)
        raise NonFiniteError(text, int(iteration)) if is_non_finite else UserError(text)

    def send(self, array: np.ndarray, to: int, tag: int) -> Any:
        """Begin to send an array, which must not change until the returned request is done."""
        return self.comm.Isend(_bytes(array), dest=to, tag=tag)

    def receive(self, into: np.ndarray, source: int, tag: int) -> Any:
        """Begin to receive into an array; returns a request."""
        return self.comm.Irecv(_bytes(into), source=source, tag=tag)


def wait(*requests: Any) -> None:
    """Wait until all ``mpi4py.MPI.Request`` are done; None: a finished one."""
    pending, polls = [request for request in requests if request is not None], 0
    while not all([request.Test() for request in pending]):
        polls += 1
        if polls > NUM_SPINS:
            time.sleep(min(MAX_PAUSE_S, 1e-6 * polls))


def _bytes(array: np.ndarray) -> np.ndarray:
    """Return the memory of an array, for MPI; more than 2^31 bytes take MPI 4."""
    return array.reshape(-1).view(np.uint8)


def _parts(rows: np.ndarray, counts: Iterable[int]) -> list[object]:
    """Return the memory of rows, divided among ranks; counts: rows of each rank."""
    row_bytes = rows.itemsize * int(np.prod(rows.shape[1:], dtype=np.int64))
    return [_bytes(rows), [int(count) * row_bytes for count in counts], None, "B"]
