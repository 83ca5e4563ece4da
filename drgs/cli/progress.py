"""Progress of a long run, on a terminal, in a notebook or in a log file."""

from __future__ import annotations

import os
import sys
import time
from contextlib import ExitStack
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

LOG_SECONDS = 10.0  # seconds between two lines where no bar can be drawn


def draws_bars(stream: TextIO) -> bool:
    """Return whether ``stream`` is a terminal that can redraw a line.

    rich's ``is_terminal`` trusts FORCE_COLOR, which notebooks and CI set. The terminal of a
    notebook's ``!`` commands cannot redraw.
    """
    variables = os.environ.get
    in_notebook = "JPY_PARENT_PID" in os.environ or "inline" in variables("MPLBACKEND", "")
    return stream.isatty() and variables("TERM") not in ("dumb", "unknown") and not in_notebook


class RunProgress:
    """A progress bar where :func:`draws_bars`; elsewhere a line every ten seconds, and the last.

    A context manager. what: name of the counted items, singular; total, done: their numbers.
    """

    def __init__(self, what: str, total: int | None = None, done: int = 0) -> None:
        self._what = what
        self._last_line = time.monotonic()
        self._first: tuple[int, float] | None = None  # (done, time) at the first update
        self._bar = None
        if draws_bars(sys.stdout):
            self._bar = Progress(
                TextColumn(what),
                MofNCompleteColumn(),
                BarColumn(),
                TextColumn("{task.fields[status]}"),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=Console(file=sys.stdout),
            )
            self._task = self._bar.add_task(what, total=total, completed=done, status="")

    def __enter__(self) -> RunProgress:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: int, total: int, status: str = "") -> None:
        """Show ``done`` of ``total``, and ``status`` beside it."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total, status=status)
            return
        now = time.monotonic()
        if self._first is None:
            self._first = done, now
        if now - self._last_line >= LOG_SECONDS or done == total:
            self._last_line = now
            parts = [f"{self._what} {done}/{total}", status, self._left(done, total, now)]
            print("  ".join(part for part in parts if part), flush=True)

    def _left(self, done: int, total: int, now: float) -> str:
        """Estimate the time left from the pace since the first update, so without compiling."""
        first, started = self._first or (done, now)
        if first == done < total:
            return ""
        seconds = int((now - started) / max(1, done - first) * (total - done))
        return f"left {seconds // 60}:{seconds % 60:02d}"


class StepProgress(ExitStack):
    """Progress of several steps, one after the other, each with a bar of its own.

    A context manager. prefix: before the names of steps.
    """

    def __init__(self, prefix: str = "") -> None:
        super().__init__()
        self._prefix, self._step, self._most = prefix, "", 0

    def update(self, step: str, done: int, total: int) -> None:
        """Show ``done`` of ``total`` in ``step``; less than before is not shown."""
        if step != self._step:
            self.close()
            self._step, self._most = step, -1
            self._shown = self.enter_context(RunProgress(f"{self._prefix}{step}", total))
        if done > self._most:
            self._most = done
            self._shown.update(done, total)
