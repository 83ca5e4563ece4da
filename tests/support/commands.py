"""Commands, run in the process of the tests: what takes seconds to start is started once."""

from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO


@dataclass(frozen=True)
class Outcome:
    """What a process would leave."""

    returncode: int
    stdout: str
    stderr: str


def run_in_process(main: Callable[[list[str]], None], *arguments: object) -> Outcome:
    """Call a command's ``main`` as its process would."""
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            main([str(argument) for argument in arguments])
            status = 0
        except SystemExit as stop:
            status = stop.code or 0
    return Outcome(status, out.getvalue(), err.getvalue())
