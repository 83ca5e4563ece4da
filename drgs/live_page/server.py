"""The local web server of a page: viser, without console output and network access.

Imported only for a page; the extra ``viewer`` installs viser. Invalid requests and messages are
dropped: each message class mirrors the name and fields of one in viser's protocol.
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
from typing import Annotated, Any, cast
from urllib.parse import unquote, urlsplit

import msgspec
import numpy as np
import rich
import viser
import websockets.asyncio.server
from msgspec import Meta
from typing_extensions import override
from viser import infra
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from drgs.core.errors import UserError, UserNote, one_line

ADDRESS = "127.0.0.1"
LOOPBACK = (ADDRESS, "localhost", "::1")
DEFAULT_PORTS = range(8080, 8100)  # tried in order


Control = viser.GuiInputHandle[Any] | viser.GuiButtonHandle

FindControl = Callable[[str], Control | None]
"""Returns the control with a uuid that all clients share, or None."""


class LocalServer(viser.ViserServer):
    """A viser server that clients cannot publish."""

    @override
    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


@contextmanager
def run_server(address: str, port: int | None, options: tuple[str, str]) -> Iterator[LocalServer]:
    """Run a server with an empty page within the block.

    port: None for a free one. options: names of address and port on the command line.

    Raises :class:`UserError` if it cannot listen there.
    """
    port = free_port(address, port, options)

    def control(uuid: str) -> Control | None:
        return cast(Control | None, server.gui._gui_input_handle_from_uuid.get(uuid))

    with _silent(), _guard_servers(address, control):
        server = LocalServer(address, port, verbose=False)
    server.get_event_loop().set_exception_handler(_note_errors_once())
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    try:
        with warnings.catch_warnings():
            # A browser may close while receiving an image.
            warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
            yield server
    finally:
        with _silent():
            server.stop()


def url(server: LocalServer) -> str:
    """Return the page's URL."""
    host, port = server.get_host(), server.get_port()
    if host in ("0.0.0.0", "::"):
        host = socket.gethostname()
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def free_port(address: str, port: int | None, options: tuple[str, str]) -> int:
    """Return ``port``, or a free one if None; see :func:`serving`.

    viser itself waits forever at an address that does not exist.
    """
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    reason = ""
    for candidate in [port] if port is not None else [*DEFAULT_PORTS, 0]:
        try:
            with socket.create_server((address, candidate), family=family) as probe:
                return probe.getsockname()[1]
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
    named = f"{options[0]} {address}" if port is None else f"{options[1]} {port}"
    raise UserError(f"{named}: cannot listen at {address}: {reason}; choose another")


def is_same_origin(headers: Mapping[str, str], address: str) -> bool:
    """Return whether a request (RFC 6455, section 4.1) comes from this server's page.

    Browsers let any page connect to a local WebSocket and send that page's ``Origin``. A foreign
    name in ``Host`` that resolves to this machine (DNS rebinding) is rejected on loopback.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    name = urlsplit(f"//{host}").hostname
    is_here = name in (*LOOPBACK, address) or address not in LOOPBACK
    return is_here and (origin is None or urlsplit(origin).netloc == host)


def _refusal(request: Request, address: str) -> str:
    """Return the reason for refusing a request; empty: valid."""
    headers = request.headers
    if not is_same_origin(headers, address):
        return "Open the address that was printed.\n"
    if ":" in unquote(request.path.partition("?")[0]):
        return "There is no such file.\n"  # on Windows, a drive letter escapes viser's folder
    protocols = headers.get_all("Sec-WebSocket-Protocol")
    if "Upgrade" in headers and protocols != [f"viser-v{viser.__version__}"]:
        return "Reload the page.\n"  # viser prints a line for each
    return ""


@contextmanager
def _guard_servers(address: str, control: FindControl) -> Iterator[None]:
    """Restrict servers that viser starts within the block to valid requests and messages.

    The logger is silent: websockets prints a traceback for each broken connection.
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
    """Return an exception handler for an event loop that warns once of each type of error."""
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
    """Silence rich within the block: viser prints on start and stop."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


# ----------------------------------------------------------------------------------------------
# Messages
# ----------------------------------------------------------------------------------------------

MAX_MESSAGE_BYTES = 1 << 16  # valid messages have less than 1 KB
MAX_CONNECTIONS = 64  # simultaneous; leaves file descriptors for the command

# Squares are finite in single precision; is_valid() rejects NaN.
Coordinate = Annotated[float, Meta(ge=-1e15, le=1e15)]
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
    """The property of a control that a browser may set."""

    value: bool | int | float | str


class GuiUpdateMessage(msgspec.Struct, tag=True, tag_field="type"):
    """A changed control or a pressed button."""

    uuid: str
    updates: NewValue


DECODER = msgspec.msgpack.Decoder(ViewerCameraMessage | SceneNodeClickMessage | GuiUpdateMessage)


def is_valid(data: bytes | str, control: FindControl) -> bool:
    """Return whether the page can send a message with these values."""
    if not isinstance(data, bytes):
        return False
    try:
        message = DECODER.decode(data)
        infra.Message.deserialize(data)  # an error in viser would end the connection
    except (msgspec.MsgspecError, ValueError, RecursionError, KeyError, TypeError):
        return False
    if isinstance(message, GuiUpdateMessage):
        return accepts_value(control(message.uuid), message.updates.value)
    if isinstance(message, ViewerCameraMessage):
        numbers = np.hstack(msgspec.structs.astuple(message))
        return bool(np.isfinite(numbers).all()) and 0.9 < math.hypot(*message.wxyz) < 1.1
    return True


def accepts_value(control: Control | None, value: bool | float | str) -> bool:
    """Return whether a control (None: a button in one client's dialog) accepts a value."""
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
        control: FindControl,
        connections: set[PageConnection],
        **settings: Any,
    ) -> None:
        super().__init__(*arguments, **settings)
        self._control, self._connections = control, connections

    @override
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Abort connections beyond :data:`MAX_CONNECTIONS`."""
        if len(self._connections) >= MAX_CONNECTIONS:
            cast(asyncio.Transport, transport).abort()
        else:
            self._connections.add(self)
            super().connection_made(transport)

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        if self in self._connections:
            self._connections.remove(self)
            super().connection_lost(exc)

    @override
    async def recv(  # pyright: ignore[reportIncompatibleMethodOverride]  # overloads
        self, decode: bool | None = None
    ) -> bytes | str:
        while not is_valid(message := await super().recv(decode), self._control):
            pass
        return message
