"""Predict a training step on more cores and on machines of a network.

Measured on one core: the parts of an iteration, on the host and in kernels, and into how many
blocks Dr.Jit cuts each kernel. Nobody has tried the predictions. ``prediction.md`` has the result.

More cores. A block is what one thread works on. The bound on the speed-up is Amdahl's (1967), with
each kernel k in place of *the* parallel part:

    S(P) = (h + sum_k t_k) / (h + sum_k t_k m_k(P))

h: time of an iteration on one thread in which no kernel runs (Python, tracing, launching); t_k: of
kernel k on one thread; m_k(P): the share of its work that the busiest of P cores has, if each takes
the next block as soon as it is free. Blocks without loops take equally long; in kernels with loops,
each vector of lanes takes as many steps as its longest lane. Memory's bandwidth, caches and clock,
which several cores share, are not modelled, nor that the host works while a kernel runs.

Machines. Each projects its rows for all views, renders its views while the splats of the next ones
arrive, and takes the gradients of its rows back.
"""

from __future__ import annotations

import argparse
import heapq
import math
from dataclasses import dataclass, replace
from functools import partial

import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)
import drjit as dr
import mitsuba as mi
import numpy as np
from drgs.bench.output import machine, markdown_table
from drgs.bench.scenes import (
    BENCH_FIELD_OF_VIEW,
    bench_camera,
    bench_gaussians,
)
from drgs.datasets.types import Dataset, View
from drgs.gaussians.parameters import Gaussians
from drgs.reference.splatting import Camera
from drgs.splatting.rendering import on_film
from drgs.training.trainer import Trainer
from kernels import Launch, counted_launches, vector_trips, vector_width
from stages import (
    STAGES,
    Scene,
    StageClock,
    bench_config,
    clocked_step,
    frame_of,
    steps,
    warm_trainer,
)

ROUNDS = 6

# ----------------------------------------------------------------------------------------------
# More cores
# ----------------------------------------------------------------------------------------------

CORES = (2, 4, 8, 16, 32, 64)

BLOCK_LANES = 16_384
"""Lanes of a block, where there are enough: Dr.Jit's default."""


