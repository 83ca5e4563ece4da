"""Measure what the kernels of a training iteration move and execute.

Bytes: what a kernel reads and writes stands in its intermediate representation, as vectors of
arrays in order, gathers, scatters, and packets of them. Each is multiplied by the number of lanes:
the size of the kernel outside of loops, and inside the trips of its lanes, which a second run with
counting loops counts. These are the bytes that instructions ask for. Hits in a cache count too, so
that the sum can exceed what memory could deliver in the time; a packet whose lane is switched off
counts as read.

Instructions: from the machine code of the loops over (pixel, Gaussian) pairs; see
``machine_code.py``. Both are compared with the machine's limits, which Dr.Jit measures.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest.mock import patch

import drgs  # noqa: F401  (registers the integrator)
import drjit as dr
import drjit.llvm.ad as llvm
import mitsuba as mi
import numpy as np
from drgs.bench.output import machine, markdown_table, seconds
from drgs.bench.scenes import bench_camera, bench_gaussians
from drgs.core.private import disable_avx512
from drgs.splatting.grid import PIXELS
from machine_code import MachineCodeError, assembly, count_operations, innermost_loop
from stages import (
    COPIES,
    STAGES,
    Scene,
    StageClock,
    Work,
    clocked_step,
    count_work,
    frame_of,
    steps,
    warm_trainer,
)

ROUNDS = 15

MIN_INSTRUCTIONS = {"compositing": 22.0, "adjoint": 42.0}
"""Vector instructions that one (pixel, Gaussian) pair needs with three colours, counted by hand in
``rasterize.composite`` and ``composite_adjoint``. Loads of a record, loop control and what the 16
pixels of a micro-tile share do not count as useful.

Compositing, 22: u (1) and exponent (1); exp2: round, difference, 6 multiply-adds, shift, add (10);
clamp and cut: 2 comparisons, 2 selections (4); next T and weight: multiply-add, comparison,
multiply (3); colour: 3 multiply-adds.

Adjoint, 42: the same up to the cut (16); reached: comparison, selection (2); 1 - alpha and
division (2, though one division costs several); weight (1); c.g and d_color: 6 multiply-adds;
gain, what lies behind, derivative and selection (4); and the sums over the pixels: u v (1), sums
of v and u v by row, u v by column (3), the column's and the rows' shares of the moments and of the
slots (7)."""


# ----------------------------------------------------------------------------------------------
# Limits of the machine
# ----------------------------------------------------------------------------------------------

NUM_CHAINS = 10
"""Independent multiply-adds in flight: more than the latency of one times those started a cycle."""

LANES, TRIPS = 1 << 15, 2000


@dataclass(frozen=True)
class MachineLimits:
    """Upper bounds of all threads together, each second."""

    multiply_adds: float  # float32
    bytes_moved: float  # read from and written to memory
    width: int  # float32 numbers in a vector

    @property
    def vector_instructions(self) -> float:
        """The number of vector instructions: as many as multiply-adds of whole vectors."""
        return self.multiply_adds / self.width


def measure_limits(repeats: int = 5) -> MachineLimits:
    """Return the best of some runs."""
    return MachineLimits(
        multiply_adds=max(_multiply_adds() for _ in range(repeats)),
        bytes_moved=max(_bytes_moved() for _ in range(repeats)),
        width=vector_width(),
    )


def vector_width() -> int:
    """Read the number of 32-bit numbers in a vector from the code that Dr.Jit generates."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(dr.arange(llvm.Float, 64) * dr.opaque(llvm.Float, 2))
        (kernel,) = dr.kernel_history([dr.KernelType.JIT])
    return int(re.search(r"<(\d+) x float>", kernel["ir"].getvalue())[1])


def _longest_kernel_seconds() -> float:
    dr.sync_thread()
    return max(kernel["execution_time"] for kernel in dr.kernel_history()) * 1e-3


