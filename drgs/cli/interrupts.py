"""How Ctrl-C and SIGTERM end a command; Ctrl-C as a request: stop after the iteration, and save."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

from drgs.core.processes import process_number

INTERRUPTED_STATUS = 130
"""Exit status of a command that was stopped by Ctrl-C: 128 + SIGINT, as shells report it."""

TERMINATED_STATUS = 143
"""The same for SIGTERM, as ``kill``, ``timeout`` and batch systems send it."""


class StopRequest:
    """A context manager within which the first Ctrl-C only sets ``requested``.

    A second one ends the program at once, as usual.
    """

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> StopRequest:
        """Take over the signal."""
        self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give the signal back."""
        signal.signal(signal.SIGINT, self._previous)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        signal.signal(signal.SIGINT, self._previous)


class Terminated(KeyboardInterrupt):
    """SIGTERM has arrived: files that are half written are removed, as after Ctrl-C."""


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Around a command: Ctrl-C ends it with status 130, SIGTERM with 143, without a traceback.

    Not SIGTERM where it is one of several processes: with it, ``mpiexec`` ends those that wait.
    """
    previous = signal.getsignal(signal.SIGTERM)
    is_main = threading.current_thread() is threading.main_thread()  # others have no signals
    is_taken = is_main and previous == signal.SIG_DFL and process_number() is None
    try:
        if is_taken:
            signal.signal(signal.SIGTERM, _terminate)
        yield
    except Exception as error:
        if (cause := _interrupt_behind(error)) is None:
            raise
        _exit_interrupted(cause)
    except KeyboardInterrupt as error:
        _exit_interrupted(error)
    finally:
        if is_taken:
            signal.signal(signal.SIGTERM, previous)


@contextmanager
def importing() -> Iterator[None]:
    """Around imports within a command: Ctrl-C and SIGTERM end the process at once.

    Extension modules may abort, or hide what was raised, where it is raised while they are
    imported. To be used where nothing is being written.
    """
    handlers = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: _terminate}
    taken = {n: h for n, h in handlers.items() if signal.getsignal(n) == h}
    if threading.current_thread() is not threading.main_thread():
        taken = {}
    try:
        for number in taken:
            signal.signal(number, _end_at_once)
        yield
    finally:
        for number, handler in taken.items():
            signal.signal(number, handler)


def _end_at_once(number: int, frame: FrameType | None) -> None:
    os.write(2, b"interrupted\n" if number == signal.SIGINT else b"terminated\n")
    os._exit(INTERRUPTED_STATUS if number == signal.SIGINT else TERMINATED_STATUS)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


def _interrupt_behind(error: BaseException) -> KeyboardInterrupt | None:
    """The interrupt, if there is one: Dr.Jit raises its own errors for one in a callback."""
    causes: list[BaseException] = []
    while error is not None and error not in causes:
        if isinstance(error, KeyboardInterrupt):
            return error
        causes.append(error)
        error = error.__cause__ or error.__context__
    return None


def _exit_interrupted(interrupt: KeyboardInterrupt) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):  # a further one is no error of the clean-up
        signal.signal(number, signal.SIG_DFL)
    # Where it came within one, as dataclasses use them, CPython ends by SIGINT: this forgets it.
    exec("")
    is_terminated = isinstance(interrupt, Terminated)
    print("terminated" if is_terminated else "interrupted", file=sys.stderr)
    sys.exit(TERMINATED_STATUS if is_terminated else INTERRUPTED_STATUS)
