"""The web server of a page, on this machine: viser, silenced and kept from the network.

Imported for a page only; viser is of the extra ``viewer``.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import unquote, urlsplit

import rich
import viser
import websockets.asyncio.server
from websockets.asyncio.server import Request, Response, ServerConnection

from drgs.core.errors import UserError, UserNote, one_line
from drgs.viewer.messages import MAX_MESSAGE_BYTES, PageConnection

ADDRESS = "127.0.0.1"  # only this machine reaches it

LOOPBACK = (ADDRESS, "localhost", "::1")

FIRST_PORTS = range(8080, 8100)  # tried one after the other, unless a port is given


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

    def control(uuid: str) -> Any:
        return server.gui._gui_input_handle_from_uuid.get(uuid)

    with _silent(), _guarded(address, control):
        server = LocalServer(address, port, verbose=False)
    server.get_event_loop().set_exception_handler(_note_errors_once())
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    try:
        with warnings.catch_warnings():
            # A browser may be closed while its picture is being sent.
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
def _guarded(address: str, control: Callable[[str], Any]) -> Iterator[None]:
    """Let servers that viser starts within the block serve only valid requests and messages.

    viser has no setting for it. control: see :func:`drgs.viewer.messages.is_valid`. The logger is
    silent: websockets would print a traceback for each connection that breaks.
    """
    serve = websockets.asyncio.server.serve
    connection_type = partial(PageConnection, control=control, connections=set())
    logger = logging.Logger("page", logging.CRITICAL)

    def guarded(*arguments: Any, process_request: Callable, **settings: Any) -> object:
        def process(connection: ServerConnection, request: Request) -> Response | None:
            if reason := _refusal(request, address):
                return connection.respond(HTTPStatus.FORBIDDEN, reason)
            return process_request(connection, request)

        settings |= {"create_connection": connection_type, "logger": logger}
        settings["max_size"] = MAX_MESSAGE_BYTES
        return serve(*arguments, process_request=process, **settings)

    websockets.asyncio.server.serve = guarded
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve


def _note_errors_once() -> Callable[[asyncio.AbstractEventLoop, dict[str, Any]], None]:
    """Return an event loop's exception handler that notes each type of error in one line."""
    noted = set()

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
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
