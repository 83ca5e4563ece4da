"""Available memory, and checks before large allocations, for which Linux kills processes."""

from __future__ import annotations

import ctypes
import errno
import re
import sys
from pathlib import Path

import psutil

from drgs.core.errors import UserError, one_line

FREE_MEMORY = (  # remedy in messages
    "close other programs, raise the limit (ulimit -v, or the container's), or use smaller input"
)

_EXHAUSTED = re.compile(
    "out of memory|std::bad_alloc|cannot allocate memory|failed to map segment", re.IGNORECASE
)

MAX_LANES = 2**32 - 1  # entries of an array of Dr.Jit, which counts them in 32 bits

IMAGE_BYTES = 250  # a pixel: tile entries, planes, the film's block, the image, its host copy
SAMPLE_BYTES = 80  # a further sample of a pixel: planes
CHANNEL_BYTES = 24  # a channel besides colour: plane, block, image, copy

UNCHECKED_FILE_BYTES = 1 << 24  # read without a check: a fit reads hundreds of photographs
UNCHECKED_BYTES = 1 << 28  # rendered without a check, which may take a millisecond

_PROC, _CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")

_UNLIMITED_BYTES = 1 << 60


def available_memory() -> int:
    """Return the bytes that the machine, control groups and the process's limit leave."""
    return max(0, min(psutil.virtual_memory().available, _control_group_limit(), _process_limit()))


def release_unused_memory() -> None:
    """Free Dr.Jit's cache of memory, and glibc's."""
    _flush_cache_of_drjit()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # other C libraries have none
        if trim is not None:
            trim(0)


def resident_memory() -> int:
    """Return the resident memory of this process, bytes."""
    return psutil.Process().memory_info().rss


def format_bytes(count: float) -> str:
    """Format a number of bytes: ``3.2 GB``."""
    larger = (("GB", 1e9), ("MB", 1e6))
    unit, size = next((pair for pair in larger if count >= 0.9995 * pair[1]), ("kB", 1e3))
    return f"{float(f'{count / size:.3g}'):,g} {unit}"


def require_memory(path: str | Path, needed: int, what: str) -> None:
    """Raise :class:`UserError` unless ``needed`` bytes are available for a file's content."""
    available = _check_available(needed, UNCHECKED_FILE_BYTES)
    if available is not None:
        raise UserError(
            f"{path}: {what} takes about {format_bytes(needed)} of memory, of which "
            f"{format_bytes(available)} are available; {FREE_MEMORY}"
        )


def _check_available(needed: int, unchecked: int) -> int | None:
    """Return the available bytes if they are fewer than ``needed``, else None.

    unchecked: bytes that are granted without a check. Dr.Jit's cache counts as available.
    """
    if needed <= unchecked or needed <= available_memory():
        return None
    _flush_cache_of_drjit()
    available = available_memory()
    return available if needed > available else None


def out_of_memory_reason(error: BaseException) -> str | None:
    """Return the message for an error that means exhausted memory, else None.

    Python and NumPy raise MemoryError, Dr.Jit RuntimeError, the loader ImportError or OSError.
    """
    text = one_line(error)
    is_of_system = isinstance(error, OSError) and error.errno == errno.ENOMEM
    if isinstance(error, MemoryError) or is_of_system or _EXHAUSTED.search(text):
        reason = f" ({text})" if text else ""
        available = format_bytes(available_memory())
        return f"out of memory{reason}: {available} are available; {FREE_MEMORY}"
    return None


def too_large_reason(width: int, height: int, channels: int = 3, samples: int = 1) -> str | None:
    """Return why an image of ``width`` x ``height`` px cannot be rendered here; None: it can.

    channels: of the film, without alpha; samples: per pixel, times those of an open shutter.
    """
    asked = f"{width} x {height} px" + (f" with {samples:,} samples each" if samples > 1 else "")
    pixels, widest = width * height, max(channels + 1, samples)
    if pixels * widest > MAX_LANES:
        return (
            f"{asked} are too many for Dr.Jit, whose arrays end at 2^32 entries; at most "
            f"{MAX_LANES // widest:,} pixels fit"
        )
    of_pixel = IMAGE_BYTES + SAMPLE_BYTES * (samples - 1) + CHANNEL_BYTES * (channels - 3)
    available = _check_available(pixels * of_pixel, UNCHECKED_BYTES)
    if available is None:
        return None
    return (
        f"{asked} need about {format_bytes(pixels * of_pixel)} of memory, of which "
        f"{format_bytes(available)} are available; at most {available // of_pixel:,} pixels fit"
    )


def _flush_cache_of_drjit() -> None:
    if drjit := sys.modules.get("drjit"):
        drjit.flush_malloc_cache()


def _process_limit() -> int:
    process = psutil.Process()
    if not hasattr(psutil, "RLIMIT_AS"):  # not Linux
        return _UNLIMITED_BYTES
    limit, _ = process.rlimit(psutil.RLIMIT_AS)
    return _UNLIMITED_BYTES if limit == psutil.RLIM_INFINITY else limit - process.memory_info().vms


def _control_group_limit() -> int:
    """Return the bytes that the process's control group (version 2) and its parents leave."""
    rooms = [_UNLIMITED_BYTES]
    for line in _lines(_PROC / "self" / "cgroup"):
        _, controllers, path = line.split(":", 2)
        if not controllers:  # of version 2
            group = _CGROUPS / path.strip("/")
            # In a container, its own group is mounted as the root.
            rooms += [_group_limit(folder) for folder in (group, *group.parents, _CGROUPS)]
    return min(rooms)


def _group_limit(group: Path) -> int:
    """Return the bytes that a control group has left, with its file cache."""
    most, used = (next(iter(_lines(group / f"memory.{name}")), "") for name in ("max", "current"))
    if not most.isdigit() or not used.isdigit():
        return _UNLIMITED_BYTES
    statistics = dict(line.split()[:2] for line in _lines(group / "memory.stat"))
    return int(most) - int(used) + int(statistics.get("inactive_file", 0))


def _lines(path: Path) -> list[str]:
    """Return the lines of a file of the kernel; none if it is missing."""
    try:
        return path.read_text().splitlines()
    except OSError:
        return []
