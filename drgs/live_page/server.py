"""The local web server of a page: viser, without console output and network access.

Imported only for a page; viser is of the extra ``viewer``. Only this machine's programs are served.
"""

from __future__ import annotations

import logging
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import rich
import viser
from typing_extensions import override

from drgs.core.errors import UserError

ADDRESS = "127.0.0.1"
FIRST_PORT = 8080


class LocalServer(viser.ViserServer):
    """A viser server that clients cannot publish."""

    @override
    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


@contextmanager
def run_server(port: int | None, option: str) -> Iterator[LocalServer]:
    """Serve an empty page within the block; port: None: first free from 8080; option: its name."""
    if port is not None:
        _check_free(port, option)
    # websockets logs a traceback for each browser that leaves while it connects.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with _silent():
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


def _check_free(port: int, option: str) -> None:
    """Raise :class:`UserError` for a port in use, beside which viser would take the next one."""
    try:
        socket.create_server((ADDRESS, port)).close()
    except OSError as error:
        raise UserError(
            f"{option} {port}: cannot listen at {ADDRESS}: {error.strerror}; choose another"
        ) from None


@contextmanager
def _silent() -> Iterator[None]:
    """Silence rich within the block: viser prints on start and stop."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
