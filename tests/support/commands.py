"""Commands, run in the process of the tests: what takes seconds to start is started once."""

import signal
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from subprocess import CompletedProcess

from support.folders import contents


def run_in_process(main: Callable[[list[str]], None], *arguments: object) -> CompletedProcess[str]:
    """Call a command's ``main`` as its process would."""
    out, err = StringIO(), StringIO()
    # The handler of a new process; a command stopped by Ctrl-C removes it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with redirect_stdout(out), redirect_stderr(err):
        try:
            main([str(argument) for argument in arguments])
            status = 0
        except SystemExit as stop:
            status = stop.code or 0
    return CompletedProcess(arguments, status, out.getvalue(), err.getvalue())


def assert_ends_well(
    main: Callable[[list[str]], None], *arguments: object
) -> CompletedProcess[str]:
    """With status 0."""
    outcome = run_in_process(main, *arguments)
    assert outcome.returncode == 0, outcome.stderr
    return outcome


def assert_refused(
    main: Callable[[list[str]], None], *arguments: object, folder: Path, message: str
) -> str:
    """With status 2, in one line that holds ``message``, and every file of ``folder`` as it was.

    Returns the line.
    """
    before = contents(folder)
    outcome = run_in_process(main, *arguments)
    assert outcome.returncode == 2, outcome.stdout + outcome.stderr
    (line,) = outcome.stderr.splitlines()
    assert line.startswith("error: ") and message in line, line
    assert len(line) < 1000
    assert contents(folder) == before
    return line
