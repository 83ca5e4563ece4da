"""Which stage of a computation its kernels belong to.

Dr.Jit's kernel history names no stages. :class:`StageClock` waits for the device at the borders of
the stages and reads the history there, so that whatever ran since the last border belongs to the
stage that ends. Stages end where functions of the product are called, which are wrapped for as long
as the clock runs; the computation itself is untouched. Waiting costs overlap: the sum of the stages
is a little more than the computation takes when nobody looks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import drjit as dr
import numpy as np

from drgs.bench.traffic import accesses_of, counted_trips
from drgs.splatting import rasterize, rendering, tiles

STAGES = (
    "projection and SH",
    "binning",
    "compositing",
    "image and loss",
    "adjoint",
    "reduction",
    "projection and SH, adjoint",
    "optimizer and statistics",
)


@dataclass(frozen=True)
class Launch:
    """An entry of the kernel history."""

    type: str  # JIT; MkPerm, BlockReduce, ...: kernels that Dr.Jit brings along
    size: int  # lanes, or what the type counts
    milliseconds: float
    ir: str | None  # intermediate representation of a kernel that was compiled
    counts_of_sort: bool = False  # whether it is the one of a sort that adds up counts


@dataclass
class StageClock:
    """Milliseconds of kernels by stage, and the kernels."""

    kernel_ms: dict[str, float] = field(default_factory=dict)
    launches: list[tuple[str, Launch]] = field(default_factory=list)  # stages, as they went
    compiled: int = 0  # kernels that were not in a cache
    host_ms: float = 0.0  # of the stages, in which no kernel ran
    started: float = field(default_factory=time.perf_counter)

    def end(self, stage: str) -> None:
        """All kernels since the last call belong to ``stage``."""
        dr.sync_thread()
        passed = 1e3 * (time.perf_counter() - self.started)
        kernels = dr.kernel_history()
        self.compiled += sum(
            not kernel["cache_hit"] for kernel in kernels if kernel["type"] == dr.KernelType.JIT
        )
        found = _launches(kernels)
        self.launches.extend((stage, launch) for launch in found)
        spent = sum(launch.milliseconds for launch in found)
        self.kernel_ms[stage] = self.kernel_ms.get(stage, 0.0) + spent
        self.host_ms += passed - spent
        self.started = time.perf_counter()  # reading the history is not the stage's


def _launches(history: list[dict]) -> list[Launch]:
    found, passes = [], 0
    for entry in history:
        name = entry["type"].name
        passes += name == "MkPerm"
        found.append(
            Launch(
                type=name,
                size=entry["size"],
                milliseconds=entry["execution_time"],
                ir=entry["ir"].getvalue() if "ir" in entry else None,
                counts_of_sort=name == "MkPerm" and passes % 3 == 2,  # count, add up, move
            )
        )
    return found


@contextmanager
def stage_clock() -> Iterator[StageClock]:
    """A clock that ends stages wherever the renderer's own stages do.

    What comes before the first stage, and after the last, is the caller's to ``end``.
    """
    clock = StageClock()

    def ends(before: str | None, after: str | None) -> Callable:
        def wrap(function: Callable) -> Callable:
            def wrapped(*arguments: object, **keywords: object) -> object:
                if before:
                    clock.end(before)
                result = function(*arguments, **keywords)
                dr.eval(result)
                if after:
                    clock.end(after)
                return result

            return wrapped

        return wrap

    borders = [
        (tiles, "_store_rows", ends(None, "projection and SH")),
        (rendering, "bin_footprints", ends(None, "binning")),
        (rendering, "composite", ends(None, "compositing")),
        (rendering, "composite_adjoint", ends("image and loss", None)),
        (rasterize, "sum_entries", ends("adjoint", "reduction")),
        (rasterize, "splat_gradients", ends(None, "reduction")),
        (rendering, "_as_tensors", ends(None, "projection and SH, adjoint")),
    ]
    originals = [(module, name, getattr(module, name)) for module, name, _ in borders]
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.sync_thread()
        dr.kernel_history_clear()
        try:
            for module, name, wrap in borders:
                setattr(module, name, wrap(getattr(module, name)))
            yield clock
        finally:
            for module, name, original in originals:
                setattr(module, name, original)


@dataclass(frozen=True)
class CountedLaunch:
    """A kernel, and how often its lanes went through its loops."""

    launch: Launch
    trips: list[np.ndarray]  # UInt32 (size,) of each loop, in their order in the text


def counted_launches(
    prepare: Callable[[], Callable[[], StageClock]],
) -> dict[str, list[CountedLaunch]]:
    """The kernels of each stage of a computation, with the trips of their loops.

    prepare: makes a computation that runs under a clock and returns it; the same each time. One
    runs as it is, and one with loops that count, whose kernels are therefore others.
    """
    launches = prepare()().launches
    computation = prepare()
    with counted_trips() as counted:
        computation()
    trips = iter(counted.take())
    found: dict[str, list[CountedLaunch]] = {}
    for stage, launch in launches:
        loops = len(accesses_of(launch.ir).in_loops) if launch.ir else 0
        found.setdefault(stage, []).append(
            CountedLaunch(launch, [_of_size(next(trips), launch) for _ in range(loops)])
        )
    assert next(trips, None) is None, "a loop that no kernel has"
    return found


def _of_size(trips: np.ndarray, launch: Launch) -> np.ndarray:
    assert len(trips) == launch.size, "loops are not in the order of the kernels"
    return trips
