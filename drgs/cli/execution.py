"""Settings of Dr.Jit for a command: threads and range checks, neither of which changes results."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from typing import TextIO, cast

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
    text = "number of CPU threads (default: one per core)"
    parser.add_argument("--threads", type=bounded_int(1, MAX_THREADS), metavar="N", help=text)
    text = "check the bounds of every memory access, and stop at the first violation; slow"
    parser.add_argument("--debug", action="store_true", help=text)


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
def execution_settings(threads: int | None, debug: bool) -> Iterator[Callable[[], None]]:
    """Run the block on ``threads`` threads (None: as many as now), with range checks if ``debug``.

    Yields a function, also called at the end: it raises :class:`UserError` if one was out of range.
    """
    with _thread_count(threads), denormals_flushed():
        if not debug:
            yield lambda: None
            return
        reports, tracer = _RangeReports(sys.stderr), sys.gettrace()  # debug mode installs its own
        try:
            with redirect_stderr(cast("TextIO", reports)), dr.scoped_set_flag(dr.JitFlag.Debug):
                yield reports.check
                reports.check()
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


class _RangeReports:
    """A text stream that records Dr.Jit's reports of accesses out of range, which it masks."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._reports: list[str] = []

    def write(self, text: str) -> int:
        """Pass on ``text``."""
        if "out-of-bounds" in text:
            self._reports.append(one_line(text))
        return self._stream.write(text)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)

    def check(self) -> None:
        """Raise :class:`UserError` with the first report, if there is one."""
        dr.sync_thread()
        if self._reports:
            raise UserError(
                f"--debug: {self._reports[0]}; this is a defect of the program: please report it"
            )