def _multiply_adds() -> float:
    """Time chains that live in registers; the factors keep the values bounded, not denormal."""
    start = dr.linspace(llvm.Float, 0.1, 0.9, LANES)
    factor, addend = dr.opaque(llvm.Float, 0.999), dr.opaque(llvm.Float, 1e-3)
    values = [start * (1 + k / NUM_CHAINS) for k in range(NUM_CHAINS)]
    dr.eval(values)

    def four_times(value: llvm.Float) -> llvm.Float:
        for _ in range(4):  # the loop's own two instructions are spread over 4 x CHAINS
            value = dr.fma(value, factor, addend)
        return value

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        _, values = dr.while_loop(
            state=(dr.zeros(llvm.UInt32, LANES), values),
            cond=lambda trip, values: trip < TRIPS,
            body=lambda trip, values: (trip + 4, [four_times(value) for value in values]),
            labels=("trip", "values"),
        )
        dr.eval(values)
        return LANES * TRIPS * NUM_CHAINS / _longest_kernel_seconds()


def _bytes_moved() -> float:
    """Time c = a + s b over arrays that no cache holds (the STREAM triad; McCalpin 1995)."""
    count = 1 << 26
    a, b = dr.full(llvm.Float, 1, count), dr.full(llvm.Float, 2, count)
    scale = dr.opaque(llvm.Float, 3)
    dr.make_opaque(a, b)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(dr.fma(b, scale, a))
        return 3 * 4 * count / _longest_kernel_seconds()


# ----------------------------------------------------------------------------------------------
# Bytes
# ----------------------------------------------------------------------------------------------

OWN_KERNEL_BYTES = {
    "MkPerm": 4,
    "BlockReduce": 4,
    "BlockPrefixReduce": 8,
    "Compress": 8,
    "Memset": 1,
    "Memcpy": 2,
}
"""Bytes that Dr.Jit's own kernels move for each unit of the size in their entry, by type: a pass of
a sort has three entries, reads its keys twice and writes once; sizes of the last two are bytes."""

VECTOR = r"<\d+ x (?P<type>[a-z]+\d*)>"
ACCESSES = (
    re.compile(rf"= load {VECTOR}, ptr"),
    re.compile(rf"^\s+store {VECTOR} "),
    re.compile(r"@llvm\.masked\.(?:gather|scatter|load|store)\.v\d+(?P<type>[if]\d+)"),
    re.compile(r"call .*@(?:gather|scatter)_(?P<packet>\d+)x(?P<type>[if]\d+)\("),
)
"""Lines that move bytes, of each lane of a vector."""

VARIABLE = re.compile(r"(%\w+) = getelementptr .*ptr %arr_\d+,")
"""A line that names the place of a lane's variable, which is in a register or on the stack."""

POINTER = re.compile(r"ptr (%\w+)")

LOOP = re.compile(r"^l_(?P<number>\d+)_(?P<part>cond|done):")


@dataclass(frozen=True)
class Accesses:
    """Bytes that one lane of a kernel reads and writes."""

    once: int
    in_loops: tuple[int, ...]  # a trip; loops in their order in the text


def accesses_of(ir: str) -> Accesses:
    """Read the intermediate representation of a kernel of Dr.Jit's LLVM backend."""
    once, loops, inside = 0, [], []
    kernel = ir.partition("\n}")[0]  # helpers that it calls follow
    variables = set(VARIABLE.findall(kernel))
    for line in kernel.splitlines():
        border = LOOP.match(line)
        if border and border["part"] == "cond":
            inside.append(len(loops))
            loops.append(0)
        elif border:
            inside.pop()
        moved = 0 if variables.intersection(POINTER.findall(line)) else _bytes_of_line(line)
        if inside:
            loops[inside[-1]] += moved
        else:
            once += moved
    return Accesses(once, tuple(loops))


