"""``python -m drgs.bench cluster``: what machines on a network would make of a fit. A prediction.

Measured is what the parts of a step take on one core, on the host and in kernels, and how many
bytes a process sends. From this follows a step of any number of machines, by :func:`predicted`:
every process projects its rows for all views, renders its views, and takes the gradients of its
rows back; in between, splats and their derivatives travel. What follows for as many processes as
this machine can try is compared with what they do, behind links as slow as one likes
(``drgs.bench.network``).
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from drgs.bench.network import obstacle, run_within
from drgs.bench.output import add_out, machine, markdown_table, write_csv
from drgs.bench.parts import Measured, Task
from drgs.bench.processes import launcher
from drgs.cli.commands import CommandParser
from drgs.core.environment import required
from drgs.core.errors import UserError
from drgs.io.figures import new_figure, write_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STEPS, ROUNDS = 6, 2

FEW = 1000
"""Gaussians, whose kernels take next to no time."""

OBJECT = Task(gaussians=100_000, boxes=1, size=400, views=8, threads=1, steps=STEPS)
STREET = Task(gaussians=3_000_000, boxes=5, size=1600, views=4, threads=1, steps=STEPS)
QUICK = Task(gaussians=20_000, boxes=1, size=200, views=4, threads=1, steps=STEPS)

CHECKED_PROCESSES, CHECKED_RATES = (1, 2, 4), (1e10, 1e9, 5e8)
"""On this machine, behind links of so many bits a second."""

CORES = 16
"""Of a machine that is predicted."""

MACHINES, RATES, VIEWS = (1, 4, 16, 64), (1e9, 1e10, 2.5e10), (4, 16, 64, 256)
"""What is predicted: bits a second of each machine's link; views of a step."""

VIEWS_A_MACHINE = 4
"""In the plot."""

EFFICIENCY = 0.85
"""Of the cores of a machine, while a kernel runs: what counting blocks gives for 16 of them
(``drgs.bench.amdahl``), before the memory that they share."""

PAYLOAD = 1448 / 1538
"""Of what a link carries: the rest is headers, of TCP, IP and Ethernet, and gaps between frames."""

LATENCY = 1e-4
"""Seconds until a message arrives, however small: of TCP, with processes that look now and then."""


@dataclass(frozen=True)
class Cost:
    """Milliseconds of a part of a step, on one core."""

    fixed: float  # however many rows and cores there are
    shared: float  # by those who have the rows, or by the cores


@dataclass(frozen=True)
class Costs:
    """Of a scene."""

    project: Cost  # a view
    render: Cost  # a view
    go_back: Cost  # a view
    optimize: Cost  # a step
    renders_ms: list[float]  # of single views
    splats: float  # of a view, on its film
    splat_bytes: int  # of one that travels
    gradient_bytes: int  # of the derivatives with respect to one

    @staticmethod
    def of(whole: Measured, few: Measured) -> Costs:
        """Of what is measured for a scene, and for the same cameras with next to no Gaussians."""
        parts = {}
        for name in ("project", "go_back", "optimize"):
            fixed = min(getattr(few, name).all, getattr(whole, name).all)
            parts[name] = Cost(fixed, getattr(whole, name).all - fixed)
        on_host = whole.render.all - whole.render.kernels
        return Costs(
            render=Cost(on_host, whole.render.kernels),
            renders_ms=whole.renders_ms,
            splats=whole.splats,
            splat_bytes=whole.splat_bytes,
            gradient_bytes=whole.gradient_bytes,
            **parts,
        )


@dataclass(frozen=True)
class Cluster:
    """Machines with a process each."""

    machines: int
    threads: int  # of each process
    rate: float  # bits a second that a machine can send, and receive
    latency: float = LATENCY
    sharing: float = 1.0  # how much longer everything takes where they share one machine's cores


@dataclass(frozen=True)
class Prediction:
    """Of a step: milliseconds, and bytes that each machine sends."""

    views: int
    computing: float
    waiting: float  # for machines whose views take longer
    exchanging: float
    sent_bytes: float

    @property
    def ms(self) -> float:
        """All of it."""
        return self.computing + self.waiting + self.exchanging

    @property
    def ms_of_view(self) -> float:
        """A view's part."""
        return self.ms / self.views


