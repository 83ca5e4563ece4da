"""Ctrl-C as a request: stop after the running iteration, and save."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

INTERRUPTED_STATUS = 130
"""Exit status of a command that was stopped by Ctrl-C: 128 + SIGINT, as shells report it."""


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


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Around a command: Ctrl-C ends it with status 130, without a traceback."""
    try:
        yield
    except Exception as error:
        if not _was_interrupted(error):
            raise
        _exit_interrupted()
    except KeyboardInterrupt:
        _exit_interrupted()


def _was_interrupted(error: BaseException) -> bool:
    """Whether Ctrl-C is behind it: Dr.Jit raises its own errors for what happens in a callback."""
    causes: list[BaseException] = []
    while error is not None and error not in causes:
        causes.append(error)
        error = error.__cause__ or error.__context__
    return any(isinstance(cause, KeyboardInterrupt) for cause in causes)


def _exit_interrupted() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a further one is no error of the clean-up
    print("interrupted", file=sys.stderr)
    sys.exit(INTERRUPTED_STATUS)
