"""Start, output and end of the processes of an ``mpiexec`` job.

Only :func:`start_mpi` and ``drgs.training.parallel`` import MPI. A process that fails ends the job
with its exit status. If all fail alike, only the first one prints: the others wait before.
"""

from __future__ import annotations

import os
import stat
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from typing import NoReturn

from drgs.core.environment import require_module
from drgs.core.errors import UserError, one_line

LAUNCHERS = (  # environment variables of a process's number, from 0, and the number of processes
    ("PMI_RANK", "PMI_SIZE"),  # MPICH
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),  # Open MPI
    ("PMIX_RANK", "SLURM_STEP_NUM_TASKS"),  # Slurm
)

MPICH_SOCKET = "PMI_FD"
"""Environment variable of the file descriptor from which MPICH's launcher reads lines of PMI-1. It
goes on when a process fails before MPI has started; other launchers end the job."""

PATIENCE_S, PATIENCE_PER_PROCESS_S, MAX_PATIENCE_S = 2.0, 0.4, 8.0
"""Delays before a failed process prints, so that those of lower numbers print first."""

OUTPUT_S, ABORT_S = 0.2, 1.0  # for a launcher to pass on output, and to end the job


def process_number() -> int | None:
    """Return the number that a launcher of MPI has given this process; None without one."""
    return _launcher_variable(0)


def process_count() -> int | None:
    """Return the number of processes that the launcher has started; None if unknown."""
    return _launcher_variable(1)


def _launcher_variable(index: int) -> int | None:
    names = next((each for each in LAUNCHERS if os.environ.get(each[0], "").isdecimal()), None)
    text = os.environ.get(names[index], "") if names else ""
    return int(text) if text.isdecimal() else None


@contextmanager
def root_output_only() -> Iterator[None]:
    """Let only the first process print within the block; on others, errors leave it after a delay.

    By then, an error of the first process has ended the job.
    """
    number = process_number()
    if not number:
        yield
        return
    try:
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            yield
    except BaseException as error:
        if not isinstance(error, SystemExit) or error.code:
            time.sleep(min(PATIENCE_S + PATIENCE_PER_PROCESS_S * number, MAX_PATIENCE_S))
            print(f"process {number}: ", end="", file=sys.stderr)
        raise


@contextmanager
def end_job_on_error() -> Iterator[None]:
    """End all processes of the job if an error ends the block on this one."""
    if process_number() is None:
        yield
        return
    try:
        yield
    except SystemExit as end:
        if not end.code:
            raise
        end_job(end.code if isinstance(end.code, int) else 1)
    except BaseException:
        traceback.print_exc()
        end_job(1)


def end_job(status: int) -> NoReturn:
    """End all processes at once, with this exit status and without clean-up.

    After MPICH's ``MPI_Abort``, the others call ``exit``, which crashes C++ threads; its launcher
    kills them.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # the reader has gone, or the stream was closed
            stream.flush()
    time.sleep(OUTPUT_S)
    with suppress(KeyError, OSError, ValueError):  # it is another launcher
        launcher = int(os.environ[MPICH_SOCKET])
        if stat.S_ISSOCK(os.fstat(launcher).st_mode):  # not a file, in a child that inherits less
            os.write(launcher, f"cmd=abort exitcode={status}\n".encode())
            time.sleep(ABORT_S)
    mpi = sys.modules.get("mpi4py.MPI")
    if mpi is not None and not mpi.Is_finalized() and mpi.COMM_WORLD.Get_size() > 1:
        mpi.COMM_WORLD.Abort(status)
    os._exit(status)


def start_mpi() -> None:
    """Start MPI on all processes; raise :class:`UserError` if there is none, or not mpiexec's."""
    require_module("mpi4py", "mpi", "mpiexec")
    try:
        mpi = import_module("mpi4py.MPI")
    except (ImportError, RuntimeError) as error:
        raise UserError(
            f"mpiexec: mpi4py finds no MPI: {one_line(error)}; pip install 'drgs[mpi]'"
        ) from None
    started, known = process_count(), mpi.COMM_WORLD.Get_size()
    if started is not None and started > known:
        raise UserError(
            f"mpiexec: has started {started} processes, but MPI knows of {known}; use the mpiexec "
            f"of the MPI that mpi4py was built for: {one_line(mpi.Get_library_version(), 80)}"
        )
