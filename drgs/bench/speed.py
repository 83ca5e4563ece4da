"""``python -m drgs.bench speed``: drgs, other renderers, and the machine's limits, side by side.

Everything is measured in one process, on the same Gaussians and camera, with the same loss, in
turns: each round times every implementation once, so that whatever else the machine does meets all
of them. Medians are reported, and ratios of medians.

For the compositing kernels the command also says how much of their work shows (pairs of a pixel
and a Gaussian whose alpha reaches 1/255 before the pixel is finished), and what part of the
machine's vector instructions that work would need (:data:`INSTRUCTIONS`) and does execute
(:class:`drgs.bench.costs.LoopCost`, from the machine code of their loops). Of each stage it counts
the kernels that are launched and the bytes that they ask for (:mod:`drgs.bench.traffic`).

``--without-avx512`` measures what a processor of AVX2 would execute.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.bench import peers
from drgs.bench.costs import LoopCost, StageCost, loop_cost, stage_costs
from drgs.bench.limits import MachineLimits, measure_limits
from drgs.bench.machine_code import MachineCodeError
from drgs.bench.output import add_out, machine, markdown_table, write_csv
from drgs.bench.pairs import Work, count_work
from drgs.bench.profile import STAGES, StageClock, counted_launches, stage_clock
from drgs.bench.scenes import Scene, bench_camera, bench_gaussians, frame_of, trainer_of
from drgs.cli.commands import CommandParser
from drgs.core.files import atomic_path
from drgs.core.private import leave_out_avx512
from drgs.gaussians.parameters import Gaussians
from drgs.io.figures import new_figure, write_figure
from drgs.results.files import GAUSSIANS
from drgs.splatting.grid import PIXELS
from drgs.training.trainer import Trainer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE = 400
"""px: width and height of all pictures."""

INSTRUCTIONS = {"compositing": 22.0, "adjoint": 42.0}
"""Vector instructions that one (pixel, Gaussian) pair needs, three colours, counted by hand in
``rasterize.composite`` and ``composite_adjoint``; loads of a record, loop control and what is
shared by the 16 pixels of a micro-tile are not counted as useful.

Compositing, 22: u (1) and exponent (1); exp2: round, difference, 6 multiply-adds, shift, add (10);
clamp and cut: 2 comparisons, 2 selections (4); next T and weight: multiply-add, comparison,
multiply (3); colour: 3 multiply-adds.

