"""Bytes that kernels move, and how often their loops run.

What a kernel reads and writes stands in its intermediate representation: vectors of arrays in
order, gathers, scatters, packets of them. :func:`bytes_of` multiplies each with the number of lanes
that come by: the size of the kernel outside of loops, and the trips of its lanes inside, which
:class:`LoopTrips` counts in a run of its own.

These are the bytes that instructions ask for. What a cache still holds is counted again, so that
they can be more than memory can deliver in the time; a packet whose lane is switched off is counted
as if it were read; and of a line of which a gather needs four bytes, four are counted.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np

NUMBER = 4
"""Bytes of a number in Dr.Jit's own kernels; its sorts and sums of drgs have no other."""

OWN_KERNELS = {
    "MkPerm": NUMBER,
    "BlockReduce": NUMBER,
    "BlockPrefixReduce": 2 * NUMBER,
    "Compress": 2 * NUMBER,
    "Memset": 1,
    "Memcpy": 2,
}
"""Bytes that Dr.Jit's own kernels move for each of what their entry in the history gives as size,
by type: a pass of a sort has three entries, reads its keys twice and writes once; sizes of the last
two are bytes."""

VECTOR = r"<\d+ x (?P<type>[a-z]+\d*)>"
ACCESSES = (
    re.compile(rf"= load {VECTOR}, ptr"),
    re.compile(rf"^\s+store {VECTOR} "),
    re.compile(r"@llvm\.masked\.(?:gather|scatter|load|store)\.v\d+(?P<type>[if]\d+)"),
    re.compile(r"call .*@(?:gather|scatter)_(?P<packet>\d+)x(?P<type>[if]\d+)\("),
)
"""What moves bytes, of each lane of a vector."""

LOOP = re.compile(r"^l_(?P<number>\d+)_(?P<part>cond|done):")


@dataclass(frozen=True)
class Accesses:
    """Bytes that one lane of a kernel reads and writes."""

    once: int
    in_loops: tuple[int, ...]  # a trip; loops in their order in the text


def accesses_of(ir: str) -> Accesses:
    """Read the intermediate representation of a kernel of Dr.Jit's LLVM backend."""
    once, loops, inside = 0, [], []
    for line in ir.partition("\n}")[0].splitlines():  # what follows are helpers that it calls
        border = LOOP.match(line)
        if border and border["part"] == "cond":
            inside.append(len(loops))
            loops.append(0)
        elif border:
            inside.pop()
        moved = _bytes_of_line(line)
        if inside:
            loops[inside[-1]] += moved
        else:
            once += moved
    return Accesses(once, tuple(loops))


def _bytes_of_line(line: str) -> int:
    for pattern in ACCESSES:
        found = pattern.search(line)
        if found:
            packet = found.groupdict().get("packet") or 1
            return int(packet) * _type_size(found["type"])
    return 0


def _type_size(name: str) -> int:
    bits = {"float": 32, "double": 64, "half": 16}.get(name) or int(name[1:])
    return max(bits // 8, 1)


def bytes_of(kernel: Any, trips: Sequence[np.ndarray] = ()) -> int:
    """Bytes that a launch moves: see the head of this module.

    kernel: a ``Launch`` of ``profile``; trips: of the lanes of each of its loops.
    """
    if kernel.ir is None:
        return OWN_KERNELS.get(kernel.type, 0) * kernel.size
    accesses = accesses_of(kernel.ir)
    in_loops = zip(accesses.in_loops, trips, strict=True)
    return accesses.once * kernel.size + sum(each * int(trip.sum()) for each, trip in in_loops)


# ----------------------------------------------------------------------------------------------
# Trips of loops
# ----------------------------------------------------------------------------------------------


@dataclass
class LoopTrips:
    """How often each lane has been through each loop, in the order in which they were met."""

    found: list[np.ndarray] = field(default_factory=list)

    def take(self) -> list[np.ndarray]:
        """Those since the last call."""
        taken, self.found = self.found, []
        return taken


@contextmanager
def counted_trips() -> Iterator[LoopTrips]:
    """A block in which ``dr.while_loop`` counts; its kernels are others than without.

    Each loop has one more state variable and is evaluated at once.
    """
    trips = LoopTrips()
    original = dr.while_loop

    def while_loop(state: tuple, cond: Callable, body: Callable, **keywords: Any) -> tuple:
        if "labels" in keywords:
            keywords["labels"] = (*keywords["labels"], "trips")
        *result, count = original(
            state=(*state, dr.zeros(llvm.UInt32)),
            cond=lambda *values: cond(*values[:-1]),
            body=lambda *values: (*body(*values[:-1]), values[-1] + 1),
            **keywords,
        )
        dr.eval(result, count)
        trips.found.append(np.array(count))
        return tuple(result)

    with patch.object(dr, "while_loop", while_loop):
        yield trips
