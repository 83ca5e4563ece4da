"""Ctrl-C as a request: stop after the running iteration, and save."""

from __future__ import annotations

import signal
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