def _bytes_of_line(line: str) -> int:
    for pattern in ACCESSES:
        if found := pattern.search(line):
            name, packet = found["type"], found.groupdict().get("packet") or 1
            bits = {"float": 32, "double": 64, "half": 16}.get(name) or int(name[1:])
            return int(packet) * max(bits // 8, 1)
    return 0


@dataclass(frozen=True)
class Launch:
    """An entry of the kernel history, with the trips of its loops."""

    type: str  # JIT; MkPerm, BlockReduce, ...: kernels that Dr.Jit brings along
    size: int  # lanes, or what the type counts
    milliseconds: float
    ir: str | None  # intermediate representation of a kernel that was compiled
    trips: list[np.ndarray]  # (size,) UInt32 for each loop
    adds_counts: bool = False  # the middle of the three entries of a pass of a sort

    @property
    def bytes(self) -> int:
        """The bytes that the launch asks for."""
        if self.ir is None:
            return OWN_KERNEL_BYTES.get(self.type, 0) * self.size
        accesses = accesses_of(self.ir)
        in_loops = zip(accesses.in_loops, self.trips, strict=True)
        return accesses.once * self.size + sum(each * int(t.sum()) for each, t in in_loops)


@contextmanager
def counted_trips() -> Iterator[list[np.ndarray]]:
    """Have ``dr.while_loop`` count the trips of each lane; yield those of all loops, in order.

    Each loop has one more state variable and is evaluated at once: its kernels are others.
    """
    trips: list[np.ndarray] = []
    original = dr.while_loop

    def while_loop(
        state: tuple, cond: Callable, body: Callable, labels: tuple = (), **keywords: Any
    ) -> tuple:
        if labels:
            keywords["labels"] = (*labels, "trips")
        *result, count = original(
            state=(*state, dr.zeros(llvm.UInt32)),
            cond=lambda *values: cond(*values[:-1]),
            body=lambda *values: (*body(*values[:-1]), values[-1] + 1),
            **keywords,
        )
        dr.eval(result, count)
        trips.append(np.array(count))
        return tuple(result)

    with patch.object(dr, "while_loop", while_loop):
        yield trips


def counted_launches(prepare: Callable[[], Callable[[], StageClock]]) -> dict[str, list[Launch]]:
    """Return the kernels of each stage of a computation, with the trips of their loops.

    prepare: makes a computation that runs under a clock and returns it, the same each time.
    """
    history, passes = prepare()().history, 0
    computation = prepare()
    with counted_trips() as counted:
        computation()
    trips = iter(counted)
    launches: dict[str, list[Launch]] = {}
    for stage, entry in history:
        name, ir = entry["type"].name, entry["ir"].getvalue() if "ir" in entry else None
        own = [next(trips) for _ in accesses_of(ir).in_loops] if ir else []
        assert all(len(t) == entry["size"] for t in own), "loops are not in the kernels' order"
        passes += name == "MkPerm"
        adds = name == "MkPerm" and passes % 3 == 2
        launch = Launch(name, entry["size"], entry["execution_time"], ir, own, adds)
        launches.setdefault(stage, []).append(launch)
    assert next(trips, None) is None, "a loop that no kernel has"
    return launches


def vector_trips(trips: np.ndarray, width: int) -> np.ndarray:
    """Return the trips of each vector: it stays in a loop for as long as one of its lanes does."""
    padded = np.zeros(-(-len(trips) // width) * width)
    padded[: len(trips)] = trips
    return padded.reshape(-1, width).max(axis=1)


# ----------------------------------------------------------------------------------------------
# Instructions of the loops over pairs
# ----------------------------------------------------------------------------------------------

OPERATIONS = {
    "vectors": "vector instructions",
    "loads": "loads of data",
    "stores": "stores of data",
    "stack_loads": "loads of the stack",
    "stack_stores": "stores to the stack",
    "constants": "loads of constants",
}


@dataclass(frozen=True)
class LoopCost:
    """Instructions of the loop over (pixel, Gaussian) pairs, from its machine code.

    The instructions in the loop's body are divided by the pixels of a lane: a vector instruction
    counts once per pair that it serves, as in ``MIN_INSTRUCTIONS``. Rarely taken paths count too.
    The stack holds pixel state that does not fit into registers.
    """

    a_pair: dict[str, float]  # by the names of OPERATIONS
    steps: int  # trips of vectors through the loop

    @property
    def instructions(self) -> float:
        """The number of vector instructions that were executed."""
        return self.a_pair["vectors"] * PIXELS * self.steps


def loop_cost(launches: list[Launch], width: int) -> LoopCost:
    """Analyse the loop in the kernel of a stage that takes longest, in all launches of it."""
    longest = max((k for k in launches if k.trips), key=lambda k: k.milliseconds)
    text = assembly(longest.ir)
    found = count_operations(innermost_loop(text), text)
    same = (k for k in launches if k.ir == longest.ir)
    return LoopCost(
        {name: getattr(found, name) / PIXELS for name in OPERATIONS},
        int(sum(vector_trips(trips, width).sum() for k in same for trips in k.trips)),
    )


# ----------------------------------------------------------------------------------------------
# Tables
# ----------------------------------------------------------------------------------------------


def stage_table(
    launches: dict[str, list[Launch]], stage_ms: dict[str, float], wall_ms: float, limit: float
) -> str:
    """Format kernels and bytes of each stage; limit: bytes a second."""

    def row(name: str, milliseconds: float, kernels: Sequence[Launch]) -> list[str]:
        moved = sum(kernel.bytes for kernel in kernels)
        count = sum(kernel.type not in COPIES for kernel in kernels)
        share = f"{1e3 * moved / limit / milliseconds:.0%}"
        return [name, f"{milliseconds:.1f} ms", str(count), f"{moved / 1e6:.1f} MB", share]

    rows = [row(stage, stage_ms[stage], launches[stage]) for stage in STAGES]
    every = [kernel for kernels in launches.values() for kernel in kernels]
    rows.append(["in no kernel", f"{wall_ms - sum(stage_ms.values()):.1f} ms", "", "", ""])
    rows.append(row("a training iteration", wall_ms, every))
    header = ["stage", "time", "kernels", "bytes asked for", "of the memory limit"]
    return markdown_table(header, rows)


def loop_table(
    loops: dict[str, LoopCost], work: Work, stage_ms: dict[str, float], limits: MachineLimits
) -> str:
    """Format what the loops over pairs execute for a pair."""
    limit = limits.vector_instructions / 1e3  # a millisecond
    busy = [work.evaluated / PIXELS / (c.steps * limits.width) for c in loops.values()]
    rows = [
        ["pairs evaluated", *(f"{work.evaluated:,}" for _ in loops)],
        ["of them useful", *(f"{work.useful / work.evaluated:.0%}" for _ in loops)],
        ["lanes that vectors keep busy", *(f"{share:.0%}" for share in busy)],
    ]
    for name, title in OPERATIONS.items():
        rows.append([title, *(f"{cost.a_pair[name]:.1f}" for cost in loops.values())])
    rows.append(["vector instructions needed", *(f"{MIN_INSTRUCTIONS[s]:.0f}" for s in loops)])
    executed = [c.instructions / limit / stage_ms[s] for s, c in loops.items()]
    rows.append(["executed, of the vector limit", *(f"{share:.0%}" for share in executed)])
    needed = [work.useful * MIN_INSTRUCTIONS[s] / limits.width / limit / stage_ms[s] for s in loops]
    rows.append(["needed by useful pairs, of it", *(f"{share:.0%}" for share in needed)])
    return markdown_table(["a (pixel, Gaussian) pair", *loops], rows)


def main() -> None:
    """Measure the bench scene."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--gaussians", type=int, default=100_000, metavar="N")
    parser.add_argument("--size", type=int, default=400, metavar="PX")
    parser.add_argument("--rounds", type=int, default=ROUNDS, metavar="N")
    parser.add_argument("--without-avx512", action="store_true")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    if args.without_avx512:
        disable_avx512()
    limits = measure_limits()
    print(
        f"{machine()}; {limits.multiply_adds / 1e9:.1f} G multiply-adds/s in vectors of "
        f"{limits.width}, {limits.bytes_moved / 1e9:.1f} GB/s\n"
    )
    scene = Scene("bench", bench_gaussians(args.gaussians), bench_camera(args.size))
    trainer = warm_trainer(scene)
    wall_ms = 1e3 * np.median([seconds(lambda: steps(trainer, 1)) for _ in range(args.rounds)])
    clocks = [clocked_step(trainer).kernel_ms for _ in range(args.rounds)]
    stage_ms = {stage: np.median([clock[stage] for clock in clocks]) for stage in STAGES}
    launches = counted_launches(lambda: partial(clocked_step, warm_trainer(scene)))
    print(stage_table(launches, stage_ms, wall_ms, limits.bytes_moved))
    try:
        loops = {stage: loop_cost(launches[stage], limits.width) for stage in MIN_INSTRUCTIONS}
        print(f"\n{loop_table(loops, count_work(frame_of(scene)), stage_ms, limits)}")
    except MachineCodeError as error:
        print(f"\nno machine code: {error}")


if __name__ == "__main__":
    main()
