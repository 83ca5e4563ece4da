"""Whether this process is one of several that work together, as ``mpiexec`` starts them.

What is told by variables of the environment: MPI itself is imported by ``drgs.distributed`` alone.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout

NUMBERS = ("PMI_RANK", "PMIX_RANK", "OMPI_COMM_WORLD_RANK")
"""Variables in which launchers tell a process its number, from 0: MPICH, Slurm, Open MPI."""


def process_number() -> int | None:
    """The number that a launcher of MPI has given this process; None: there is none."""
    for name in NUMBERS:
        if os.environ.get(name, "").isdecimal():
            return int(os.environ[name])
    return None


@contextmanager
def one_voice() -> Iterator[None]:
    """Within the block, of several processes only the first prints."""
    if not process_number():
        yield
        return
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield
