"""Progress of a long run, on a terminal and in a log file."""

from __future__ import annotations

import sys
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

LOG_SECONDS = 10.0
"""Seconds between two lines where there is no terminal."""


class FitProgress:
    """A progress bar on a terminal; elsewhere a line every ten seconds.

    A context manager: leaving it restores the terminal.
    """

    def __init__(self, total: int) -> None:
        self._started = self._last_line = time.monotonic()
        self._first: int | None = None
        self._bar = None
        console = Console(file=sys.stdout)
        if console.is_terminal:
            self._bar = Progress(
                TextColumn("iteration"),
                MofNCompleteColumn(),
                BarColumn(),
                TextColumn("{task.fields[status]}"),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=console,
            )
            self._task = self._bar.add_task("fit", total=total, status="")

    def __enter__(self) -> FitProgress:
        """Start drawing."""
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop drawing."""
        if self._bar is not None:
            self._bar.stop()

    def update(
        self, iteration: int, total: int, loss: float, psnr: float, num_gaussians: int
    ) -> None:
        """Show where the fit is; psnr: dB, smoothed over recent training views."""
        status = f"loss {loss:.4f}  PSNR {psnr:5.2f} dB  Gaussians {num_gaussians:,}"
        if self._bar is not None:
            self._bar.update(self._task, completed=iteration, total=total, status=status)
            return
        now = time.monotonic()
        if self._first is None:
            self._first, self._started = iteration, now
        if now - self._last_line >= LOG_SECONDS or iteration == total:
            self._last_line = now
            done = max(1, iteration - self._first)
            left = (now - self._started) / done * (total - iteration)
            print(f"iteration {iteration}/{total}  {status}  left {_minutes(left)}", flush=True)


def _minutes(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
