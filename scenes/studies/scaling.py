"""Measure time and memory against Gaussians, pixels and threads.

Each point is a training iteration (render, loss, gradients, optimizer) on one scene, measured in a
fresh process for its peak of memory.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import resource
import statistics
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import drgs  # noqa: F401  (registers the plugin, in the fresh process too)
import drjit as dr
import mitsuba as mi
import numpy as np
from drgs.bench.output import columns_table, machine, markdown_table, seconds
from drgs.bench.scenes import bench_camera, bench_gaussians
from drgs.io.figures import new_figure, write_figure
from drgs.results.history import write_csv
from stages import STAGES, Scene, Work, clocked_step, count_work, frame_of, steps, warm_trainer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STEPS, QUICK_STEPS = 12, 4


@dataclass(frozen=True)
class Point:
    """A problem to measure."""

    sweep: str
    count: int  # Gaussians
    size: int  # px, width and height
    threads: int
    scale: float = 1.0  # of the Gaussians

    @property
    def varied_number(self) -> int:
        """The number that the sweep varies."""
        return {"pixels": self.size**2, "threads": self.threads}.get(self.sweep, self.count)


@dataclass(frozen=True)
class Result:
    """Time and memory of a problem."""

    point: Point
    milliseconds: float  # of an iteration, median
    device_bytes: int  # peak of Dr.Jit's allocations in a training step
    process_bytes: int  # peak resident, interpreter and libraries included
    work: Work
    stage_ms: dict[str, float] = field(default_factory=dict)  # kernels, medians

    @property
    def device_mib(self) -> float:
        """Peak of Dr.Jit's memory, MiB."""
        return self.device_bytes / 2**20

    @property
    def process_mib(self) -> float:
        """Peak of resident memory, MiB."""
        return self.process_bytes / 2**20

    @property
    def bytes_per_gaussian(self) -> float:
        """Peak of Dr.Jit's memory divided by the number of Gaussians."""
        return self.device_bytes / self.point.count


COLUMNS = [
    ("Gaussians", "{.point.count:,}"),
    ("film", "{0.point.size}x{0.point.size}"),
    ("threads", "{.point.threads}"),
    ("iteration", "{.milliseconds:.1f} ms"),
    ("Dr.Jit's peak", "{.device_mib:.0f} MiB"),
    ("a Gaussian", "{.bytes_per_gaussian:,.0f} B"),
    ("process", "{.process_mib:.0f} MiB"),
    ("entries", "{.work.entries:,}"),
    ("useful pairs", "{.work.useful:,}"),
]


def main() -> None:
    """Measure, fit exponents, write table, CSV and plot."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer and smaller problems")
    parser.add_argument("--out", type=Path, default=Path("out/studies/scaling"), metavar="DIR")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    num_steps = QUICK_STEPS if args.quick else STEPS
    print(machine())
    results: dict[str, list[Result]] = {}
    for point in points(args.quick):
        result = measure_in_new_process(point, num_steps)
        results.setdefault(point.sweep, []).append(result)
        print(
            f"{point.sweep}: {point.count:,} Gaussians, {point.size} px, {point.threads} threads: "
            f"{result.milliseconds:.1f} ms, {result.device_mib:.0f} MiB",
            flush=True,
        )
    for name, found in results.items():
        exponents = ""
        if len(found) > 1:
            time, memory = (exponent(found, what) for what in ("milliseconds", "device_bytes"))
            exponents = f": time ~ x^{time:.2f}, memory ~ x^{memory:.2f}"
        print(f"\n{name}{exponents}\n{columns_table(COLUMNS, found)}")
    print(f"\n{_stage_table(results['threads'])}", flush=True)
    _write(args.out, results)


def _write(out: Path, results: dict[str, list[Result]]) -> None:
    fields = ("milliseconds", "device_bytes", "process_bytes")
    rows = [
        [*vars(r.point).values(), *(getattr(r, f) for f in fields), *vars(r.work).values()]
        for found in results.values()
        for r in found
    ]
    header = [*Point.__dataclass_fields__, *fields, *Work.__dataclass_fields__]
    write_csv(out / "scaling.csv", header, rows)
    write_csv(
        out / "scaling_stages.csv",
        ["threads", "iteration_ms", *STAGES],
        [[r.point.threads, r.milliseconds, *r.stage_ms.values()] for r in results["threads"]],
    )
    write_figure(out / "scaling.png", plot(results))


def points(quick: bool) -> list[Point]:
    """Return the points of all sweeps.

    The first scales film and Gaussians: Gaussians per pixel and pixels per Gaussian are constant.
    """
    threads = os.cpu_count() or 1
    counts = (10_000, 30_000) if quick else (10_000, 30_000, 100_000, 300_000, 1_000_000)
    sizes = (100, 200) if quick else (200, 400, 800, 1600)
    base = 30_000 if quick else 100_000
    scales = {n: math.sqrt(100_000 / n) for n in counts}
    density = 100_000 / 400**2  # Gaussians per pixel of the bench scene
    found = [
        Point("constant entries per Gaussian", n, round(math.sqrt(n / density)), threads, scale)
        for n, scale in scales.items()
    ]
    found += [Point("bench scene as it is", n, 400, threads) for n in counts]
    found += [Point("pixels", base, size, threads) for size in sizes]
    found += [Point("threads", base, 400, count) for count in range(1, threads + 1)]
    return found


def measure_in_new_process(point: Point, num_steps: int) -> Result:
    """Measure a point in a fresh process."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(measure, point, num_steps).result()


