"""Run a function in a child process: for libraries that ignore Ctrl-C, or that may abort."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import IO, TypeVar

import psutil

from drgs.core.errors import UserError, one_line

Result = TypeVar("Result")


class ChildEndedError(RuntimeError):
    """A signal ended the child; the message has its name and the child's last output."""


def run_in_child(
    function: Callable[..., Result],
    *arguments: object,
    watch: Callable[..., None],
    seconds: float | None = None,
    memory: int | None = None,
) -> Result:
    """Return ``function(*arguments, report)``, called in a new process.

    function, arguments: can be pickled. watch: called here with the arguments of the child's
    ``report``. seconds, memory (bytes): the most that the call may take, where the system has such
    limits. Ctrl-C does not reach the child, which ends with this call or this process.

    Raises the child's :class:`UserError` or OSError, :class:`ChildEndedError` after a signal, and
    RuntimeError with the child's traceback for other errors.
    """
    # Not -m, which would look for modules in the current folder first.
    code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; serve()"
    pipe = subprocess.PIPE
    with tempfile.TemporaryFile() as stderr:
        child = subprocess.Popen(
            [sys.executable, "-c", code], stdin=pipe, stdout=pipe, stderr=stderr,
            start_new_session=True,
        )  # fmt: skip
        assert child.stdin is not None and child.stdout is not None, "both are pipes"
        clock = threading.Timer(seconds or 0, child.kill)
        try:
            if seconds is not None:
                clock.start()
            with suppress(BrokenPipeError):  # it has ended: see below
                _send(child.stdin, (function, arguments, memory))
            while True:
                kind, content = pickle.load(child.stdout)
                if kind == "result":
                    return content
                if kind == "error":
                    raise content
                watch(*content)
        except (EOFError, pickle.UnpicklingError):  # at its end, or within a message
            status = child.wait()
            stderr.seek(0)
            text = stderr.read().decode(errors="replace")
        finally:
            is_late = seconds is not None and clock.finished.is_set()
            clock.cancel()
            child.kill()
            with suppress(BrokenPipeError):
                child.communicate()
    if is_late:
        raise ChildEndedError(f"it took longer than {seconds:.0f} s")
    if status < 0:
        text = text.partition("***")[0]  # where glog's stack trace begins
        name = signal.Signals(-status).name
        raise ChildEndedError(": ".join(filter(None, (name, one_line(text)))))
    raise RuntimeError(f"the child process ended with status {status}:\n{text}")


def serve() -> None:
    """Run the call of :func:`run_in_child` in the child."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # libraries may print
    function, arguments, memory = pickle.load(sys.stdin.buffer)
    if memory is not None:
        with suppress(ImportError, OSError, ValueError):  # Windows; a lower limit of the user's
            import resource

            most = psutil.Process().memory_info().vms + memory
            resource.setrlimit(resource.RLIMIT_AS, (most, most))

    def end_with_parent() -> None:
        os.read(sys.stdin.fileno(), 1)  # until the parent, which holds the input open, ends
        os._exit(1)

    def report(*content: object) -> None:
        _send(answers, ("report", content))

    threading.Thread(target=end_with_parent, daemon=True).start()

    try:
        answer = "result", function(*arguments, report)
    except (UserError, OSError) as error:
        answer = "error", error
    _send(answers, answer)
    os._exit(0)  # without waiting for what the library does at its end


def _send(stream: IO[bytes], message: object) -> None:
    stream.write(pickle.dumps(message))
    stream.flush()