def blocks_of_lanes(size: int, cores: int, width: int) -> tuple[int, int]:
    """Return the number of blocks of a compiled kernel of ``size`` lanes, and the lanes of each.

    The rules are those of Dr.Jit 1.5 (``src/llvm_ts.cpp`` of drjit-core): with few lanes a block is
    a vector, with more there are two blocks a thread, until they have ``BLOCK_LANES`` lanes.
    """
    vectors = -(-size // width)
    if cores <= 1:
        return 1, vectors * width
    if vectors <= cores:
        return vectors, width
    if size <= 2 * cores * BLOCK_LANES:
        return 2 * cores, -(-vectors // (2 * cores)) * width
    return -(-size // BLOCK_LANES), BLOCK_LANES


def block_costs(kernel: Launch, cores: int, width: int) -> np.ndarray:
    """Return the work of each block of a launch, in any unit."""
    if kernel.ir is not None:
        _, lanes = blocks_of_lanes(kernel.size, cores, width)
        work = np.ones(-(-kernel.size // width))
        work += sum(vector_trips(trips, width) for trips in kernel.trips)
        return np.add.reduceat(work, np.arange(0, len(work), max(lanes // width, 1)))
    count = 1
    if kernel.type == "MkPerm" and not kernel.adds_counts:  # a pass of a sort
        count = -(-kernel.size // max(BLOCK_LANES, -(-kernel.size // (4 * cores))))
    elif kernel.type in ("BlockReduce", "BlockPrefixReduce", "Compress"):
        count = -(-kernel.size // BLOCK_LANES) if kernel.size > 2 * BLOCK_LANES else 1
    return np.ones(count)


def busiest_share(costs: np.ndarray, cores: int) -> float:
    """Return the share of the busiest core; each takes the next block when it is free."""
    loads = [0.0] * min(cores, len(costs))
    for cost in costs:
        heapq.heapreplace(loads, loads[0] + cost)
    return max(loads) / float(costs.sum())


def cores_table(scene: Scene) -> str:
    """Format bounds of the speed-up of an iteration and of each stage."""
    launches = counted_launches(lambda: partial(clocked_step, warm_trainer(scene)))
    clock = fastest_clock(warm_trainer(scene))
    host_ms = sum(clock.wall_ms.values()) - sum(clock.kernel_ms.values())
    width, parts = vector_width(), {}
    for stage in STAGES:
        once = sum(kernel.milliseconds for kernel in launches[stage])
        factor = clock.kernel_ms[stage] / once  # launches were timed once, stages often
        parts[stage] = [(factor * k.milliseconds, k) for k in launches[stage]]
    parts["a training iteration"] = [part for stage in STAGES for part in parts[stage]]
    rows = []
    for name, kernels in parts.items():
        serial = 0.0 if name in STAGES else host_ms
        alone = serial + sum(spent for spent, _ in kernels)
        shares = [
            sum(spent * busiest_share(block_costs(k, c, width), c) for spent, k in kernels)
            for c in CORES
        ]
        rows.append([name, f"{alone:.1f} ms", *(f"{alone / (serial + s):.1f}x" for s in shares)])
    return markdown_table(["at most", "1 core", *(f"{cores} cores" for cores in CORES)], rows)


def fastest_clock(trainer: Trainer) -> StageClock:
    """Time some iterations; return the clock of the fastest: other load makes them slower."""
    clocks = [clocked_step(trainer) for _ in range(ROUNDS)]
    return min(clocks, key=lambda clock: sum(clock.wall_ms.values()))


# ----------------------------------------------------------------------------------------------
# What a scene costs on one core
# ----------------------------------------------------------------------------------------------

PROJECT, RENDER, GO_BACK, OPTIMIZE = STAGES[:1], STAGES[1:6], STAGES[6:7], STAGES[7:]

SPLAT_BYTES, GRADIENT_BYTES = 56, 36
"""Bytes of a splat that travels to another machine, and of its derivatives on their way back."""

BOX_DISTANCE, CAMERA_DISTANCE = 40.0, 4.0


@dataclass(frozen=True)
class Task:
    """A pile of boxes of random splats, of which a view sees one."""

    gaussians: int
    boxes: int
    size_px: int
    views: int = 8


CORE_TASKS = Task(100_000, 1, 400), Task(1_000_000, 1, 1265)
MACHINE_TASKS = Task(100_000, 1, 400), Task(3_000_000, 5, 1600, views=4)
QUICK_TASK = Task(2000, 1, 64, views=2)


@dataclass(frozen=True)
class Cost:
    """Milliseconds of a part of a step, on one core."""

    fixed: float  # on the host
    shared: float  # in kernels: by the rows of each machine, or by its cores


@dataclass(frozen=True)
class Costs:
    """The parts of a step of a scene."""

    project: Cost  # a view
    render: Cost  # a view
    go_back: Cost  # a view
    optimize: Cost  # a step
    render_ms: list[float]  # of each view
    splats: float  # mean number on the film of a view


def measure_costs(task: Task) -> Costs:
    """Time the iterations of all views, stage by stage."""
    gaussians, views = make_boxes(task), make_views(task)
    splats = []
    for view in views:
        pose, focal = view.camera_to_world, view.fx
        middle = task.size_px / 2, task.size_px / 2, task.size_px, task.size_px
        camera = Camera(pose[:3, :3].T, pose[:3, 3], focal, focal, *middle)
        bins = frame_of(Scene(view.name, gaussians, camera)).tiles.bins
        splats.append(int(dr.count(on_film(bins))[0]))
    dataset = Dataset(views, views[:1], "bench", (1.0, 1.0, 1.0), None, "bench")
    trainer = Trainer(bench_config(gaussians), dataset, gaussians)
    trainer.iteration = 10  # all SH degrees are in use
    steps(trainer, len(views) + 3)
    clocks = [clocked_step(trainer) for _ in range(ROUNDS * len(views))]

    def cost(stages: tuple[str, ...]) -> Cost:
        wall = np.median([sum(clock.wall_ms[s] for s in stages) for clock in clocks])
        kernels = np.median([sum(clock.kernel_ms[s] for s in stages) for clock in clocks])
        return Cost(max(wall - kernels, 0.0), kernels)

    render_ms = [sum(clock.kernel_ms[s] for s in RENDER) for clock in clocks]
    parts = map(cost, (PROJECT, RENDER, GO_BACK, OPTIMIZE))
    return Costs(*parts, render_ms, float(np.mean(splats)))


def make_boxes(task: Task) -> Gaussians:
    """Return boxes one above the other; Gaussians are smaller where a box has more of them."""
    found = bench_gaussians(task.gaussians)
    means, rng = found.means.copy(), np.random.default_rng(1)
    means[:, 2] += np.float32(BOX_DISTANCE) * rng.integers(0, task.boxes, task.gaussians)
    factor = np.float32(0.5 * np.log(100_000 * task.boxes / task.gaussians))
    return replace(found, means=means.astype(np.float32), log_scales=found.log_scales + factor)


def make_views(task: Task) -> tuple[View, ...]:
    """Return cameras around the boxes, from above, that see one each; photographs are noise."""
    rng, size, found = np.random.default_rng(2), task.size_px, []
    focal = size / (2 * np.tan(BENCH_FIELD_OF_VIEW / 2))
    for index in range(task.views):
        azimuth, height = 2 * np.pi * index / task.views, 0.4 + 0.1 * (index % 4)
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        away = np.array([np.cos(azimuth), np.sin(azimuth), 0]) * np.sqrt(1 - height**2)
        away[2] = height
        to_world = np.eye(4)
        to_world[:3, :3] = np.stack([right, np.cross(right, away), -away], axis=1)
        to_world[:3, 3] = CAMERA_DISTANCE * away + [0, 0, BOX_DISTANCE * (index % task.boxes)]
        camera = focal, focal, size / 2, size / 2, size, size
        image = rng.random((size, size, 3), np.float32)
        found.append(View(f"{index}", to_world, *camera, image=image))
    return tuple(found)


# ----------------------------------------------------------------------------------------------
# Machines
# ----------------------------------------------------------------------------------------------

CORES_OF_MACHINE = 16

EFFICIENCY = 0.85
"""Share of the cores that work while a kernel runs: what counting blocks gives for 16 of them."""

MACHINES, GBIT_A_SECOND, VIEWS = (1, 4, 16, 64), (1, 10, 25), (4, 16, 64, 256)
"""Predicted: machines, speed of each one's link, views of a step."""

PAYLOAD = 1448 / 1538
"""Share of a link's rate without headers of TCP, IP and Ethernet, and gaps between frames."""

LATENCY_MS = 0.1
"""Time until a message arrives, however small: of TCP, with processes that poll."""


@dataclass(frozen=True)
class Cluster:
    """Machines with a process each."""

    machines: int
    gbit_a_second: float = math.inf  # that each can send, and receive
    threads: int = CORES_OF_MACHINE
    latency_ms: float = LATENCY_MS


def predict_step(costs: Costs, cluster: Cluster, views: int) -> float:
    """Return the milliseconds of a step of ``views`` views; there must be one a machine."""
    machines, own = cluster.machines, math.ceil(views / cluster.machines)
    speed = 1 if cluster.threads == 1 else EFFICIENCY * cluster.threads

    def spent(cost: Cost, share: float) -> float:
        return cost.fixed + cost.shared * share / speed

    rows = views * (spent(costs.project, 1 / machines) + spent(costs.go_back, 1 / machines))
    rows += spent(costs.optimize, 1 / machines)
    rendering = spent(costs.render, 1.0) * _longest_ratio(costs.render_ms, machines, own)
    if machines == 1:
        return rows + own * rendering
    # Three times, all machines tell all others what they have.
    return rows + _pipelined(costs, cluster, own, rendering) + 3 * cluster.latency_ms


def _pipelined(costs: Costs, cluster: Cluster, views: int, rendering: float) -> float:
    """Return the milliseconds until a machine's views are rendered and their derivatives sent.

    Splats of the next views arrive while one is rendered, one view after the other; derivatives
    leave after the splats that go to others.
    """
    sent = costs.splats * (cluster.machines - 1) / cluster.machines
    ms_a_byte = 8e-6 / (PAYLOAD * cluster.gbit_a_second)
    splats, gradients = sent * SPLAT_BYTES * ms_a_byte, sent * GRADIENT_BYTES * ms_a_byte
    rendered, sent = 0.0, views * splats
    for view in range(1, views + 1):
        rendered = max(rendered, view * splats + cluster.latency_ms) + rendering
        sent = max(sent, rendered) + gradients
    return sent + cluster.latency_ms


def _longest_ratio(times: list[float], machines: int, views: int) -> float:
    """Return how much longer than the mean the slowest machine takes for ``views`` views each."""
    drawn = np.random.default_rng(0).choice(times, (200, machines, views))
    return float(drawn.sum(axis=2).max(axis=1).mean() / (views * np.mean(times)))


def costs_table(costs: Costs) -> str:
    """Format what the parts of a step take on one core."""
    parts = {
        "project all rows for a view": costs.project,
        "render a view": costs.render,
        "take the gradients of all rows back, for a view": costs.go_back,
        "step along them": costs.optimize,
    }
    rows = [[name, f"{cost.shared:.1f} ms", f"{cost.fixed:.1f} ms"] for name, cost in parts.items()]
    return markdown_table(["on one core", "in kernels", "on the host"], rows)


def machines_table(costs: Costs) -> str:
    """Format milliseconds a view, and how many times faster than one machine."""
    rows = []
    for machines in MACHINES:
        for rate in GBIT_A_SECOND if machines > 1 else (math.inf,):
            cells = []
            for views in VIEWS:
                if views < machines:
                    cells.append("")
                    continue
                alone = predict_step(costs, Cluster(1), views)
                found = predict_step(costs, Cluster(machines, rate), views)
                cells.append(f"{found / views:.1f} ms, {alone / found:.1f}x")
            rows.append([str(machines), f"{rate} Gbit/s" if machines > 1 else "", *cells])
    return markdown_table(["machines", "links", *(f"{v} views a step" for v in VIEWS)], rows)


def main() -> None:
    """Measure and predict."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a tiny scene alone")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    print(machine())
    for task in (QUICK_TASK,) if args.quick else CORE_TASKS:
        scene = Scene("bench", make_boxes(task), bench_camera(task.size_px))
        print(f"\n{title(task)}: bounds of the speed-up\n\n{cores_table(scene)}", flush=True)
    for task in (QUICK_TASK,) if args.quick else MACHINE_TASKS:
        costs = measure_costs(task)
        print(f"\n{title(task)}, of which a view sees 1 / {task.boxes}\n\n{costs_table(costs)}")
        print(f"\n{costs.splats:,.0f} splats of a view travel\n\n{machines_table(costs)}")


def title(task: Task) -> str:
    """Describe a scene."""
    return f"{task.gaussians:,} Gaussians, {task.size_px}x{task.size_px}"


if __name__ == "__main__":
    main()
