"""What a command prints: any name in any encoding, and notes without Python's decoration."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper

from drgs.core.errors import UserNote


@contextmanager
def printable_anywhere() -> Iterator[None]:
    """Within the block, what the standard streams' encoding cannot express is printed escaped.

    Names of files may be no UTF-8, and a terminal may know nothing but ASCII: neither is a reason
    to end a fit.
    """
    streams = [s for s in (sys.stdout, sys.stderr) if isinstance(s, TextIOWrapper)]
    before = [stream.errors for stream in streams]
    for stream in streams:
        stream.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        for stream, errors in zip(streams, before, strict=True):
            with suppress(OSError, ValueError):  # the reader has gone, or the stream was closed
                stream.reconfigure(errors=errors)


@contextmanager
def notes_printed() -> Iterator[None]:
    """Within the block, each :class:`UserNote` is a line of the output.

    What Pillow has to note about a file is not: what it cannot read is an error of ours.
    """
    with warnings.catch_warnings():
        show = warnings.showwarning

        def show_plainly(
            message: Warning | str, category: type[Warning], *where: object, **options: object
        ) -> None:
            if issubclass(category, UserNote):
                print(f"note: {message}", flush=True)
            else:
                show(message, category, *where, **options)

        warnings.showwarning = show_plainly
        warnings.simplefilter("always", UserNote)
        warnings.filterwarnings("ignore", module=r"PIL\.")
        yield
