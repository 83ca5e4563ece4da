"""Scheduling of frames: whose is rendered next, and how large: small while its camera moves.

Dr.Jit works in one thread, between two iterations of a fit. Server threads only queue requests.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from drgs.core.errors import UserError, reason_of_mitsuba
from drgs.viewer.frames import FrameRequest, LiveScene, ViewerFrame

MOVING_SECONDS = 0.08
"""Longest time of a frame while its camera moves: twelve a second look like a motion."""

STILL_SECONDS = 0.15
"""Time without a request after which a camera is still; browsers send one at least every 0.05 s."""

DIVISORS = (1, 2, 3, 4, 6, 8)  # divisors of width and height while the camera moves
MIN_SIDE_PX = 64  # shorter side of a frame of a moving camera, where the whole one is larger


@dataclass(frozen=True, eq=False)
class PendingRequest:
    """The last request of a client."""

    request: FrameRequest
    at: float  # by time.monotonic


class RenderRequests:
    """Render requests from viewer clients, queued by server threads for the render thread.

    Clients also pause and end a fit here. Any thread may call any method.
    """

    def __init__(self) -> None:
        self._pending: dict[int, PendingRequest] = {}
        self._changed = threading.Event()
        self.paused = self.ended = False

    def put(self, client: int, request: FrameRequest) -> None:
        """Replace the client's request."""
        self._pending[client] = PendingRequest(request, time.monotonic())
        self._changed.set()

    def remove(self, client: int) -> None:
        """Forget a client that has gone."""
        self._pending.pop(client, None)

    def pause(self, paused: bool) -> None:
        """Pause the fit, or let it go on."""
        self.paused = paused
        self._changed.set()

    def end(self) -> None:
        """End the fit as it is, with results."""
        self.ended = True
        self._changed.set()

    @property
    def pending(self) -> dict[int, PendingRequest]:
        """The last request of each client."""
        return dict(self._pending)

    def wait(self, seconds: float) -> None:
        """Wait until something has changed since the last call, at most ``seconds``."""
        self._changed.wait(seconds)
        self._changed.clear()


class AdaptiveResolution:
    """Size of frames of a moving camera, such that they take :data:`MOVING_SECONDS`.

    It follows the time of the last frames, of which only a part depends on the number of pixels.
    """

    def __init__(self) -> None:
        self._step = 1  # in DIVISORS

    def divisor(self, request: FrameRequest) -> int:
        """Return the divisor of both sides of the frame."""
        largest = max(1, min(request.width, request.height) // MIN_SIDE_PX)
        return min(DIVISORS[self._step], largest)

    def update(self, divisor: int, seconds: float) -> None:
        """Adapt to the time that a frame of a moving camera took."""
        if seconds > MOVING_SECONDS:
            self._step = min(self._step + 1, len(DIVISORS) - 1)
        elif self._step > 0:
            # With so many more pixels it would still be in time, even if all of it is for pixels.
            larger = DIVISORS[self._step - 1]
            if seconds * (divisor / larger) ** 2 < MOVING_SECONDS:
                self._step -= 1


@dataclass
class _ClientState:
    """The last frame of a client."""

    shown: PendingRequest | None = None
    divisor: int = 1
    at: float = 0.0  # by time.monotonic
    seconds: float = 0.0
    resolution: AdaptiveResolution = field(default_factory=AdaptiveResolution)


@dataclass
class RenderScheduler:
    """Renders the requests of all clients in turn."""

    requests: RenderRequests
    show: Callable[[int, FrameRequest, ViewerFrame, bool], None]  # to a client; whether it is whole
    refuse: Callable[[int, str], None]  # a client's request, for a reason of one line
    refresh_after: Callable[[float], float] | None = None
    """Seconds until a whole frame is rendered again, given those that it took; None: never."""

    _clients: dict[int, _ClientState] = field(default_factory=dict)

    def serve(self, scene: Callable[[], LiveScene]) -> bool:
        """Render the frame that is due, that of the longest waiting client; return if there is one.

        scene: called only for a frame. Only the thread that Dr.Jit runs in may call this.
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
        """Return the divisor of the frame that is due; None: none is."""
        if pending is not state.shown:
            return state.resolution.divisor(pending.request)
        if state.divisor > 1:
            # In steps, after each of which the camera may move again.
            return state.divisor // 2 if now - pending.at >= STILL_SECONDS else None
        if self.refresh_after is None:
            return None
        return 1 if now - state.at >= self.refresh_after(state.seconds) else None

    def _render(
        self, client: int, pending: PendingRequest, divisor: int, scene: Callable[[], LiveScene]
    ) -> None:
        state, request = self._clients[client], pending.request.smaller(divisor)
        is_moving = pending is not state.shown
        start = time.monotonic()
        try:
            self.show(client, request, scene().frame(request), divisor == 1)
        except Exception as error:  # a client's request must not end the fit
            text = str(error) if isinstance(error, UserError) else reason_of_mitsuba(error)
            self.refuse(client, text)
            divisor = 1  # a larger frame would fail, too
        state.shown, state.divisor, state.at = pending, divisor, time.monotonic()
        state.seconds = state.at - start
        if is_moving:
            state.resolution.update(divisor, state.seconds)