def predicted(costs: Costs, cluster: Cluster, views: int) -> Prediction:
    """A step of ``views`` views, from what one process on one core takes for the same scene.

    Raises ValueError where there are fewer views than machines.
    """
    machines = cluster.machines
    if views < machines:
        raise ValueError(f"predicted(): {machines} machines cannot share {views} views")
    time = partial(_time, cluster=cluster)
    of_rows = views * (time(costs.project, 1 / machines) + time(costs.go_back, 1 / machines))
    own = math.ceil(views / machines)
    longest = _longest(costs.renders_ms, machines, own)
    rendering = own * longest * time(costs.render, 1.0)
    computing = of_rows + time(costs.optimize, 1 / machines) + rendering
    exchanging = 0.0
    if machines > 1:
        exchanging = _pipelined(costs, cluster, own, rendering / own) - rendering
        exchanging += 1e3 * cluster.latency * 3  # all tell all
    waiting = (1 - 1 / longest) * rendering
    sent = sent_bytes(costs, machines, views)
    return Prediction(views, computing - waiting, waiting, exchanging, sent)


def _pipelined(costs: Costs, cluster: Cluster, views: int, rendering: float) -> float:
    """Milliseconds until ``views`` views of a machine are rendered and their derivatives are sent.

    rendering: of one view. Splats of the next views arrive meanwhile, one view after the other, and
    derivatives leave behind the splats that go to others.
    """
    of_others = costs.splats * (cluster.machines - 1) / cluster.machines
    to_ms, latency = 8e3 / (PAYLOAD * cluster.rate), 1e3 * cluster.latency
    splats = of_others * costs.splat_bytes * to_ms
    gradients = of_others * costs.gradient_bytes * to_ms
    rendered, sent = 0.0, views * splats
    for view in range(1, views + 1):
        rendered = max(rendered, view * splats + latency) + rendering
        sent = max(sent, rendered) + gradients
    return sent + latency


def sent_bytes(costs: Costs, machines: int, views: int) -> float:
    """By each machine in a step: splats of its rows to others, and derivatives of theirs.

    With m machines, a view sends what (m - 1) of them have on its film, and as much goes back.
    """
    of_view = costs.splats * (costs.splat_bytes + costs.gradient_bytes)
    return views * of_view * (machines - 1) / machines**2


def _time(cost: Cost, share: float, cluster: Cluster) -> float:
    """Milliseconds; share: of the rows."""
    speed = 1 if cluster.threads == 1 else EFFICIENCY * cluster.threads
    return cluster.sharing * (cost.fixed + cost.shared * share / speed)


def _longest(times: Sequence[float], machines: int, views: int) -> float:
    """How much longer than the mean the longest of ``machines`` takes for ``views`` views each."""
    drawn = np.random.default_rng(0).choice(times, (200, machines, views))
    return float(drawn.sum(axis=2).max(axis=1).mean() / (views * np.mean(times)))


# ----------------------------------------------------------------------------------------------
# Measuring
# ----------------------------------------------------------------------------------------------


def measured(task: Task, processes: int = 1, rate: float | None = None) -> Measured:
    """What processes of this machine take; rate: of their links, None: none is in between.

    The fastest of ``ROUNDS`` runs: other load makes them slower.
    """
    runs = (_run(task, processes, rate) for _ in range(ROUNDS))
    return min(runs, key=lambda run: run.step_ms)


def _run(task: Task, processes: int, rate: float | None) -> Measured:
    words = [sys.executable, "-m", "drgs.bench.parts", json.dumps(asdict(task))]
    if rate is not None:
        return Measured.from_json(run_within(processes, rate, words))
    done = subprocess.run(
        [launcher(), "-n", str(processes), *words], capture_output=True, text=True
    )
    if done.returncode != 0:
        raise UserError(f"bench cluster: {(done.stderr.strip().splitlines() or ['?'])[-1]}")
    return Measured.from_json(done.stdout)


