"""Scheduling of frames among viewer clients, at reduced resolution while a camera moves.

Dr.Jit renders in one thread, between two iterations of a fit. Server threads only queue requests.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from drgs.core.errors import UserError, reason_of_mitsuba
from drgs.live_page.frames import FrameRequest, LiveScene, ViewerFrame

MOVING_SECONDS = 0.08  # maximum time of a frame of a moving camera: 12 fps look like a motion
STILL_SECONDS = 0.15  # from the last request; browsers send one every 0.05 s while a camera moves
MAX_DIVISOR = 8  # of width and height while the camera moves
MIN_SIDE_PX = 64  # shorter side of a reduced frame


@dataclass(frozen=True, eq=False)
class PendingRequest:
    """The latest request of a client."""

    request: FrameRequest
    at: float  # by time.monotonic


class RenderRequests:
    """Requests of viewer clients, by any thread for the render thread; also to pause and end."""

    def __init__(self) -> None:
        self._pending: dict[int, PendingRequest] = {}
        self._changed = threading.Event()
        self.paused = self.ended = False

    def put(self, client: int, request: FrameRequest) -> None:
        """Replace the client's request."""
        self._pending[client] = PendingRequest(request, time.monotonic())
        self._changed.set()

    def remove(self, client: int) -> None:
        """Forget a client and its request."""
        self._pending.pop(client, None)

    def pause(self, paused: bool) -> None:
        """Pause or continue the fit."""
        self.paused = paused
        self._changed.set()

    def end(self) -> None:
        """End the fit after this iteration and write its results."""
        self.ended = True
        self._changed.set()

    @property
    def pending(self) -> dict[int, PendingRequest]:
        """Return pending requests by client."""
        return dict(self._pending)

    def wait(self, seconds: float) -> None:
        """Wait for a change since the last call, at most ``seconds``."""
        self._changed.wait(seconds)
        self._changed.clear()


@dataclass
class _ClientState:
    shown: PendingRequest | None = None
    divisor: int = 1
    at: float = 0.0  # by time.monotonic
    seconds: float = 0.0
    seconds_whole: float = 4 * MOVING_SECONDS  # of a frame at full resolution, at most


@dataclass
class RenderScheduler:
    """Renders the requests of all clients in turn."""

    requests: RenderRequests
    show: Callable[[int, FrameRequest, ViewerFrame, bool], None]  # client, ..., full resolution
    refuse: Callable[[int, str], None]  # client, reason
    refresh_after: Callable[[float], float] | None = None  # seconds, given the render time
    _clients: dict[int, _ClientState] = field(default_factory=dict)

    def serve(self, scene: Callable[[], LiveScene]) -> bool:
        """Render a due frame of the client that has waited longest; return whether one was due.

        scene: called only for a frame. Call in the Dr.Jit thread.
        """
        pending, now = self.requests.pending, time.monotonic()
        self._clients = {c: self._clients.get(c) or _ClientState() for c in pending}
        divisors = {c: self._due_divisor(pending[c], self._clients[c], now) for c in pending}
        due = {client: divisor for client, divisor in divisors.items() if divisor is not None}
        if not due:
            return False
        client = min(due, key=lambda each: self._clients[each].at)
        self._render(client, pending[client], due[client], scene)
        return True

    def _due_divisor(self, pending: PendingRequest, state: _ClientState, now: float) -> int | None:
        if pending is not state.shown:  # a frame is to take MOVING_SECONDS at most
            in_time = math.ceil(math.sqrt(state.seconds_whole / MOVING_SECONDS))
            side = min(pending.request.width, pending.request.height)
            return max(1, min(in_time, MAX_DIVISOR, side // MIN_SIDE_PX))
        if state.divisor > 1:
            # In steps: the camera may move again after each.
            return state.divisor // 2 if now - pending.at >= STILL_SECONDS else None
        if self.refresh_after is None:
            return None
        return 1 if now - state.at >= self.refresh_after(state.seconds) else None

    def _render(
        self, client: int, pending: PendingRequest, divisor: int, scene: Callable[[], LiveScene]
    ) -> None:
        state, request = self._clients[client], pending.request.smaller(divisor)
        start = time.monotonic()
        try:
            self.show(client, request, scene().frame(request), divisor == 1)
        except Exception as error:  # a request must not end the fit
            text = str(error) if isinstance(error, UserError) else reason_of_mitsuba(error)
            self.refuse(client, text)
            divisor = 1  # a larger frame would fail, too
        state.shown, state.divisor, state.at = pending, divisor, time.monotonic()
        state.seconds = state.at - start
        # At worst, the time is proportional to the number of pixels.
        state.seconds_whole = state.seconds * divisor**2
