"""Processes of a job that ``mpiexec`` starts: its start, its output and its end.

Launchers describe a job by variables of the environment. MPI itself is imported by
:func:`start_mpi` and by ``drgs.training.parallel`` alone.

A process that fails ends the whole job, with its own exit status. Where all fail alike, the first
one is heard: the others wait before they speak, and are ended meanwhile.
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

LAUNCHERS = (
    ("PMI_RANK", "PMI_SIZE"),  # MPICH
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),  # Open MPI
    ("PMIX_RANK", "SLURM_STEP_NUM_TASKS"),  # Slurm
)
"""Variables that hold the number of a process, from 0, and the number of processes."""

MPICH_SOCKET = "PMI_FD"
"""Variable that holds the file descriptor to MPICH's launcher, which reads lines of PMI-1 from it.
MPICH's launcher goes on when a process fails before MPI has started; others end the job."""

PATIENCE_S, PATIENCE_PER_PROCESS_S, MAX_PATIENCE_S = 2.0, 0.4, 8.0
"""A failed process waits so long for the first one, and for those of lower numbers, to speak."""

OUTPUT_S, ABORT_S = 0.2, 1.0
"""Time for a launcher to pass on what was printed, and to end the job: it takes milliseconds."""


def process_number() -> int | None:
    """Return the number that a launcher of MPI has given this process; None: there is none."""
    return _from_launcher(0)


def process_count() -> int | None:
    """Return the number of processes that the launcher has started; None: it is not known."""
    return _from_launcher(1)


def _from_launcher(index: int) -> int | None:
    """Return the number in a variable of the launcher that has numbered this process."""
    names = next((each for each in LAUNCHERS if os.environ.get(each[0], "").isdecimal()), None)
    text = os.environ.get(names[index], "") if names else ""
    return int(text) if text.isdecimal() else None


@contextmanager
def root_output_only() -> Iterator[None]:
    """Let only the first process print within the block; others, once they have failed alone.

    An error that leaves the block on another process does so after that one's patience, by which
    time an error of the first process has ended the job. Whoever prints it continues a line.
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
    """End all processes of the job where an error ends the block on this one."""
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
    """End all processes at once, with this exit status; nothing is cleaned up.

    ``MPI_Abort`` of MPICH has the others call ``exit``, which threads of C++ do not survive; its
    launcher ends them without.
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
    """Start MPI, for which all processes of the job wait for each other.

    Raises :class:`UserError` where there is no MPI, or another one than that of ``mpiexec``.
    """
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
