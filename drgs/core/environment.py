"""Environment of a process: processor, denormal numbers, packages of extras, variants."""

from __future__ import annotations

import ctypes
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

from drgs.core.errors import PluginError, UserError

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Variants that can render and differentiate Gaussians; the first is the default."""


def check_variant(plugin: str, variant: str | None) -> None:
    """Raise PluginError that begins with the plugin's name for any other variant."""
    if variant not in VARIANTS:
        raise PluginError(
            f"{plugin}: the variant '{variant}' is not supported, "
            f"use mi.set_variant('{VARIANTS[0]}')"
        )


def require_module(module: str, extra: str, asker: str) -> ModuleType:
    """Import and return a module of an extra of ``pyproject.toml``.

    asker: what needs it, as the user has written it: ``--view``.

    Raises :class:`UserError` with the line that installs it, where it is not there.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        missing = (error.name or module).partition(".")[0]
        raise UserError(
            f"{asker}: needs {missing}, which is not installed; pip install 'drgs[{extra}]'"
        ) from None


def processor() -> str:
    """Return the processor's name: on Linux its model, elsewhere what Python knows of it."""
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            names = [line.partition(":")[2].strip() for line in file if "model name" in line]
        if names:
            return names[0]
    return platform.processor() or platform.machine()


_FLUSH = 0x8040
"""Bits FTZ and DAZ of x86's register MXCSR (Intel, Software Developer's Manual 1, 10.2.3)."""


@contextmanager
def denormals_flushed() -> Iterator[None]:
    """Take denormal numbers for zero on this thread within the block, as Dr.Jit's workers do.

    Only where the C library is glibc on x86-64. Dr.Jit leaves the calling thread's mode as it is,
    and runs what is small there, or everything if there is no worker: bits of Adam's moments, and
    soon all of a fit, would depend on the number of threads.
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
