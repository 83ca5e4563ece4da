"""What the machine can do at best, measured through Dr.Jit.

Both numbers bound every kernel from below: how many vector instructions it can execute, and how
many bytes it can move, in a second.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import drjit as dr
import drjit.llvm.ad as llvm

CHAINS = 10
"""Independent multiply-adds in flight: more than the latency of one times those started a cycle."""

STEPS = 2000

LANES = 1 << 15

MEBIBYTE = 1 << 20


@dataclass(frozen=True)
class MachineLimits:
    """Measured by :func:`measure_limits`."""

    multiply_adds: float  # float32 multiply-adds a second, all threads
    bytes_moved: float  # read and written to memory, a second, all threads
    width: int  # float32 numbers in a vector
    threads: int

    @property
    def vector_instructions(self) -> float:
        """Vector instructions a second: as many as multiply-adds of whole vectors."""
        return self.multiply_adds / self.width


def measure_limits(repeats: int = 5) -> MachineLimits:
    """The best of some runs."""
    return MachineLimits(
        multiply_adds=max(_multiply_adds() for _ in range(repeats)),
        bytes_moved=max(_bytes_moved() for _ in range(repeats)),
        width=vector_width(),
        threads=dr.thread_count(),
    )


def vector_width() -> int:
    """Numbers of 32 bits in a vector, as the code that Dr.Jit generates says."""
    x = dr.arange(llvm.Float, 64)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(x * dr.opaque(llvm.Float, 2))
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    return int(re.search(r"<(\d+) x float>", kernels[0]["ir"].getvalue())[1])


def last_kernel_seconds() -> float:
    """Execution time of the longest kernel since the history was last read."""
    dr.sync_thread()
    return max(kernel["execution_time"] for kernel in dr.kernel_history()) * 1e-3


def _multiply_adds() -> float:
    """Chains that live in registers; the factors keep the values bounded and not denormal."""
    start = dr.linspace(llvm.Float, 0.1, 0.9, LANES)
    factor, addend = dr.opaque(llvm.Float, 0.999), dr.opaque(llvm.Float, 1e-3)
    values = [start * (1 + k / CHAINS) for k in range(CHAINS)]
    dr.eval(values)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        _, values = dr.while_loop(
            state=(dr.zeros(llvm.UInt32, LANES), values),
            cond=lambda step, values: step < STEPS,
            body=lambda step, values: (
                step + 4,
                [_four_times(value, factor, addend) for value in values],
            ),
            labels=("step", "values"),
        )
        dr.eval(values)
        return LANES * STEPS * CHAINS / last_kernel_seconds()


def _four_times(value: llvm.Float, factor: llvm.Float, addend: llvm.Float) -> llvm.Float:
    """The loop's own two instructions are then spread over 4 x CHAINS."""
    for _ in range(4):
        value = dr.fma(value, factor, addend)
    return value


def _bytes_moved() -> float:
    """c = a + s b over arrays that no cache holds (the STREAM triad; McCalpin 1995)."""
    count = 256 * MEBIBYTE // 4
    a, b = dr.full(llvm.Float, 1, count), dr.full(llvm.Float, 2, count)
    scale = dr.opaque(llvm.Float, 3)
    dr.make_opaque(a, b)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        c = dr.fma(b, scale, a)
        dr.eval(c)
        return 3 * 4 * count / last_kernel_seconds()
