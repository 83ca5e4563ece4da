"""Validation of the messages that browsers send to a page; all other messages are dropped.

Each class has the name and the fields of a message of viser's protocol.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from viser import infra
from websockets.asyncio.server import ServerConnection

if TYPE_CHECKING:
    import asyncio

MAX_MESSAGE_BYTES = 1 << 16  # a page's own messages have less than 1 KB
MAX_CONNECTIONS = 64  # at a time: file descriptors remain for the command itself

Coordinate = Annotated[float, Meta(ge=-1e15, le=1e15)]
"""Squares are finite in single precision. A NaN passes, and is checked for below."""

Side = Annotated[float, Meta(ge=0, le=100_000)]  # px

Vector = tuple[Coordinate, Coordinate, Coordinate]


class ViewerCameraMessage(msgspec.Struct, tag=True, tag_field="type"):
    """A browser's camera."""

    wxyz: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    position: Vector
    look_at: Vector
    up_direction: Vector
    fov: Coordinate
    near: Coordinate
    far: Coordinate
    image_height: Side
    image_width: Side


class SceneNodeClickMessage(msgspec.Struct, tag=True, tag_field="type"):
    """A click on a training camera; viser ignores an unknown name."""

    name: str
    instance_index: int | None
    ray_origin: Vector
    ray_direction: Vector
    screen_pos: tuple[Coordinate, Coordinate]
    modifier: str | None
    owner: str = ""


class NewValue(msgspec.Struct, forbid_unknown_fields=True):
    """The only property of a control that a browser may set."""

    value: bool | int | float | str


class GuiUpdateMessage(msgspec.Struct, tag=True, tag_field="type"):
    """The value of a control, or a pressed button."""

    uuid: str
    updates: NewValue


DECODER = msgspec.msgpack.Decoder(ViewerCameraMessage | SceneNodeClickMessage | GuiUpdateMessage)


def is_valid(data: bytes | str, control: Callable[[str], Any]) -> bool:
    """Return whether a message is one that a page sends, with values that the page offers.

    control: returns the control with a uuid, among those that all clients share, or None.
    """
    if not isinstance(data, bytes):
        return False
    try:
        message = DECODER.decode(data)
        infra.Message.deserialize(data)  # where it raises, viser would end the connection
    except (msgspec.MsgspecError, ValueError, RecursionError, KeyError, TypeError):
        return False
    if isinstance(message, GuiUpdateMessage):
        return offers(control(message.uuid), message.updates.value)
    if isinstance(message, ViewerCameraMessage):
        numbers = np.hstack(msgspec.structs.astuple(message))
        return bool(np.isfinite(numbers).all()) and 0.9 < math.hypot(*message.wxyz) < 1.1
    return True


def offers(control: Any, value: bool | float | str) -> bool:
    """Return whether a control of viser's (None: a button of one client's dialog) has a value."""
    if control is None or isinstance(control.value, bool):
        return isinstance(value, bool)
    if hasattr(control, "options"):
        return value in control.options
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not hasattr(control, "min") or not is_number or not math.isfinite(value):
        return False
    low, high = control.min, control.max
    return (low is None or value >= low) and (high is None or value <= high)


class PageConnection(ServerConnection):
    """A connection that yields valid messages only."""

    def __init__(
        self,
        *arguments: Any,
        control: Callable[[str], Any],
        connections: set[PageConnection],
        **settings: Any,
    ) -> None:
        """control: see :func:`is_valid`; connections: the open ones of the server."""
        super().__init__(*arguments, **settings)
        self._control, self._connections = control, connections

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Close the connection at once if there are :data:`MAX_CONNECTIONS`."""
        if len(self._connections) >= MAX_CONNECTIONS:
            transport.abort()
        else:
            self._connections.add(self)
            super().connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        """Make room for another connection."""
        if self in self._connections:
            self._connections.remove(self)
            super().connection_lost(exc)

    async def recv(self, decode: bool | None = None) -> bytes | str:
        """Return the next valid message."""
        while not is_valid(message := await super().recv(decode), self._control):
            pass
        return message
