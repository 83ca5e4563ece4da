"""Whose picture is rendered next, and how large: small while somebody moves, whole when still."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from drgs.core.errors import UserError, reason_of_mitsuba
from drgs.viewer.frames import Frame, FrameRequest, LiveScene
from drgs.viewer.requests import Asked, Wishes

MOVING_SECONDS = 0.08
"""That a picture may take while its camera moves: twelve of them a second look like a motion."""

STILL_SECONDS = 0.15
"""Without a request, after which a camera is still; browsers send one every 0.05 s and faster."""

DIVISORS = (1, 2, 3, 4, 6, 8)
"""Of width and height, while the camera moves."""

SMALLEST = 64
"""px: the shorter side of a moving picture, at least, where the whole one is larger."""


class Pace:
    """How small pictures are while a camera moves, so that they take :data:`MOVING_SECONDS`.

    It goes by what the last ones took: not by their number of pixels, of which only a part of the
    time depends.
    """

    def __init__(self) -> None:
        self._step = 1  # in DIVISORS

    def divisor(self, request: FrameRequest) -> int:
        """Of both sides of the picture."""
        most = max(1, min(request.width, request.height) // SMALLEST)
        return min(DIVISORS[self._step], most)

    def took(self, divisor: int, seconds: float) -> None:
        """Tell how long a picture of a moving camera took."""
        if seconds > MOVING_SECONDS:
            self._step = min(self._step + 1, len(DIVISORS) - 1)
        elif self._step > 0:
            # With so many more pixels it would still be in time, even if all of it is for pixels.
            larger = DIVISORS[self._step - 1]
            if seconds * (divisor / larger) ** 2 < MOVING_SECONDS:
                self._step -= 1


class Screen(Protocol):
    """Where pictures are shown."""

    def show(self, client: int, request: FrameRequest, frame: Frame, is_whole: bool) -> None:
        """Show a picture; is_whole: it is as large as asked for, and ``request`` is its own."""

    def refuse(self, client: int, reason: str) -> None:
        """Say in one line why there is no picture."""


@dataclass
class _Drawn:
    """What a spectator sees."""

    number: int = 0  # of the request; 0: nothing yet
    divisor: int = 1
    at: float = 0.0  # by time.monotonic
    seconds: float = 0.0
    pace: Pace = field(default_factory=Pace)


@dataclass
class Spectators:
    """Those who look on."""

    wishes: Wishes
    screen: Screen
    refreshed_after: Callable[[float], float] | None = None
    """Seconds until a whole picture is rendered again, given those that it took; None: never."""

    _drawn: dict[int, _Drawn] = field(default_factory=dict)

    def serve(self, scene: Callable[[], LiveScene]) -> bool:
        """Render the picture that is due, if there is one; of several, of who waits longest.

        scene: is called if there is. Only the thread that Dr.Jit runs in may call this.
        """
        asked, now = self.wishes.asked, time.monotonic()
        for client in set(self._drawn) - set(asked):
            del self._drawn[client]
        due = {}
        for client, wish in asked.items():
            drawn = self._drawn.setdefault(client, _Drawn())
            if (divisor := self._due(wish, drawn, now)) is not None:
                due[client] = divisor
        if not due:
            return False
        client = min(due, key=lambda each: self._drawn[each].at)
        self._serve(client, asked[client], due[client], scene)
        return True

    def _due(self, wish: Asked, drawn: _Drawn, now: float) -> int | None:
        """The divisor of the picture that is due; None: none is."""
        if wish.number != drawn.number:
            return drawn.pace.divisor(wish.request)
        if drawn.divisor > 1:
            # In steps, after each of which the camera may move again.
            return drawn.divisor // 2 if now - wish.at >= STILL_SECONDS else None
        if self.refreshed_after is None:
            return None
        return 1 if now - drawn.at >= self.refreshed_after(drawn.seconds) else None

    def _serve(
        self, client: int, wish: Asked, divisor: int, scene: Callable[[], LiveScene]
    ) -> None:
        drawn, request = self._drawn[client], wish.request.smaller(divisor)
        is_moving = wish.number != drawn.number
        start = time.monotonic()
        try:
            frame = scene().frame(request)
            self.screen.show(client, request, frame, divisor == 1)
        except Exception as error:  # a client's request must not end the fit
            text = str(error) if isinstance(error, UserError) else reason_of_mitsuba(error)
            self.screen.refuse(client, text)
            divisor = 1  # nor would a larger one be any better
        drawn.number, drawn.divisor, drawn.at = wish.number, divisor, time.monotonic()
        drawn.seconds = drawn.at - start
        if is_moving:
            drawn.pace.took(divisor, drawn.seconds)
