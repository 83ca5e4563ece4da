"""Exit and output of commands: user errors, Ctrl-C, SIGTERM, notes, encodings."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from types import FrameType
from typing import Any

from drgs.core.errors import UserError, UserNote
from drgs.core.files import refusal_reason
from drgs.core.llvm import LLVMVersionError
from drgs.core.memory import out_of_memory_reason
from drgs.core.processes import process_number

# Exit statuses: argparse's for errors of the user; shells' 128 + signal.
USER_ERROR_STATUS = 2
INTERRUPTED_STATUS = 130
BROKEN_PIPE_STATUS = 141
TERMINATED_STATUS = 143

MAX_ERROR_CHARACTERS = 800  # place and remedy are at an error's ends; file names may be long


@contextmanager
def exit_on_user_error() -> Iterator[None]:
    """Print an error of the block in one line, and exit with status 2.

    Only user errors, missing packages, exhausted memory and OSErrors with a file; others keep their
    traceback. Exit silently when the output is closed, as by ``| head``.
    """
    try:
        yield
    except BrokenPipeError:
        with suppress(OSError, ValueError):  # or Python would fail again when it ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(BROKEN_PIPE_STATUS)
    except Exception as error:
        text = _user_message(error)
        if text is None:
            raise
        line, half = " ".join(text.splitlines()), MAX_ERROR_CHARACTERS // 2
        if len(line) > MAX_ERROR_CHARACTERS:
            line = f"{line[:half]} ... {line[-half:]}"
        print(f"error: {line}", file=sys.stderr)
        sys.exit(USER_ERROR_STATUS)


def _user_message(error: Exception) -> str | None:
    """Return the message for the user; None for a defect of the program."""
    if isinstance(error, (UserError, LLVMVersionError)):
        return str(error)
    if (reason := out_of_memory_reason(error)) is not None:
        return reason
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: {refusal_reason(error)}"
    if isinstance(error, ImportError) and error.name and error.name.partition(".")[0] != "drgs":
        return f"{error}, by {sys.executable}; install drgs there with all that it needs"
    return None


class StopRequest:
    """A context manager within which the first Ctrl-C only sets ``requested``.

    A second one ends the program at once, as usual.
    """

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> StopRequest:
        self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *error: object) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        signal.signal(signal.SIGINT, self._previous)


class Terminated(KeyboardInterrupt):
    """SIGTERM, raised so that half-written files are removed as after Ctrl-C."""


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Exit on Ctrl-C with status 130, on SIGTERM with 143, without a traceback.

    SIGTERM stays unhandled in processes of ``mpiexec``, which ends waiting ones by it.
    """
    previous = signal.getsignal(signal.SIGTERM)
    is_main = threading.current_thread() is threading.main_thread()  # others have no signals
    is_taken = is_main and previous == signal.SIG_DFL and process_number() is None
    try:
        if is_taken:
            signal.signal(signal.SIGTERM, _terminate)
        yield
    except (Exception, KeyboardInterrupt) as error:
        if (cause := _interrupt_after(error)) is None:
            raise
        for number in (signal.SIGINT, signal.SIGTERM):  # a second one ends the clean-up silently
            signal.signal(number, signal.SIG_DFL)
        # After an interrupt within exec() (dataclasses), CPython exits by SIGINT: clear that.
        exec("")
        is_terminated = isinstance(cause, Terminated)
        print("terminated" if is_terminated else "interrupted", file=sys.stderr)
        sys.exit(TERMINATED_STATUS if is_terminated else INTERRUPTED_STATUS)
    finally:
        if is_taken:
            signal.signal(signal.SIGTERM, previous)


@contextmanager
def interruptible_imports() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the process at once: imports may abort on, or hide, interrupts."""
    handlers = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: _terminate}
    taken = {n: h for n, h in handlers.items() if signal.getsignal(n) == h}
    if threading.current_thread() is not threading.main_thread():
        taken = {}
    try:
        for number in taken:
            signal.signal(number, _end_at_once)
        yield
    finally:
        for number, handler in taken.items():
            signal.signal(number, handler)


def _end_at_once(number: int, frame: FrameType | None) -> None:
    os.write(2, b"interrupted\n" if number == signal.SIGINT else b"terminated\n")
    os._exit(INTERRUPTED_STATUS if number == signal.SIGINT else TERMINATED_STATUS)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


def _interrupt_after(error: BaseException | None) -> KeyboardInterrupt | None:
    """Return the interrupt among an error's causes: Dr.Jit wraps it in an error of its own."""
    causes: list[BaseException] = []
    while error is not None and error not in causes:
        if isinstance(error, KeyboardInterrupt):
            return error
        causes.append(error)
        error = error.__cause__ or error.__context__
    return None


def escape_unencodable() -> None:
    """Escape characters that the standard streams' encoding lacks from now on."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


@contextmanager
def print_notes() -> Iterator[None]:
    """Print each :class:`UserNote` of the block as a line; ignore Pillow's warnings."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def show_plainly(message: Warning | str, category: type[Warning], *place: Any) -> None:
            if issubclass(category, UserNote):
                print(f"note: {message}", flush=True)
            else:
                show(message, category, *place)

        warnings.showwarning = show_plainly
        warnings.simplefilter("always", UserNote)
        warnings.filterwarnings("ignore", module=r"PIL\.")
        yield
