"""How a command ends for a user's error: one line, exit status 2."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from drgs.core.errors import UserError
from drgs.core.files import why_refused
from drgs.core.llvm import LLVMVersionError
from drgs.core.memory import why_out_of_memory

USER_ERROR_STATUS = 2
"""Exit status of a command that the user has to call differently (as argparse's)."""

BROKEN_PIPE_STATUS = 141
"""As shells report a process that SIGPIPE ended: 128 + 13."""

MAX_CHARACTERS = 800
"""Of an error. Names of files may have thousands; where and what to do are at its ends."""


@contextmanager
def exit_on_user_error() -> Iterator[None]:
    """Around (or, as a decorator, on) a command: print the error without a traceback, exit with 2.

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
        text = _sentence(error)
        if text is None:
            raise
        print(f"error: {_printed(text)}", file=sys.stderr)
        sys.exit(USER_ERROR_STATUS)


def _sentence(error: Exception) -> str | None:
    """Return what to tell the user of an error; None: it is a fault of the program."""
    if isinstance(error, (UserError, LLVMVersionError)):
        return str(error)
    if (reason := why_out_of_memory(error)) is not None:
        return reason
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: {why_refused(error)}"
    if isinstance(error, ImportError) and error.name and error.name.partition(".")[0] != "drgs":
        return f"{error}, by {sys.executable}; install drgs there with all that it needs"
    return None


def _printed(text: str) -> str:
    """One line, whatever names of files hold, of which the middle is left out if it is long."""
    line = " ".join(text.splitlines())
    half = MAX_CHARACTERS // 2
    return line if len(line) <= MAX_CHARACTERS else f"{line[:half]} ... {line[-half:]}"
