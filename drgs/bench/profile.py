"""Which stage of a computation its kernels belong to.

Dr.Jit's kernel history names no stages. :class:`StageClock` waits for the device at the borders of
the stages and reads the history there, so that whatever ran since the last border belongs to the
stage that ends. Stages end where functions of the product are called, which are wrapped for as long
as the clock runs; the computation itself is untouched. Waiting costs overlap: the sum of the stages
is a little more than the computation takes when nobody looks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import drjit as dr

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


@dataclass
class StageClock:
    """Milliseconds of kernels by stage."""

    kernel_ms: dict[str, float] = field(default_factory=dict)
    compiled: int = 0  # kernels that were not in a cache

    def end(self, stage: str) -> None:
        """All kernels since the last call belong to ``stage``."""
        dr.sync_thread()
        kernels = dr.kernel_history()
        self.compiled += sum(
            not kernel["cache_hit"] for kernel in kernels if kernel["type"] == dr.KernelType.JIT
        )
        spent = sum(kernel["execution_time"] for kernel in kernels)
        self.kernel_ms[stage] = self.kernel_ms.get(stage, 0.0) + spent


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
        (rendering, "bin_splats", ends(None, "binning")),
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
