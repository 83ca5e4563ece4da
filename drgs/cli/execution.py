"""Settings of Dr.Jit for a command: threads and range checks, neither of which changes results."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext

import drjit as dr
import mitsuba as mi

from drgs.cli.commands import bounded_int
from drgs.cli.ending import interruptible_imports
from drgs.core.environment import VARIANTS, denormals_flushed
from drgs.core.errors import UserError, one_line
from drgs.core.memory import out_of_memory_reason

MAX_THREADS = 4096  # Dr.Jit starts all of them


def add_execution_arguments(
    parser: argparse.ArgumentParser, variants: Sequence[str] | None = VARIANTS
) -> None:
    """Add ``--variant``, ``--threads`` and ``--debug``; variants: choices, None: any."""
    add_variant_argument(parser, variants)
    parser.add_argument(
        "--threads",
        type=bounded_int(1, MAX_THREADS, "no machine has more cores"),
        metavar="N",
        help="number of CPU threads (default: one per core)",
    )
    parser.add_argument(
        "--debug",
        action="store_true",
        help="check the bounds of every memory access, and report violations; slow",
    )


def add_variant_argument(
    parser: argparse.ArgumentParser, variants: Sequence[str] | None = VARIANTS
) -> None:
    """Add ``--variant``; variants: as for :func:`add_execution_arguments`."""
    text = "Mitsuba variant (default: %(default)s)"
    parser.add_argument("--variant", default=VARIANTS[0], choices=variants, help=text)


def select_variant(name: str) -> None:
    """Make ``name`` the active Mitsuba variant; :class:`UserError` where it cannot be used."""
    try:
        with interruptible_imports():
            mi.set_variant(name)
    except ImportError as error:
        if out_of_memory_reason(error):
            raise
        raise UserError(f"--variant {name}: not usable here: {one_line(error)}") from None


@contextmanager
def execution_settings(threads: int | None, debug: bool) -> Iterator[None]:
    """Run the block on ``threads`` threads (None: as many as now), with range checks if ``debug``.

    Dr.Jit masks an access out of range, and reports it on standard error.
    """
    tracer = sys.gettrace()  # debug mode installs its own
    try:
        range_checks = dr.scoped_set_flag(dr.JitFlag.Debug) if debug else nullcontext()
        with _thread_count(threads), denormals_flushed(), range_checks:
            yield
    finally:
        sys.settrace(tracer)


@contextmanager
def _thread_count(count: int | None) -> Iterator[None]:
    if count is None:
        yield
        return
    previous = dr.thread_count()
    try:
        try:
            dr.set_thread_count(count)
        except RuntimeError as error:
            raise UserError(f"--threads {count}: the system reports: {one_line(error)}") from None
        yield
    finally:
        dr.set_thread_count(previous)