def measure(point: Point, num_steps: int) -> Result:
    """Time ``num_steps`` iterations after warm-up."""
    dr.set_thread_count(point.threads)
    mi.set_variant("llvm_ad_rgb")
    gaussians = bench_gaussians(point.count)
    shrunk = gaussians.log_scales + np.float32(math.log(point.scale))
    scene = Scene("bench", replace(gaussians, log_scales=shrunk), bench_camera(point.size))
    work = count_work(frame_of(scene))
    trainer = warm_trainer(scene)
    dr.detail.malloc_clear_statistics()
    times = [seconds(lambda: steps(trainer, 1)) for _ in range(num_steps)]
    device_bytes = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
    clocks = [clocked_step(trainer) for _ in range(num_steps)]
    return Result(
        point=point,
        milliseconds=1e3 * statistics.median(times),
        device_bytes=device_bytes,
        process_bytes=1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        work=work,
        stage_ms={s: statistics.median(clock.kernel_ms[s] for clock in clocks) for s in STAGES},
    )


def exponent(results: list[Result], what: str) -> float:
    """Return e of the least-squares fit value = c x^e in logarithms."""
    x = np.log([result.point.varied_number for result in results])
    y = np.log([getattr(result, what) for result in results])
    return float(np.polyfit(x, y, 1)[0])


def _stage_table(results: list[Result]) -> str:
    """Format stages by threads: milliseconds, and the speedup over one thread."""
    counts = [result.point.threads for result in results]
    header = ["", *("1 thread" if n == 1 else f"{n} threads" for n in counts)]
    rows = [["a training iteration", *_times_of([r.milliseconds for r in results])]]
    rows += [[stage, *_times_of([r.stage_ms[stage] for r in results])] for stage in STAGES]
    rest = [r.milliseconds - sum(r.stage_ms.values()) for r in results]
    rows.append(["rest of wall time", *(f"{value:.1f} ms" for value in rest)])
    return markdown_table(header, rows)


def _times_of(milliseconds: list[float]) -> list[str]:
    first, *others = milliseconds
    return [f"{first:.1f} ms", *(f"{value:.1f} ms, {first / value:.2f}x" for value in others)]


def _short(number: int) -> str:
    for factor, suffix in ((1_000_000, "M"), (1000, "k")):
        if number >= factor:
            return f"{number / factor:.3g}{suffix}"
    return str(number)


def plot(results: dict[str, list[Result]]) -> Figure:
    """Draw time and memory of each sweep, with the fitted exponents."""
    from matplotlib.ticker import LogLocator

    figure = new_figure(11, 5.5)
    panels = figure.subplots(2, len(results))
    for column, (name, found) in enumerate(results.items()):
        x = [result.point.varied_number for result in found]
        for row, (what, unit) in enumerate([("milliseconds", "ms"), ("device_mib", "MiB")]):
            panel = panels[row][column]
            panel.loglog(x, [getattr(result, what) for result in found], "o-")
            if len(found) > 1:
                panel.set_title(f"{name}: x^{exponent(found, what):.2f}", fontsize=8)
            panel.set_xlabel(name if name in ("pixels", "threads") else "Gaussians")
            panel.set_ylabel(unit)
            panel.set_xticks(x, [_short(value) for value in x], fontsize=7)
            panel.tick_params(axis="y", which="both", labelsize=7)
            panel.minorticks_off()
            panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            panel.yaxis.set_major_formatter("{x:g}")
            panel.grid(alpha=0.3)
    return figure


if __name__ == "__main__":
    main()
