"""Progress of ``fit`` and ``capture``: lines in a log file, a bar on a terminal."""

import io
import sys

import pytest

from drgs.cli import progress
from drgs.cli.progress import LOG_SECONDS, RunProgress


@pytest.fixture
def clock(monkeypatch):
    """The time of day, in seconds, that the module sees; set it by ``clock[0] = ...``."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_log_file_gets_a_line_every_ten_seconds_and_the_last(clock, capsys):
    with RunProgress("image", 25) as shown:
        for done in range(1, 26):
            clock[0] += 1.0
            shown.update(done, 25)
    expected = ["image 10/25  left 0:15", "image 20/25  left 0:05", "image 25/25  left 0:00"]
    assert capsys.readouterr().out.splitlines() == expected


def test_pace_is_measured_since_the_first_update(clock, capsys):
    """Work done before the start takes no time, compiling is no iteration, totals may change."""
    with RunProgress("iteration", 1000, done=400) as shown:
        clock[0] += 60.0
        shown.update(401, 1000, "loss 0.1")
        clock[0] += LOG_SECONDS
        shown.update(501, 1000, "loss 0.05")
        clock[0] += LOG_SECONDS
        shown.update(601, 801)
    assert capsys.readouterr().out.splitlines() == [
        "iteration 401/1000  loss 0.1",  # no pace is known yet
        "iteration 501/1000  loss 0.05  left 0:49",
        "iteration 601/801  left 0:20",
    ]


@pytest.mark.parametrize(
    ("is_terminal", "variables"),
    [
        (True, {}),
        (True, {"JPY_PARENT_PID": "17", "TERM": "xterm-color", "FORCE_COLOR": "1"}),
        (True, {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}),
        (True, {"TERM": "dumb"}),
        (False, {"FORCE_COLOR": "1"}),
        (False, {"TTY_COMPATIBLE": "1"}),
    ],
)
def test_terminals_get_a_bar_and_notebooks_and_logs_lines(monkeypatch, is_terminal, variables):
    stream = io.StringIO()
    stream.isatty = lambda: is_terminal
    monkeypatch.setattr(sys, "stdout", stream)
    for name in ("JPY_PARENT_PID", "MPLBACKEND", "FORCE_COLOR", "NO_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in {"TERM": "xterm", "COLUMNS": "100", **variables}.items():
        monkeypatch.setenv(name, value)
    with RunProgress("image", 3) as shown:
        shown.update(2, 3, "loss 0.1")
        shown.update(3, 3, "loss 0.05")
    written = stream.getvalue()
    if is_terminal and not variables:
        for part in ("image", "3/3", "loss 0.05", "\x1b["):
            assert part in written
    else:
        assert written == "image 3/3  loss 0.05  left 0:00\n"
