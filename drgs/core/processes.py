"""One process among several, as ``mpiexec`` starts them: how the job speaks, starts and ends.

Launchers describe a job by variables of the environment. MPI itself is imported by
:func:`start_mpi` and by ``drgs.training.parallel`` alone.

A process that fails ends the whole job, with its own exit status. Where all fail alike, the first
one is heard: the others wait before they speak, and are ended meanwhile.
"""

from __future__ import annotations

import os
import signal
import stat
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from typing import NoReturn

import psutil

from drgs.core.environment import required
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

MPICH_LAUNCHER, MPICH_LOCAL_COUNT = "hydra_pmi_proxy", "MPI_LOCALNRANKS"
"""Name of the parent of all processes of a machine, and the variable that holds their number."""

PATIENCE_S, PATIENCE_PER_PROCESS_S, MAX_PATIENCE_S = 2.0, 0.4, 8.0
"""A failed process waits so long for the first one, and for those of lower numbers, to speak."""

OUTPUT_S, ABORT_S = 0.2, 1.0
"""Time for a launcher to pass on what was printed, and to end the job: it takes milliseconds."""

WATCH_S = 0.25
"""Between two looks at the other processes of a machine."""


def process_number() -> int | None:
    """The number that a launcher of MPI has given this process; None: there is none."""
    return _numbers()[0]


def process_count() -> int | None:
    """The number of processes that the launcher has started; None: it is not known."""
    return _numbers()[1]


def _numbers() -> tuple[int | None, int | None]:
    for names in LAUNCHERS:
        number, count = (os.environ.get(name, "") for name in names)
        if number.isdecimal():
            return int(number), int(count) if count.isdecimal() else None
    return None, None


# ----------------------------------------------------------------------------------------------
# One voice, one end
# ----------------------------------------------------------------------------------------------


@contextmanager
def one_voice() -> Iterator[None]:
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
            time.sleep(_patience(number))
            print(f"process {number}: ", end="", file=sys.stderr)
        raise


def _patience(number: int) -> float:
    return min(PATIENCE_S + PATIENCE_PER_PROCESS_S * number, MAX_PATIENCE_S)


@contextmanager
def ending_together() -> Iterator[None]:
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


# ----------------------------------------------------------------------------------------------
# The start
# ----------------------------------------------------------------------------------------------


def start_mpi() -> None:
    """Start MPI, for which all processes of the job wait for each other.

    Raises :class:`UserError` where there is no MPI, or another one than that of ``mpiexec``.
    """
    required("mpi4py", "mpi", "mpiexec")
    with _others_watched():
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


@contextmanager
def _others_watched() -> Iterator[None]:
    """End the job where another process of this machine ends before MPI has started.

    MPICH alone needs this: see :data:`MPICH_SOCKET`. Starting MPI holds Python's lock, so that a
    process has to do it, not a thread.
    """
    launcher = _launcher_of_mpich()
    if launcher is None:
        yield
        return
    waiting = os.getpid()
    watcher = os.fork()
    if watcher == 0:
        try:
            _watch(launcher, waiting)
        finally:
            os._exit(0)
    try:
        yield
    finally:
        os.kill(watcher, signal.SIGKILL)
        os.waitpid(watcher, 0)


def _launcher_of_mpich() -> psutil.Process | None:
    """Return the parent of the processes that MPICH has started on this machine."""
    if not {MPICH_SOCKET, MPICH_LOCAL_COUNT} <= os.environ.keys():
        return None
    with suppress(psutil.Error):  # out of sight
        return next((p for p in psutil.Process().parents() if p.name() == MPICH_LAUNCHER), None)
    return None


def _watch(launcher: psutil.Process, waiting: int) -> None:
    """Wait until a process of this machine is missing; then end the job for ``waiting``.

    A process of ours that has failed is there until it has spoken.
    """
    count = int(os.environ[MPICH_LOCAL_COUNT])
    while os.getppid() == waiting and len(launcher.children()) >= count:
        time.sleep(WATCH_S)
    time.sleep(_patience(process_number() or 0))
    if os.getppid() == waiting:
        message = (
            "error: mpiexec: a process of this machine has ended before MPI has started; see what "
            "it has printed, and whether each process can run Python and drgs\n"
        )
        os.write(2, message.encode())
        end_job(2)
