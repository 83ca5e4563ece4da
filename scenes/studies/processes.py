"""Time steps of one process and of several.

The Gaussians of a finished fit are fitted on, without changes of the population, by one process and
by several, one thread each, and by one process with as many threads. Runs take turns, since other
load on the machine comes and goes; medians are shown.

``--gbit`` puts each process behind a link of its own, in a network within this machine (Linux,
root, MPICH): a network namespace whose only link, of a given rate in either direction, leads to a
switch. The processes then talk as machines of a cluster would, by TCP, though they share cores and
memory.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)
import drjit as dr
import mitsuba as mi
import numpy as np
from drgs.bench.output import machine, markdown_table, seconds
from drgs.config.changes import with_changes
from drgs.core.environment import denormals_flushed
from drgs.core.processes import end_job_on_error, process_number
from drgs.datasets import load_dataset
from drgs.gaussians.parameters import Gaussians
from drgs.results.folder import load_run_config, own_gaussians
from drgs.training.parallel import exchange
from drgs.training.parallel.communicator import Communicator
from drgs.training.trainer import Trainer
from stages import steps

STEPS = 4

NETWORK = """
set -e
launcher=$1 count=$2 rate=$3 burst=$4
shift 4
mkdir -p /run/netns
mount -t tmpfs none /run/netns
ip link set lo up
ip link add switch type bridge
ip link set switch up
for i in $(seq 0 $((count - 1))); do
    ip netns add host$i
    ip link add port$i type veth peer name wire netns host$i
    ip link set port$i master switch up
    ip -n host$i address add 10.0.0.$((i + 1))/24 dev wire
    ip -n host$i link set lo up
    ip -n host$i link set wire up
    tc qdisc add dev port$i root tbf rate $rate burst $burst latency 1s
    tc -n host$i qdisc add dev wire root tbf rate $rate burst $burst latency 1s
done
exec "$launcher" -n $count sh -c 'exec ip netns exec host$PMI_RANK "$@"' - "$@"  # MPICH's variable
"""
"""Shell script: launcher, number of processes, bits a second of each link, bytes that pass at once
before a link keeps to its rate, and the words of the command. Namespaces end with the script."""

BURST_S, MIN_BURST_BYTES = 2e-3, 16_384
"""Kernels hand over 64 KB at a time: with a smaller burst, a fast link is slower than its rate."""

TCP_ENVIRONMENT = {"MPIR_CVAR_NOLOCAL": "1", "MPIR_CVAR_CH4_NETMOD": "ofi", "FI_PROVIDER": "tcp"}
"""Environment with which MPICH sends everything by TCP, also within one machine."""


@dataclass
class TimedCommunicator(Communicator):
    """Counts seconds of waiting for ranks that are not ready and of exchanges, and bytes sent."""

    waiting: float = 0.0
    exchanging: float = 0.0
    sent_bytes: int = 0

    def timed(self, exchange: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function; its time counts, but what is spent on waiting."""

        def call(*arguments: Any) -> Any:
            waited, start = self.waiting, time.perf_counter()
            result = exchange(*arguments)
            self.exchanging += time.perf_counter() - start - (self.waiting - waited)
            return result

        return call

    def all_gather(self, numbers: np.ndarray) -> np.ndarray:
        """Wait for all ranks."""
        start = time.perf_counter()
        gathered = super().all_gather(numbers)
        self.waiting += time.perf_counter() - start
        return gathered

    def all_gather_rows(self, rows: np.ndarray) -> np.ndarray:
        """Exchange rows."""
        self.sent_bytes += rows.nbytes * (self.size - 1)
        return self.timed(super().all_gather_rows)(rows)

    def broadcast(self, array: np.ndarray, root: int = 0) -> np.ndarray:
        """Exchange an array."""
        self.sent_bytes += array.nbytes * (self.size - 1) * (root == self.rank)
        return self.timed(super().broadcast)(array, root)

    def send(self, array: np.ndarray, to: int, tag: int) -> Any:
        """Send an array."""
        self.sent_bytes += array.nbytes
        return super().send(array, to, tag)