def crowding_of(costs: Costs, task: Task, cores: int) -> float:
    """How much longer everything takes where all cores are busy: they share memory.

    From as many processes as cores, without a network between them.
    """
    alone = predicted(costs, Cluster(cores, 1, math.inf, latency=0.0), task.views)
    return max(1.0, measured(task, cores).step_ms / alone.ms)


@dataclass(frozen=True)
class Check:
    """A step as it was predicted, and as it was."""

    processes: int
    rate: float
    predicted_ms: float
    measured_ms: float
    predicted_bytes: float
    measured_bytes: float

    @property
    def error(self) -> float:
        """Of the time, relative."""
        return self.predicted_ms / self.measured_ms - 1


def checked(costs: Costs, task: Task, processes: int, rate: float, sharing: float) -> Check:
    """Compare, where processes share the cores of this machine, and each has its own link.

    sharing: how much longer everything takes because they do.
    """
    expected = predicted(costs, Cluster(processes, 1, rate, sharing=sharing), task.views)
    found = measured(task, processes, rate)
    times = expected.ms, found.step_ms
    return Check(processes, rate, *times, expected.sent_bytes, found.sent_bytes)


# ----------------------------------------------------------------------------------------------
# The command
# ----------------------------------------------------------------------------------------------


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s --quick")
    add_out(parser, run, "cluster.csv", "cluster_check.csv", "cluster.png")
    parser.add_argument("--quick", action="store_true", help="a small scene alone")


def run(args: argparse.Namespace) -> None:
    """Measure, compare with processes on a network within this machine, predict."""
    required("mpi4py", "mpi", "bench cluster")
    tasks = [QUICK] if args.quick else [OBJECT, STREET]
    print(machine())
    found = []
    for task in tasks:
        few = replace(task, gaussians=FEW * task.boxes)
        found.append((task, Costs.of(measured(task), measured(few))))
        print(f"\n{title(task)}\n\n{parts_table(found[-1][1])}", flush=True)
    if reason := obstacle():
        print(f"\nnot compared with a network within this machine: {reason}")
    else:
        _compare(*found[0], args)
    rows = [row for task, costs in found for row in predictions(task, costs)]
    for task, _ in found:
        own = [row for row in rows if row.gaussians == task.gaussians]
        print(f"\n{title(task)}: predicted\n\n{prediction_table(own)}")
    fields = [*Row.__dataclass_fields__]
    write_csv(args.out / "cluster.csv", fields, [list(vars(row).values()) for row in rows])
    write_figure(args.out / "cluster.png", plot(rows))
    print(f"\nwritten: {args.out / 'cluster.csv'}, {args.out / 'cluster.png'}")


def _compare(task: Task, costs: Costs, args: argparse.Namespace) -> None:
    cores = len(os.sched_getaffinity(0))  # networks are Linux's
    is_crowded = 1 < cores <= max(CHECKED_PROCESSES)
    crowding = crowding_of(costs, task, cores) if is_crowded else 1.0
    checks = [
        checked(costs, task, k, rate, crowding * k / cores if k >= cores > 1 else 1.0)
        for rate in CHECKED_RATES
        for k in CHECKED_PROCESSES
    ]
    print(
        f"\npredicted and measured, on {cores} cores, which together take {crowding:.2f} times as "
        f"long as one alone\n\n{check_table(checks)}",
        flush=True,
    )
    fields = [*Check.__dataclass_fields__]
    write_csv(args.out / "cluster_check.csv", fields, [list(vars(c).values()) for c in checks])


def title(task: Task) -> str:
    """What is fitted."""
    return (
        f"{task.gaussians:,} Gaussians, {task.size}x{task.size}, of which a view sees 1 / "
        f"{task.boxes}"
    )


