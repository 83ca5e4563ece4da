"""Whether the calling thread takes denormal numbers for zero.

Dr.Jit's workers do. A command does the same (:func:`denormals_flushed`), so that its result does
not depend on which thread computes; what needs them takes them back (:func:`denormals_kept`). Only
where the C library is glibc on x86-64; elsewhere nothing happens.
"""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_FLUSH = 0x8040
"""Bits FTZ and DAZ of x86's register MXCSR (Intel, Software Developer's Manual 1, 10.2.3)."""


@contextmanager
def denormals_flushed() -> Iterator[None]:
    """Take denormal numbers for zero on this thread within the block, as Dr.Jit's workers do.

    Dr.Jit leaves the calling thread's mode as it is, and runs what is small there, or everything
    if there is no worker: bits of Adam's moments, and soon all of a fit, would depend on the
    number of threads.
    """
    with _mode(lambda bits: bits | _FLUSH):
        yield


@contextmanager
def denormals_kept() -> Iterator[None]:
    """Compute with denormal numbers on this thread within the block.

    For code that relies on the smallest number above zero not being zero.
    """
    with _mode(lambda bits: bits & ~_FLUSH):
        yield


@contextmanager
def _mode(change: Callable[[int], int]) -> Iterator[None]:
    """Within the block, MXCSR is what ``change`` makes of it."""
    if (platform.libc_ver()[0], platform.machine()) != ("glibc", "x86_64"):
        yield
        return
    libm = ctypes.CDLL("libm.so.6")
    before = (ctypes.c_uint32 * 8)()  # fenv_t, the last word of which is MXCSR
    libm.fegetenv(before)
    changed = type(before)(*before)
    changed[7] = change(changed[7])
    libm.fesetenv(changed)
    try:
        yield
    finally:
        libm.fesetenv(before)
