"""Time and count the work of a computation."""

from __future__ import annotations

import time
from collections.abc import Callable

import drjit as dr


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
