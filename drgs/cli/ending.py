"""The end and the output of a command: a user's error, Ctrl-C, SIGTERM; notes; any encoding."""

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
from typing import NoReturn, TextIO

from drgs.core.errors import UserError, UserNote
from drgs.core.files import refusal_reason
from drgs.core.llvm import LLVMVersionError
from drgs.core.memory import out_of_memory_reason
from drgs.core.processes import process_number

USER_ERROR_STATUS = 2
"""Exit status of a command that the user has to call differently (as argparse's)."""

INTERRUPTED_STATUS = 130
"""Exit status of a command that was stopped by Ctrl-C: 128 + SIGINT, as shells report it."""

BROKEN_PIPE_STATUS = 141  # the same for SIGPIPE

TERMINATED_STATUS = 143  # the same for SIGTERM, as ``kill``, ``timeout`` and batch systems send it

MAX_ERROR_CHARACTERS = 800
"""Names of files may have thousands; where and what to do are at an error's ends."""


@contextmanager
def exit_on_user_error() -> Iterator[None]:
    """Print an error of the block, or of the decorated command, in a line, and exit with 2.

    Only errors that the user can repair, packages that cannot be imported, exhausted memory, and
    what the file system refuses of a file that it names; any other keeps its traceback. Where
    nobody reads the output any more, as behind ``| head``, it ends without a word.
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
    """Return the message for the user; None: the error is a fault of the program."""
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
    """SIGTERM has arrived: files that are half written are removed, as after Ctrl-C."""


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """End the block on Ctrl-C with status 130, on SIGTERM with 143, without a traceback.

    Not SIGTERM where it is one of several processes: with it, ``mpiexec`` ends those that wait.
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
        _exit_interrupted(cause)
    finally:
        if is_taken:
            signal.signal(signal.SIGTERM, previous)


@contextmanager
def interruptible_imports() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the process at once while the block imports.

    Extension modules may abort, or hide what was raised, where it is raised while they are
    imported. To be used where nothing is being written.
    """
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
    """Return the interrupt, if there is one: Dr.Jit raises errors of its own for one."""
    causes: list[BaseException] = []
    while error is not None and error not in causes:
        if isinstance(error, KeyboardInterrupt):
            return error
        causes.append(error)
        error = error.__cause__ or error.__context__
    return None


def _exit_interrupted(interrupt: KeyboardInterrupt) -> NoReturn:
    for number in (signal.SIGINT, signal.SIGTERM):  # a further one is no error of the clean-up
        signal.signal(number, signal.SIG_DFL)
    # Where it came within one, as dataclasses use them, CPython ends by SIGINT: this forgets it.
    exec("")
    is_terminated = isinstance(interrupt, Terminated)
    print("terminated" if is_terminated else "interrupted", file=sys.stderr)
    sys.exit(TERMINATED_STATUS if is_terminated else INTERRUPTED_STATUS)


@contextmanager
def printable_anywhere() -> Iterator[None]:
    """Print escaped, within the block, what the standard streams' encoding cannot express.

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
    """Print each :class:`UserNote` of the block as a line; leave out Pillow's warnings."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def show_plainly(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, UserNote):
                print(f"note: {message}", flush=True)
            else:
                show(message, category, filename, lineno, file, line)

        warnings.showwarning = show_plainly
        warnings.simplefilter("always", UserNote)
        warnings.filterwarnings("ignore", module=r"PIL\.")
        yield
