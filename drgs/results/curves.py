"""Curves of a fit: loss, PSNR, population and rate over the iterations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from drgs.io.figures import new_figure, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMOOTHING_PARTS = 50
"""The smooth line of a curve is a running mean over this part of all rows."""


class CurvePoint(Protocol):
    """What the curves show of an iteration: a row of ``history.csv``."""

    @property
    def iteration(self) -> int:
        """The first is 1."""

    @property
    def loss(self) -> float:
        """Of the training view."""

    @property
    def psnr(self) -> float:
        """Of the training view, dB."""

    @property
    def num_gaussians(self) -> int:
        """N."""

    @property
    def means_lr(self) -> float:
        """The learning rate of the means, world units."""

    @property
    def wall_s(self) -> float:
        """Seconds spent so far."""


def write_curves(path: Path, history: Sequence[CurvePoint]) -> None:
    """Write a picture of the loss, the PSNR, the population and the rates over the iterations."""
    write_figure(path, draw_curves(history, LIGHT))


@dataclass(frozen=True)
class Theme:
    """Colours of the curves."""

    paper: str
    ink: str
    faint: str
    raw: str  # single iterations
    line: str


LIGHT = Theme(paper="#ffffff", ink="#1d2330", faint="#e3e6ec", raw="#b9cdf0", line="#1f5fd0")


DARK = Theme(paper="#1a1e27", ink="#d8dde8", faint="#333a48", raw="#34507f", line="#7fb0ff")


THEMES = (LIGHT, DARK)


@dataclass(frozen=True)
class Panel:
    """One curve."""

    title: str
    x: np.ndarray  # (n,) iterations
    y: np.ndarray  # (n,)
    scale: str = "linear"  # of y: "linear" or "log"
    bottom: float | None = None  # of y's range; None: as the values have it
    noisy: bool = False  # drawn with its running mean


def _panels(history: Sequence[CurvePoint]) -> list[Panel]:
    def column(name: str) -> np.ndarray:
        return np.array([getattr(row, name) for row in history], np.float64)

    x, wall_s = column("iteration"), column("wall_s")
    # Two rows may carry one time: the clock's resolution, or a run that was resumed.
    speed = np.diff(x) / np.maximum(np.diff(wall_s), 1e-3)
    return [
        Panel("Loss", x, column("loss"), scale="log", noisy=True),
        Panel("PSNR of the training view [dB]", x, column("psnr"), noisy=True),
        Panel("Gaussians", x, column("num_gaussians"), bottom=0),
        Panel("Learning rate of the means", x, column("means_lr"), scale="log"),
        Panel("Iterations per second", x[1:], speed, bottom=0, noisy=True),
        Panel("Time [min]", x, wall_s / 60, bottom=0),
    ]


def draw_curves(history: Sequence[CurvePoint], theme: Theme) -> Figure:
    """A matplotlib figure of six panels over the iterations."""
    figure = new_figure(11, 5.8, paper=theme.paper)
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.1)
    axes = figure.subplots(2, 3)
    for axis, panel in zip(axes.flat, _panels(history), strict=True):
        _draw(axis, panel, theme)
    axes[0, 2].yaxis.set_major_formatter("{x:,.0f}")
    for axis in axes[-1]:
        axis.set_xlabel("iteration", fontsize=8.5, color=theme.ink)
    return figure


def _draw(axis: Axes, panel: Panel, theme: Theme) -> None:
    y = panel.y
    axis.set_title(panel.title, fontsize=10, color=theme.ink, loc="left")
    axis.set_yscale(panel.scale)
    if panel.noisy:
        axis.plot(panel.x, y, color=theme.raw, linewidth=0.7)
        y = _running_mean(y)
    axis.plot(panel.x, y, color=theme.line, linewidth=1.7)
    if panel.bottom is not None:
        axis.set_ylim(bottom=panel.bottom)
    axis.set_facecolor(theme.paper)
    axis.grid(color=theme.faint, linewidth=0.7)
    axis.tick_params(colors=theme.ink, labelsize=8, length=0, which="both")
    axis.spines[:].set_visible(False)


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Centred, over a 50th of all rows; narrower at the ends."""
    reach = len(values) // (2 * SMOOTHING_PARTS)
    total = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    first, end = np.maximum(index - reach, 0), np.minimum(index + reach + 1, len(values))
    return (total[end] - total[first]) / (end - first)