def run_process(folder: Path, views: int, threads: int) -> None:
    """Time steps in this process, alone or as one of several; rank 0 prints JSON."""
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(threads)
    never = 1_000_000
    changes = {
        "iterations": never,
        "coarse": [],
        "densify.start": never,
        "densify.stop": never + 1,
        "densify.prune.to": None,
        "model.sh_increase_every": 1,
        "optimizer.views_per_step": views,
    }
    config = with_changes(load_run_config(folder), changes)
    dataset, gaussians = load_dataset(config.data), Gaussians.load(own_gaussians(folder))
    comm = TimedCommunicator() if process_number() is None else TimedCommunicator.world()
    exchange.wait = comm.timed(exchange.wait)
    with denormals_flushed():
        trainer = Trainer(config, dataset, gaussians, comm)
        steps(trainer, len(dataset.train) // views + 2)  # makes the targets of all views
        comm.all_gather(np.zeros(1))  # all begin together
        comm.waiting, comm.exchanging, comm.sent_bytes = 0.0, 0.0, 0
        spent = seconds(lambda: steps(trainer, STEPS)) / STEPS
    if comm.is_root:
        waiting, exchanging = 1e3 * comm.waiting / STEPS, 1e3 * comm.exchanging / STEPS
        sent = comm.sent_bytes / STEPS
        print(json.dumps([1e3 * spent, waiting, exchanging, sent]))


def run_processes(args: argparse.Namespace, processes: int, threads: int) -> list[float]:
    """Run one process without MPI (``processes`` 0) or several; return what rank 0 printed."""
    words = [sys.executable, __file__, args.folder, "--views", args.views, "--threads", threads]
    beside = Path(sys.executable).parent / "mpiexec"
    launcher = str(beside) if beside.exists() else shutil.which("mpiexec") or "mpiexec"
    environment = dict(os.environ)
    if processes and args.gbit:
        burst = max(MIN_BURST_BYTES, round(BURST_S * args.gbit * 1e9 / 8))
        private = ["unshare", "--net", "--mount", "sh", "-c", NETWORK, "-", launcher]
        words = [*private, processes, f"{args.gbit * 1e9:.0f}bit", burst, *words]
        environment |= TCP_ENVIRONMENT
    elif processes:
        words = [launcher, "-n", processes, *words]
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, env=environment
    )
    if done.returncode != 0:
        raise SystemExit(f"{processes} processes: {done.stderr.strip()}")
    return json.loads(done.stdout.splitlines()[-1])


def name_of(processes: int, threads: int) -> str:
    """Describe a row of the table."""
    kind = "1 process without MPI" if processes == 0 else f"{processes} process"
    return f"{kind}{'es' if processes > 1 else ''}, {threads} thread{'s' if threads > 1 else ''}"


def main() -> None:
    """Time all numbers of processes in turns."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FIT_DIR", help="a finished fit")
    parser.add_argument("--views", type=int, default=8, metavar="B", help="a step (default: 8)")
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2], metavar="K")
    parser.add_argument("--gbit", type=float, metavar="RATE", help="of each link, Gbit/s")
    parser.add_argument("--rounds", type=int, default=3, metavar="N")
    parser.add_argument("--threads", type=int, help=argparse.SUPPRESS)  # of one process
    args = parser.parse_args()
    if args.threads is not None:
        end_job_on_error()(run_process)(args.folder, args.views, args.threads)
        return
    most = max(args.processes)
    ways = [(0, 1), *((k, 1) for k in args.processes), *([(0, most)] if most > 1 else [])]
    found: dict[tuple[int, int], list[list[float]]] = {way: [] for way in ways}
    for _ in range(args.rounds):
        for way in ways:
            found[way].append(run_processes(args, *way))
    median = {way: sorted(runs)[(len(runs) - 1) // 2] for way, runs in found.items()}
    first = median[ways[0]][0]
    rows = []
    for way, (spent, waiting, exchanging, sent) in median.items():
        numbers = spent / args.views, first / spent, waiting / args.views, exchanging / args.views
        cells = [f"{n:.{d}f}" for n, d in zip(numbers, (1, 2, 1, 1), strict=True)]
        rows.append([name_of(*way), *cells, f"{sent / 1e6:.1f}"])
    header = ["", "ms a view", "times as fast", "of that waiting", "exchanging", "MB sent a step"]
    print(f"{machine()}\n\n{markdown_table(header, rows)}")


if __name__ == "__main__":
    main()
