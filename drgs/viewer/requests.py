"""What those who look on ask for: left by a server's threads, taken by the one that renders.

Dr.Jit works in one thread, between two iterations of a fit. The callbacks of a server only leave
requests here, and nothing of Dr.Jit is touched by them.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from drgs.viewer.frames import FrameRequest


@dataclass(frozen=True, eq=False)
class Asked:
    """The last request of one who looks on."""

    request: FrameRequest
    number: int  # grows with each request
    at: float  # by time.monotonic


class Wishes:
    """Requests by client, and what is to happen to a fit; any thread may call any method."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._asked: dict[int, Asked] = {}
        self._count = 0
        self._is_new = False  # since the last wait
        self._paused = self._ended = False

    def ask(self, client: int, request: FrameRequest) -> None:
        """Take the place of what the client has asked for before."""
        with self._changed:
            self._count += 1
            self._asked[client] = Asked(request, self._count, time.monotonic())
            self._notify()

    def leave(self, client: int) -> None:
        """The client has gone."""
        with self._changed:
            self._asked.pop(client, None)

    def pause(self, paused: bool) -> None:
        """The fit is to wait, or to go on."""
        with self._changed:
            self._paused = paused
            self._notify()

    def end(self) -> None:
        """The fit is to end as it is, with results."""
        with self._changed:
            self._ended = True
            self._notify()

    @property
    def paused(self) -> bool:
        """Whether the fit is to wait."""
        return self._paused

    @property
    def ended(self) -> bool:
        """Whether the fit is to end."""
        return self._ended

    @property
    def asked(self) -> dict[int, Asked]:
        """By client."""
        with self._changed:
            return dict(self._asked)

    def wait(self, seconds: float) -> None:
        """Until something was left since the last call, at most so long."""
        with self._changed:
            if not self._is_new:
                self._changed.wait(seconds)
            self._is_new = False

    def _notify(self) -> None:
        self._is_new = True
        self._changed.notify_all()
