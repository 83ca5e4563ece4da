"""``python -m drgs.bench processes FIT_DIR``: what several processes make of a step.

The Gaussians of a fit that has ended are fitted on, without changes of the population, by one
process and by several, one thread each, and by one process with as many threads. Runs take turns,
since other load on the machine comes and goes; medians are what is shown.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drgs.bench.output import add_out, machine, markdown_table, write_csv
from drgs.cli.commands import CommandParser, at_least
from drgs.core.environment import required
from drgs.core.errors import UserError
from drgs.results.files import GAUSSIANS

STEPS, ROUNDS = 4, 3


@dataclass(frozen=True)
class Way:
    """How many processes, with how many threads each; processes 0: one without MPI."""

    processes: int
    threads: int

    @property
    def name(self) -> str:
        """As the table shows it."""
        threads = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        if self.processes == 0:
            return f"1 process without MPI, {threads}"
        return f"{self.processes} {'process' if self.processes == 1 else 'processes'}, {threads}"


@dataclass(frozen=True)
class Timing:
    """Of a step on the first process: milliseconds, and bytes that it sent."""

    way: str
    views: int
    ms: float
    waiting: float
    exchanging: float
    sent_bytes: float


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s out/lego", "%(prog)s out/lego --views 16 --processes 1 2")
    parser.add_argument("folder", type=Path, metavar="FIT_DIR", help="a fit that has ended")
    add_out(parser, run, "processes.csv")
    parser.add_argument(
        "--views", type=at_least(1, 1000), default=8, metavar="B", help="a step (default: 8)"
    )
    parser.add_argument(
        "--processes", type=at_least(1, 1024), nargs="+", default=[1, 2], metavar="K",
        help="(default: 1 2)",
    )  # fmt: skip
    parser.add_argument(
        "--rounds", type=at_least(1, 100), default=ROUNDS, metavar="N", help=f"(default: {ROUNDS})"
    )


def run(args: argparse.Namespace) -> None:
    """Time all ways in turns; a table and a CSV file."""
    if not (args.folder / GAUSSIANS).is_file():
        raise UserError(f"{args.folder}: must be the folder of a fit that has ended")
    required("mpi4py", "mpi", "bench processes")
    most = max(args.processes)
    ways = [Way(0, 1), *(Way(k, 1) for k in args.processes)]
    ways += [Way(0, most)] if most > 1 else []
    found: dict[Way, list[Timing]] = {way: [] for way in ways}
    for _ in range(args.rounds):
        for way in ways:
            found[way].append(timed(way, args.folder, args.views))
            print(f"{way.name}: {found[way][-1].ms / args.views:.1f} ms a view", flush=True)
    results = [median_of(timings) for timings in found.values()]
    print(f"\n{machine()}\n\n{table(results)}\n")
    write_csv(
        args.out / "processes.csv",
        Timing.__dataclass_fields__,
        [list(vars(timing).values()) for timing in results],
    )
    print(f"written: {args.out / 'processes.csv'}")


def timed(way: Way, folder: Path, views: int) -> Timing:
    """One run."""
    words = [sys.executable, "-m", "drgs.bench.rank", str(folder), views, STEPS, way.threads]
    if way.processes:
        words = [launcher(), "-n", way.processes, *words]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True)
    if done.returncode != 0:
        raise UserError(f"{way.name}: {done.stderr.strip().splitlines()[-1]}")
    return Timing(way.name, views, **json.loads(done.stdout.splitlines()[-1]))


def launcher() -> str:
    """``mpiexec``, of this environment if it has one."""
    beside = Path(sys.executable).parent / "mpiexec"
    found = str(beside) if beside.exists() else shutil.which("mpiexec")
    if found is None:
        raise UserError("bench processes: there is no mpiexec; pip install 'drgs[mpi]'")
    return found


def median_of(timings: Sequence[Timing]) -> Timing:
    """The run of the median time."""
    median = statistics.median_low(timing.ms for timing in timings)
    return next(timing for timing in timings if timing.ms == median)


def table(results: Sequence[Timing]) -> str:
    """A row for each way; times in milliseconds a view."""
    first = results[0].ms
    rows = [
        [
            timing.way,
            f"{timing.ms / timing.views:.1f}",
            f"{first / timing.ms:.2f}",
            f"{timing.waiting / timing.views:.1f}",
            f"{timing.exchanging / timing.views:.1f}",
            f"{timing.sent_bytes / 1e6:.1f}",
        ]
        for timing in results
    ]
    header = ["", "ms a view", "times as fast", "of that waiting", "exchanging", "MB sent a step"]
    return markdown_table(header, rows)
