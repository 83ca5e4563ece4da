"""The local web server of a page: viser, without console output and network access.

Imported only for a page; viser is of the extra ``viewer``. Only this machine's programs are served.
"""

from __future__ import annotations

import logging
import re
import socket
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

import rich
import viser
import websockets.asyncio.server
from typing_extensions import override
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request

from drgs.core.errors import UserError

ADDRESS = "127.0.0.1"
FIRST_PORT = 8080

HOSTS = "127.0.0.1", "localhost", "[::1]"  # names of this machine; with any port, as tunnels have
MAX_PATH = 1000  # characters


class LocalServer(viser.ViserServer):
    """A viser server that clients cannot publish."""

    @override
    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


@contextmanager
def run_server(port: int | None, option: str) -> Iterator[LocalServer]:
    """Serve an empty page within the block; port: None: first free from 8080; option: its name."""
    if port is not None:  # viser would take the next one beside one in use
        try:
            socket.create_server((ADDRESS, port)).close()
        except OSError as error:
            raise UserError(
                f"{option} {port}: cannot listen at {ADDRESS}: {error.strerror}; choose another"
            ) from None
    # They log a traceback, or thousands of lines, for a browser that leaves while it is served.
    for name in ("asyncio", "websockets.server"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with _silent(), _checked_requests():
        server = LocalServer(ADDRESS, port or FIRST_PORT, verbose=False)
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
    return f"http://{server.get_host()}:{server.get_port()}"


@contextmanager
def _checked_requests() -> Iterator[None]:
    """Let a server that is made within the block answer 400 to requests that no browser makes.

    A page of another site that reaches this machine by a name of its own (DNS rebinding) has that
    name as its host.
    """
    serve = websockets.asyncio.server.serve

    def serve_checked(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer(connection: ServerConnection, request: Request) -> Any:
            names = [re.sub(r":\d{1,5}$", "", host) for host in request.headers.get_all("Host")]
            if len(names) != 1 or names[0] not in HOSTS or len(request.path) > MAX_PATH:
                return connection.respond(HTTPStatus.BAD_REQUEST, f"the host must be {ADDRESS}\n")
            return process_request(connection, request)

        return serve(*args, process_request=answer, **options)

    websockets.asyncio.server.serve = serve_checked
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve


@contextmanager
def _silent() -> Iterator[None]:
    """Silence rich within the block: viser prints on start and stop."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
