"""Functions that Dr.Jit and Mitsuba do not document: the only module that calls them.

Each does what its docstring says in Dr.Jit 1.5.0 and Mitsuba 3.9.1. A newer version that removes or
changes one of them is met here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr


def bucket_order(buckets: Any, block_size: int, num_buckets: int) -> Any:
    """UInt32 (N,): a permutation that orders the lanes of each block stably by their bucket.

    buckets: UInt32 (N,), evaluated, each below ``num_buckets``; block_size: lanes that are ordered
    together.

    Relies on ``dr.detail.block_mkperm`` being stable.
    """
    return dr.detail.block_mkperm(buckets, block_size, num_buckets)


def same_variables(tree: Any, other: Any) -> bool:
    """Whether two PyTrees consist of the same Dr.Jit variables, in the same order.

    Both are held, so that equal indices mean the same variable. Evaluates nothing.

    Relies on ``dr.detail.collect_indices``.
    """
    return dr.detail.collect_indices(tree) == dr.detail.collect_indices(other)


def llvm_version() -> tuple[int, ...]:
    """Version of the libLLVM that Dr.Jit has loaded, such as (19, 1, 7); (-1, ...) without one.

    Relies on ``dr.detail.llvm_version`` waiting for Dr.Jit's start-up.
    """
    return tuple(dr.detail.llvm_version())


def clear_memory_peak() -> None:
    """Begin to measure :func:`memory_peak` anew."""
    dr.detail.malloc_clear_statistics()


def memory_peak() -> int:
    """Bytes: most memory that arrays of the LLVM backend had at a time since the last clearing.

    Relies on ``dr.detail.malloc_watermark``.
    """
    return dr.detail.malloc_watermark(dr.JitBackend.LLVM)


def new_rate_cache() -> Any:
    """What ``drjit.opt.Adam._step`` keeps scaled learning rates in during a step."""
    from drjit.opt import _LRCache

    return _LRCache()


def call_on_variant_change(callback: Callable[[str | None, str | None], None]) -> None:
    """Have Mitsuba call ``callback(old, new)`` after each change of its variant.

    Relies on ``mi.detail.add_variant_callback``, which Mitsuba's own Python plugins use.
    """
    import mitsuba as mi

    mi.detail.add_variant_callback(callback)