Adjoint, 42: the same up to the cut (16); reached: comparison, selection (2); 1 - alpha and
division (2, though one division costs several); weight (1); c.g and d_color: 6 multiply-adds;
gain, what lies behind, derivative and selection (4); and the sums over the pixels: u v (1), sums
of v and u v by row, u v by column (3), the column's and the rows' shares of the moments and of the
slots (7)."""

WARM_UP = 3
"""Iterations before an iteration is looked at."""

ROUNDS, QUICK_ROUNDS = 15, 5
SLOW_ROUNDS = 3
"""Rounds of implementations that need more than ``SLOW`` seconds."""

SLOW = 0.5
VERY_SLOW = 15.0
"""s: measured once."""


@dataclass(frozen=True)
class Timing:
    """Medians, seconds, of one implementation on one scene."""

    scene: str
    renderer: str
    forward: float
    forward_backward: float
    rounds: int


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s --trained out/lego/point_cloud.ply")
    add_out(parser, run, "speed.csv", "speed.json", "speed.png")
    parser.add_argument("--quick", action="store_true", help="10,000 Gaussians only; two minutes")
    parser.add_argument(
        "--without-avx512",
        action="store_true",
        help="compile for this processor as if it ended at AVX2; only where Dr.Jit uses AVX-512",
    )
    parser.add_argument(
        "--trained",
        type=Path,
        default=Path("out/lego") / GAUSSIANS,
        metavar="PLY",
        help="a fitted scene to measure as well (default: out/lego/point_cloud.ply, if it exists)",
    )


def run(args: argparse.Namespace) -> None:
    """Measure all scenes; write tables, CSV, JSON and a plot."""
    mi.set_variant("llvm_ad_rgb")
    if args.without_avx512:
        leave_out_avx512()
    limits = measure_limits()
    print(
        f"{_machine(args)}\n{limits.multiply_adds / 1e9:.1f} G multiply-adds/s in vectors of "
        f"{limits.width}, {limits.bytes_moved / 1e9:.1f} GB/s"
    )
    print(peers.why_no_gsplat())
    timings, reports = [], []
    for scene in scenes_of(args):
        found = measure_scene(scene, QUICK_ROUNDS if args.quick else ROUNDS)
        report = profile_training(scene, limits, QUICK_ROUNDS if args.quick else ROUNDS)
        timings += found
        reports.append(report)
        print(f"\n{scene.name}: {_work_line(report.work)}")
        print(f"\n{_comparison(found)}\n\n{_stages(report, limits)}\n")
        print(_loops(report, limits), flush=True)
    _write(args, limits, timings, reports)


def _machine(args: argparse.Namespace) -> str:
    return f"{machine()}, without AVX-512" if args.without_avx512 else machine()


def scenes_of(args: argparse.Namespace) -> list[Scene]:
    """The bench scene at one or two sizes, and a trained one if there is one."""
    camera = bench_camera(SIZE)
    counts = (10_000,) if args.quick else (10_000, 100_000)
    scenes = [Scene(f"bench scene, {n:,}", bench_gaussians(n), camera) for n in counts]
    if args.trained.exists():
        gaussians = Gaussians.load(args.trained)
        scenes.append(Scene(f"trained, {gaussians.num_gaussians:,}", gaussians, camera))
    else:
        print(f"{args.trained}: not there; fit a scene, or name one with --trained, to measure it")
    return scenes


# ----------------------------------------------------------------------------------------------
# Side by side
# ----------------------------------------------------------------------------------------------


def measure_scene(scene: Scene, rounds: int) -> list[Timing]:
    """Time every implementation in turns."""
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(scene.camera.height, scene.camera.width, 3))
    problem = peers.Problem(scene.gaussians, scene.camera, weights)
    count = scene.gaussians.num_gaussians
    renderers = [
        peers.drgs_renderer(problem),
        peers.volprim_renderer(problem, "ellipsoids", 7e-5 * count),
        peers.volprim_renderer(problem, "ellipsoidsmesh", 1.5e-4 * count),
        peers.reference_renderer(problem),
    ]
    times: dict[str, list[tuple[float, float]]] = {r.name: [] for r in renderers}
    for renderer in renderers:  # compiles the kernels
        if renderer.seconds < VERY_SLOW:
            renderer.forward_backward()
            renderer.forward()
    for turn in range(rounds):
        for renderer in renderers:
            if turn < _rounds(renderer, rounds):
                times[renderer.name].append(
                    (_seconds(renderer.forward), _seconds(renderer.forward_backward))
                )
    return [
        Timing(
            scene.name,
            name,
            statistics.median(forward for forward, _ in pairs),
            statistics.median(both for _, both in pairs),
            len(pairs),
        )
        for name, pairs in times.items()
    ]


def _rounds(renderer: peers.Renderer, rounds: int) -> int:
    if renderer.seconds > VERY_SLOW:
        return 1
    return SLOW_ROUNDS if renderer.seconds > SLOW else rounds


def _seconds(function: Callable[[], None]) -> float:
    started = time.perf_counter()
    function()
    return time.perf_counter() - started


# ----------------------------------------------------------------------------------------------
# A training iteration, stage by stage
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class IterationReport:
    """Where the time of a training iteration goes."""

    scene: str
    work: Work
    stage_ms: dict[str, float]  # kernels, medians; see profile.STAGES
    wall_ms: float  # a whole iteration that nobody looks into, median
    vector_share: dict[str, float]  # of the machine's vector instructions, by useful pairs
    costs: dict[str, StageCost]
    loops: dict[str, LoopCost]  # of the stages of INSTRUCTIONS; empty if there is no machine code
    no_loops: str  # why

    @property
    def kernel_ms(self) -> float:
        """All kernels."""
        return sum(self.stage_ms.values())


def profile_training(scene: Scene, limits: MachineLimits, rounds: int) -> IterationReport:
    """Train on one view of the scene itself, with all SH degrees and no change of population."""
    walls, clocks = _time_iterations(warm_trainer(scene), rounds)
    stage_ms = {
        stage: statistics.median(clock.kernel_ms.get(stage, 0.0) for clock in clocks)
        for stage in STAGES
    }
    work = count_work(frame_of(scene))
    share = {
        stage: work.useful * count / limits.width / limits.vector_instructions / stage_ms[stage]
        * 1e3
        for stage, count in INSTRUCTIONS.items()
    }  # fmt: skip
    launches = counted_launches(lambda: partial(clocked_step, warm_trainer(scene)))
    loops, reason = {}, ""
    try:
        loops = {stage: loop_cost(launches[stage], limits.width) for stage in INSTRUCTIONS}
    except MachineCodeError as error:
        reason = str(error)
    wall = 1e3 * statistics.median(walls)
    return IterationReport(
        scene.name, work, stage_ms, wall, share, stage_costs(launches), loops, reason
    )


def _time_iterations(trainer: Trainer, rounds: int) -> tuple[list[float], list[StageClock]]:
    """Seconds of an iteration that nobody looks into, and the stages of another, each round."""
    walls, clocks = [], []
    for _ in range(rounds):
        walls.append(_seconds(lambda: _steps(trainer, 4)) / 4)
        clocks.append(clocked_step(trainer))
    return walls, clocks


def warm_trainer(scene: Scene) -> Trainer:
    """A trainer whose kernels have been compiled."""
    trainer = trainer_of(scene)
    _steps(trainer, WARM_UP)
    return trainer


def _steps(trainer: Trainer, count: int) -> None:
    for _ in range(count):
        trainer.step()
    dr.sync_thread()


def clocked_step(trainer: Trainer) -> StageClock:
    """A training iteration, stage by stage."""
    with stage_clock() as clock:
        report = trainer.step()
        dr.eval([(view.loss, view.squared_error) for view in report.seen])
        clock.end("optimizer and statistics")
    return clock


# ----------------------------------------------------------------------------------------------
# Output
# ----------------------------------------------------------------------------------------------


def _work_line(work: Work) -> str:
    return (
        f"{work.entries:,} (Gaussian, tile) entries, {work.evaluated:,} (pixel, Gaussian) pairs "
        f"evaluated, {work.useful:,} of them useful"
    )


def _comparison(timings: list[Timing]) -> str:
    ours = timings[0]
    header = ["400x400", "forward", "forward + backward", "ratio", "ratio, both", "rounds"]
    rows = [
        [
            timing.renderer,
            _milliseconds(timing.forward),
            _milliseconds(timing.forward_backward),
            f"{timing.forward / ours.forward:.1f}",
            f"{timing.forward_backward / ours.forward_backward:.1f}",
            str(timing.rounds),
        ]
        for timing in timings
    ]
    return markdown_table(header, rows)


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.1f} ms" if seconds < 1 else f"{seconds:.2f} s"


def _stages(report: IterationReport, limits: MachineLimits) -> str:
    rows = []
    for stage in STAGES:
        cost, spent = report.costs[stage], report.stage_ms[stage]
        rows.append(
            [
                stage,
                f"{spent:.1f} ms",
                str(cost.kernels),
                f"{cost.bytes / 1e6:.1f} MB",
                _percent(cost.bytes / limits.bytes_moved * 1e3 / spent),
                _percent(report.vector_share[stage]) if stage in report.vector_share else "",
            ]
        )
    rest = report.wall_ms - report.kernel_ms
    rows.append(["rest of wall time", f"{rest:.1f} ms", "", "", "", ""])
    kernels = str(sum(cost.kernels for cost in report.costs.values()))
    moved = sum(cost.bytes for cost in report.costs.values())
    share = _percent(moved / limits.bytes_moved * 1e3 / report.wall_ms)
    total = [f"{report.wall_ms:.1f} ms", kernels, f"{moved / 1e6:.1f} MB", share, ""]
    rows.append(["a training iteration", *total])
    header = ["stage", "time", "kernels", "bytes asked for", "of the memory limit"]
    return markdown_table([*header, "useful part of the vector limit"], rows)


def _loops(report: IterationReport, limits: MachineLimits) -> str:
    """What the machine code of the loops over pairs does for a pair."""
    if not report.loops:
        return f"no machine code: {report.no_loops}"
    header = ["a (pixel, Gaussian) pair", *report.loops]
    useful = report.work.useful / report.work.evaluated
    rows = [
        ["pairs evaluated", *(f"{report.work.evaluated:,}" for _ in report.loops)],
        ["of them useful", *(_percent(useful) for _ in report.loops)],
        ["lanes that vectors keep busy", *(_percent(v) for v in _busy_lanes(report, limits))],
    ]
    for title, name in (
        ("vector instructions", "vectors"),
        ("loads of data", "loads"),
        ("stores of data", "stores"),
        ("loads of the stack", "stack_loads"),
        ("stores to the stack", "stack_stores"),
        ("loads of constants", "constants"),
    ):
        rows.append([title, *(f"{getattr(loop, name):.1f}" for loop in report.loops.values())])
    rows.insert(4, ["needed", *(f"{INSTRUCTIONS[stage]:.0f}" for stage in report.loops)])
    executed = [
        loop.instructions() / limits.vector_instructions * 1e3 / report.stage_ms[stage]
        for stage, loop in report.loops.items()
    ]
    rows.append(["executed, of the vector limit", *map(_percent, executed)])
    return markdown_table(header, rows)


def _busy_lanes(report: IterationReport, limits: MachineLimits) -> list[float]:
    evaluated = report.work.evaluated / PIXELS
    return [evaluated / (loop.steps * limits.width) for loop in report.loops.values()]


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _write(
    args: argparse.Namespace,
    limits: MachineLimits,
    timings: list[Timing],
    reports: list[IterationReport],
) -> None:
    out = args.out
    write_csv(
        out / "speed.csv",
        list(Timing.__dataclass_fields__),
        [list(vars(timing).values()) for timing in timings],
    )
    values = {
        "machine": _machine(args),
        "limits": vars(limits),
        "timings": [vars(timing) for timing in timings],
        "iterations": [asdict(report) for report in reports],
    }
    with atomic_path(out / "speed.json") as temporary:
        temporary.write_text(json.dumps(values, indent=2) + "\n")
    write_figure(out / "speed.png", plot(timings, reports))
    print(f"\nwritten: {', '.join(str(out / f'speed.{kind}') for kind in ('csv', 'json', 'png'))}")


def plot(timings: list[Timing], reports: list[IterationReport]) -> Figure:
    """Times of all implementations, and the stages of an iteration."""
    figure = new_figure(11, 4.5)
    left, right = figure.subplots(1, 2)
    scenes = list(dict.fromkeys(timing.scene for timing in timings))
    names = list(dict.fromkeys(timing.renderer for timing in timings))
    labels = [scene.replace(", ", "\n") for scene in scenes]
    for k, name in enumerate(names):
        values = [t.forward_backward for t in timings if t.renderer == name]
        places = np.arange(len(values)) + 0.8 * k / len(names)
        bars = left.barh(places, values, 0.8 / len(names), label=name)
        left.bar_label(bars, [_milliseconds(value) for value in values], padding=3, fontsize=7)
    fastest, slowest = (f(t.forward_backward for t in timings) for f in (min, max))
    left.set_yticks(np.arange(len(scenes)) + 0.3, labels)
    left.set(xscale="log", xlim=(fastest / 3, slowest * 5), xlabel="s", title="forward + backward")
    left.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)
    bottoms = np.zeros(len(reports))
    for stage in STAGES:
        values = np.array([report.stage_ms[stage] for report in reports])
        right.bar(labels, values, bottom=bottoms, label=stage)
        bottoms += values
    rest = np.array([max(report.wall_ms - report.kernel_ms, 0) for report in reports])
    right.bar(labels, rest, bottom=bottoms, label="rest of wall time", color="0.8")
    right.set(ylabel="ms", title="a training iteration")
    right.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1))
    return figure
