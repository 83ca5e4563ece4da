"""A network within this machine: processes of MPI behind links as slow as one likes (Linux, root).

Each process has a network namespace, whose only link, of a given rate in either direction, leads to
a switch. So they talk as machines of a cluster would, by TCP, though they share cores and memory.
All of it is gone when the last of them ends.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence

from drgs.bench.processes import launcher
from drgs.core.errors import UserError

TOOLS = ("unshare", "mount", "ip", "tc")

PRIVATE = ("unshare", "--net", "--mount", "sh", "-c")
"""Runs a script where what it does to the network and to mounts concerns nobody else."""

SCRIPT = """
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
"""Launcher, number of processes, bits a second of each link, bytes that pass at once before a link
keeps to its rate, and the words of the command."""

BURST_S, LEAST_BURST = 2e-3, 16_384
"""Seconds at the rate; bytes, more than a packet. Kernels hand over 64 KB at a time: with less, a
fast link is slower than its rate."""

BY_TCP = {"MPIR_CVAR_NOLOCAL": "1", "MPIR_CVAR_CH4_NETMOD": "ofi", "FI_PROVIDER": "tcp"}
"""Has MPICH send everything by TCP, also between processes of one machine."""


def obstacle() -> str:
    """Why there cannot be such a network here; empty: there can."""
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        return f"there is no {missing[0]}; install iproute2 and util-linux"
    tried = within(1, 1e9, ["true"], command=["true"])
    return "" if tried.returncode == 0 else tried.stderr.strip() or "it cannot be set up"


def run_within(count: int, rate: float, words: Sequence[object]) -> str:
    """What ``words`` print on so many processes, behind links of ``rate`` bits a second."""
    done = within(count, rate, words, [launcher()])
    if done.returncode != 0:
        raise UserError(f"{count} processes: {(done.stderr.strip().splitlines() or ['?'])[-1]}")
    return done.stdout


def within(
    count: int, rate: float, words: Sequence[object], command: Sequence[str]
) -> subprocess.CompletedProcess:
    """Run the launcher ``command`` in a new network."""
    burst = max(LEAST_BURST, round(BURST_S * rate / 8))
    link = [f"{rate:.0f}bit", str(burst)]
    return subprocess.run(
        [*PRIVATE, SCRIPT, "-", *command, str(count), *link, *map(str, words)],
        env={**os.environ, **BY_TCP},
        capture_output=True,
        text=True,
    )