def parts_table(costs: Costs) -> str:
    """What the parts of a step take, and what travels."""
    names = {
        "project all rows for a view": costs.project,
        "render a view": costs.render,
        "take the gradients of all rows back, for a view": costs.go_back,
        "step along them": costs.optimize,
    }
    rows = [[name, f"{cost.shared:.1f} ms", f"{cost.fixed:.1f} ms"] for name, cost in names.items()]
    table = markdown_table(["on one core", "that is shared", "that is not"], rows)
    return (
        f"{table}\n\nof a view {costs.splats:,.0f} splats travel, {costs.splat_bytes} bytes there "
        f"and {costs.gradient_bytes} back"
    )


def check_table(checks: Iterable[Check]) -> str:
    """A row for each."""
    rows = [
        [
            str(check.processes),
            _speed_of_link(check.rate),
            f"{check.predicted_bytes / 1e6:.1f} MB",
            f"{check.measured_bytes / 1e6:.1f} MB",
            f"{check.predicted_ms:.0f} ms",
            f"{check.measured_ms:.0f} ms",
            f"{100 * check.error:+.0f} %".replace("-", "\N{MINUS SIGN}"),
        ]
        for check in checks
    ]
    header = ["processes", "links", "sent, predicted", "measured"]
    return markdown_table([*header, "a step, predicted", "measured", "error"], rows)


@dataclass(frozen=True)
class Row:
    """A prediction, and how many times faster it is than one machine."""

    gaussians: int
    machines: int
    rate: float
    views: int
    ms_of_view: float
    exchanging: float  # ms of a view
    times_as_fast: float


def predictions(task: Task, costs: Costs) -> list[Row]:
    """For all clusters and numbers of views; compared with one machine and as many views."""
    rows = []
    for rate in RATES:
        for machines in MACHINES:
            cluster = Cluster(machines, CORES, rate)
            for views in (views for views in VIEWS if views >= machines):
                alone = predicted(costs, replace(cluster, machines=1), views)
                found = predicted(costs, cluster, views)
                times = alone.ms / found.ms
                exchanging = found.exchanging / views
                of_view = found.ms_of_view, exchanging, times
                rows.append(Row(task.gaussians, machines, rate, views, *of_view))
    return rows


def prediction_table(rows: Sequence[Row]) -> str:
    """Rows: machines and links; columns: views a step. Milliseconds a view, times as fast."""
    lines = []
    for machines in MACHINES:
        for rate in RATES if machines > 1 else RATES[:1]:
            found = {r.views: r for r in rows if (r.machines, r.rate) == (machines, rate)}
            cells = [
                f"{found[v].ms_of_view:.1f} ms, {found[v].times_as_fast:.1f}x" if v in found else ""
                for v in VIEWS
            ]
            lines.append([str(machines), _speed_of_link(rate) if machines > 1 else "", *cells])
    return markdown_table(
        ["machines", "links", *(f"{views} views a step" for views in VIEWS)], lines
    )


def _speed_of_link(rate: float) -> str:
    return f"{rate / 1e9:g} Gbit/s"


def plot(rows: Sequence[Row]) -> Figure:
    """Times as fast as one machine, over machines: a panel for each scene, a line for each link.

    With steps of ``VIEWS_A_MACHINE``.
    """
    counts = sorted({row.gaussians for row in rows})
    figure = new_figure(5 * len(counts), 4)
    for panel, count in zip(figure.subplots(1, len(counts), squeeze=False)[0], counts, strict=True):
        for rate in RATES:
            found = {
                row.machines: row.times_as_fast
                for row in rows
                if (row.gaussians, row.rate) == (count, rate)
                and row.views == VIEWS_A_MACHINE * row.machines
            }
            panel.loglog(*zip(*found.items(), strict=True), "o-", label=_speed_of_link(rate))
        panel.loglog(MACHINES, MACHINES, ":", color="grey", label="as many times as machines")
        title = f"{count:,} Gaussians, {VIEWS_A_MACHINE} views a machine: a prediction"
        panel.set_title(title, fontsize=10)
        panel.set_xlabel(f"machines of {CORES} cores")
        panel.set_ylabel("times as fast as one")
        panel.set_xticks(MACHINES, [str(machines) for machines in MACHINES])
        panel.set_yticks(MACHINES, [str(machines) for machines in MACHINES])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
        panel.legend(fontsize=8)
    return figure
