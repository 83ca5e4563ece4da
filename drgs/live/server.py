"""The web server of a page, on this machine: viser, silenced and kept from the network.

Imported when somebody wants to look on; viser is of the extra ``viewer``.
"""

from __future__ import annotations

import socket
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import rich
import viser
import websockets.asyncio.server
from websockets.asyncio.server import Request, Response, ServerConnection

from drgs.core.errors import UserError

ADDRESS = "127.0.0.1"
"""Where only this machine reaches it."""

LOOPBACK = (ADDRESS, "localhost", "::1")

PORT = 8080
"""The first that is tried."""

PORTS = 20
"""That are tried, unless one is asked for."""


class LocalServer(viser.ViserServer):
    """viser's, which anybody's browser could otherwise ask to publish what it shows."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """No address outside of this machine."""
        del verbose
        return None


@contextmanager
def serving(address: str, port: int | None, options: tuple[str, str]) -> Iterator[LocalServer]:
    """A server within the block; its page is empty.

    port: None for the first free one from :data:`PORT` on. options: what the user calls address and
    port, for messages.

    Raises :class:`UserError` where it cannot listen there.
    """
    port = free_port(address, port, options)
    with _silent(), _own_page_only(address):
        server = LocalServer(address, port, verbose=False)
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
    """What to open in a browser."""
    host, port = server.get_host(), server.get_port()
    if host in ("0.0.0.0", "::"):
        host = socket.gethostname()
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def free_port(address: str, port: int | None, options: tuple[str, str]) -> int:
    """``port``, or a free one if that is None; see :func:`serving`.

    viser itself would wait for ever at an address that is not there.
    """
    try:
        family, kind, protocol, _, _ = socket.getaddrinfo(address, 0, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError):
        raise UserError(
            f"{options[0]}: must be an address of this machine, such as {ADDRESS}, got {address}"
        ) from None
    reason = ""
    for candidate in [port] if port is not None else [*range(PORT, PORT + PORTS), 0]:
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, candidate))
                return probe.getsockname()[1]
            except OSError as error:
                reason = error.strerror or str(error)
    named = f"{options[0]} {address}" if port is None else f"{options[1]} {port}"
    raise UserError(f"{named}: cannot listen at {address}: {reason}; choose another")


def is_own(headers: Mapping[str, str], address: str) -> bool:
    """Whether a request (RFC 6455, section 4.1) comes from the page of the server at ``address``.

    Browsers let any page connect to a WebSocket of this machine, and say in ``Origin`` which page
    that is. A name of somebody else's that leads to this machine is in ``Host``: a server that only
    this machine reaches goes by none.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    name = urlsplit(f"//{host}").hostname
    is_here = name in (*LOOPBACK, address) or address not in LOOPBACK
    return is_here and (origin is None or urlsplit(origin).netloc == host)


@contextmanager
def _own_page_only(address: str) -> Iterator[None]:
    """Within the block, servers that viser starts refuse what :func:`is_own` says no to.

    viser has no setting for it.
    """
    serve = websockets.asyncio.server.serve

    def guarded(*arguments: Any, process_request: Callable, **settings: Any) -> object:
        def process(connection: ServerConnection, request: Request) -> Response | None:
            if is_own(request.headers, address):
                return process_request(connection, request)
            return connection.respond(HTTPStatus.FORBIDDEN, "Open the address that was printed.\n")

        return serve(*arguments, process_request=process, **settings)

    websockets.asyncio.server.serve = guarded
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve


@contextmanager
def _silent() -> Iterator[None]:
    """Within the block, nothing is printed by rich: viser frames where it listens, and its end."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
