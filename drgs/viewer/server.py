"""The web server of a page, on this machine: viser, silenced and kept from the network.

Imported for a page only; viser is of the extra ``viewer``. All but valid requests and messages are
dropped: each class of a message has the name and the fields of one of viser's protocol.
"""

from __future__ import annotations

import asyncio
import logging
import math
import socket
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from typing import Annotated, Any, Protocol, cast
from urllib.parse import unquote, urlsplit

import msgspec
import numpy as np
import rich
import viser
import websockets.asyncio.server
from msgspec import Meta
from viser import infra
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from drgs.core.errors import UserError, UserNote, one_line

ADDRESS = "127.0.0.1"  # only this machine reaches it

LOOPBACK = (ADDRESS, "localhost", "::1")

FIRST_PORTS = range(8080, 8100)  # tried one after the other, unless a port is given


class ValueControl(Protocol):
    """A control of viser's: an input or a button."""

    @property
    def value(self) -> object:
        """The value that a browser may set."""


ControlOf = Callable[[str], ValueControl | None]
"""Returns the control with a uuid, among those that all clients share, or None."""


class LocalServer(viser.ViserServer):
    """viser's server, which clients cannot ask to publish what it shows."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Return None: there is no address outside of this machine."""
        return None


@contextmanager
def serving(address: str, port: int | None, options: tuple[str, str]) -> Iterator[LocalServer]:
    """Run a server with an empty page within the block.

    port: None for a free one. options: names of address and port on the command line.

    Raises :class:`UserError` where it cannot listen there.
    """
    port = free_port(address, port, options)

    def control(uuid: str) -> ValueControl | None:
        return server.gui._gui_input_handle_from_uuid.get(uuid)

    with _silent(), _guard_servers(address, control):
        server = LocalServer(address, port, verbose=False)
    server.get_event_loop().set_exception_handler(_note_errors_once())
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    try:
        with warnings.catch_warnings():
            # A browser may be closed while its image is being sent.
            warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
            yield server
    finally:
        with _silent():
            server.stop()


def url(server: LocalServer) -> str:
    """Return the address to open in a browser."""
    host, port = server.get_host(), server.get_port()
    if host in ("0.0.0.0", "::"):
        host = socket.gethostname()
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def free_port(address: str, port: int | None, options: tuple[str, str]) -> int:
    """Return ``port``, or a free one if that is None; see :func:`serving`.

    viser itself would wait for ever at an address that is not there.
    """
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    reason = ""
    for candidate in [port] if port is not None else [*FIRST_PORTS, 0]:
        try:
            with socket.create_server((address, candidate), family=family) as probe:
                return probe.getsockname()[1]
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
    named = f"{options[0]} {address}" if port is None else f"{options[1]} {port}"
    raise UserError(f"{named}: cannot listen at {address}: {reason}; choose another")


def is_own(headers: Mapping[str, str], address: str) -> bool:
    """Return whether a request (RFC 6455, section 4.1) comes from the page of this server.

    Browsers let any page connect to a WebSocket of this machine; ``Origin`` is that page. ``Host``
    contains a foreign name that leads to this machine: a server that only this machine reaches has
    none.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    name = urlsplit(f"//{host}").hostname
    is_here = name in (*LOOPBACK, address) or address not in LOOPBACK
    return is_here and (origin is None or urlsplit(origin).netloc == host)


def _refusal(request: Request, address: str) -> str:
    """Return why a request is refused; empty: it is not."""
    headers = request.headers
    if not is_own(headers, address):
        return "Open the address that was printed.\n"
    if ":" in unquote(request.path.partition("?")[0]):
        return "There is no such file.\n"  # Windows: a path with a drive leaves viser's folder
    protocols = headers.get_all("Sec-WebSocket-Protocol")
    if "Upgrade" in headers and protocols != [f"viser-v{viser.__version__}"]:
        return "Reload the page.\n"  # viser would print a line for each of them
    return ""


@contextmanager
def _guard_servers(address: str, control: ControlOf) -> Iterator[None]:
    """Let servers that viser starts within the block serve only valid requests and messages.

    viser has no setting for it. The logger is silent: websockets would print a traceback for each
    connection that breaks.
    """
    serve = websockets.asyncio.server.serve
    connection_type = partial(PageConnection, control=control, connections=set())
    logger = logging.Logger("page", logging.CRITICAL)

    def serve_guarded(
        *arguments: Any,
        process_request: Callable[[ServerConnection, Request], Response | None],
        **settings: Any,
    ) -> object:
        def process(connection: ServerConnection, request: Request) -> Response | None:
            if reason := _refusal(request, address):
                return connection.respond(HTTPStatus.FORBIDDEN, reason)
            return process_request(connection, request)

        settings |= {"create_connection": connection_type, "logger": logger}
        settings["max_size"] = MAX_MESSAGE_BYTES
        return serve(*arguments, process_request=process, **settings)

    websockets.asyncio.server.serve = serve_guarded
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve


def _note_errors_once() -> Callable[[asyncio.AbstractEventLoop, dict[str, object]], None]:
    """Return an event loop's exception handler that notes each type of error in one line."""
    noted = set()

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, object]) -> None:
        error = context.get("exception")
        kind = type(error).__name__
        if kind not in noted:
            noted.add(kind)
            reason = context["message"] if error is None else f"{kind}: {error}"
            warnings.warn(UserNote(f"the viewer's page: {one_line(reason)}"), stacklevel=1)

    return handle


@contextmanager
def _silent() -> Iterator[None]:
    """Silence rich within the block: viser prints its address and its end."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


# ----------------------------------------------------------------------------------------------
# Messages
# ----------------------------------------------------------------------------------------------

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


def is_valid(data: bytes | str, control: ControlOf) -> bool:
    """Return whether a message is one that a page sends, with values that the page offers."""
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


def offers(control: ValueControl | None, value: bool | float | str) -> bool:
    """Return whether a control (None: a button of one client's dialog) has a value."""
    if control is None or isinstance(control.value, bool):
        return isinstance(value, bool)
    if (options := getattr(control, "options", None)) is not None:
        return value in options
    if not hasattr(control, "min") or isinstance(value, bool | str) or not math.isfinite(value):
        return False
    low, high = (getattr(control, limit) for limit in ("min", "max"))
    return (low is None or value >= low) and (high is None or value <= high)


class PageConnection(ServerConnection):
    """A connection that yields valid messages only."""

    def __init__(
        self,
        *arguments: Any,
        control: ControlOf,
        connections: set[PageConnection],
        **settings: Any,
    ) -> None:
        """connections: the open ones of the server."""
        super().__init__(*arguments, **settings)
        self._control, self._connections = control, connections

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Close the connection at once if there are :data:`MAX_CONNECTIONS`."""
        if len(self._connections) >= MAX_CONNECTIONS:
            cast(asyncio.Transport, transport).abort()
        else:
            self._connections.add(self)
            super().connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        """Make room for another connection."""
        if self in self._connections:
            self._connections.remove(self)
            super().connection_lost(exc)

    async def recv(  # pyright: ignore[reportIncompatibleMethodOverride]  # overloads
        self, decode: bool | None = None
    ) -> bytes | str:
        """Return the next valid message."""
        while not is_valid(message := await super().recv(decode), self._control):
            pass
        return message
