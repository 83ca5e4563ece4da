"""Environment of a process: processor, denormal numbers, packages of extras, variants."""

from __future__ import annotations

import ctypes
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
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


def require_module(module: str, extra: str, feature: str) -> ModuleType:
    """Import and return a module of an extra of ``pyproject.toml``.

    feature: what needs it, for the message: ``--view``. Raises :class:`UserError` if it is missing.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        missing = (error.name or module).partition(".")[0]
        raise UserError(
            f"{feature}: needs {missing}, which is not installed; pip install 'drgs[{extra}]'"
        ) from None


def processor() -> str:
    """Return the processor's name: on Linux its model, elsewhere Python's name for it."""
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            names = [line.partition(":")[2].strip() for line in file if "model name" in line]
        if names:
            return names[0]
    return platform.processor() or platform.machine()


def describe_installation() -> str:
    """Return Mitsuba, Dr.Jit, LLVM with its file, Python and the machine, in lines."""
    import drjit
    import mitsuba

    from drgs.core import llvm, private

    version = llvm.loaded_version()
    drjit_version = drjit.__version__  # pyright: ignore[reportAttributeAccessIssue]
    name = "none" if version is None else llvm.format_version(version)
    width = private.llvm_vector_width() if version else 0
    return "\n".join(
        (
            f"Mitsuba {mitsuba.__version__}, Dr.Jit {drjit_version}",
            f"LLVM {name} ({llvm.library_file() or 'no file'}), vectors of {width} floats, "
            f"{drjit.thread_count()} threads",
            f"Python {platform.python_version()}, {platform.platform()}, {processor()}",
        )
    )


_FLUSH_BITS = 0x8040  # FTZ and DAZ of x86's MXCSR (Intel, Software Developer's Manual 1, 10.2.3)


def denormals_flushed() -> AbstractContextManager[None]:
    """Flush denormal numbers to zero on this thread, as on Dr.Jit's workers; glibc on x86-64 only.

    Else bits of a fit would depend on the number of threads: Dr.Jit runs small kernels here.
    """
    return _mode(lambda bits: bits | _FLUSH_BITS)


def denormals_kept() -> AbstractContextManager[None]:
    """Keep denormal numbers on this thread within the block."""
    return _mode(lambda bits: bits & ~_FLUSH_BITS)


@contextmanager
def _mode(change: Callable[[int], int]) -> Iterator[None]:
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
