"""Curves of a fit: loss, PSNR, population and rate over the iterations, test PSNR over time."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import rc_context

from drgs.fit.loop import History
from drgs.io.figures import new_figure, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMOOTHING_PARTS = 50  # a running mean averages this fraction of all rows
NUM_PANELS = 6


PAPER, INK, FAINT, RAW, LINE = "#ffffff", "#1d2330", "#e3e6ec", "#b9cdf0", "#1f5fd0"
"""Colours of the background, the text, the grid, single iterations and the line."""

OTHERS = "#2b8a57", "#c2543a", "#8b5cb8"  # further lines of a panel


@dataclass(frozen=True)
class Panel:
    """A curve."""

    title: str
    x: np.ndarray  # (n,)
    y: np.ndarray  # (n,)
    x_label: str = "iteration"
    scale: str = "linear"  # of y: "linear" or "log"
    bottom: float | None = None  # of y's range; None: automatic
    noisy: bool = False  # with running mean
    marked: bool = False  # with a dot per value
    thousands: bool = False  # y labels are integers with separators
    others: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)  # steps


def panels_of(history: History) -> list[Panel]:
    """Return the six curves."""

    def column(name: str) -> np.ndarray:
        return np.array([getattr(row, name) for row in history.rows], np.float64)

    x, wall_s = column("iteration"), column("wall_s")
    # Two rows may have equal times: the clock's resolution, or a resumed run.
    speed = np.diff(x) / np.maximum(np.diff(wall_s), 1e-3)
    measured = [row for row in history.rows if row.test_psnr is not None]
    minutes = np.array([row.wall_s / 60 for row in measured])
    test_psnr = np.array([row.test_psnr for row in measured])
    over_time = {"x_label": "time [min]", "marked": True}
    counted = {"bottom": 0, "thousands": True, "others": _changes_so_far(history)}
    return [
        Panel("Loss", x, column("loss"), scale="log", noisy=True),
        Panel("PSNR of the training view [dB]", x, column("psnr"), noisy=True),
        Panel("Gaussians", x, column("num_gaussians"), **counted),
        Panel("Learning rate of the means", x, column("means_lr"), scale="log"),
        Panel("Iterations per second", x[1:], speed, bottom=0, noisy=True),
        Panel("PSNR of test views [dB]", minutes, test_psnr, **over_time),
    ]


def _changes_so_far(history: History) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return iterations and cumulative numbers of changes by kind, without those of zero."""
    changes, curves = history.density, {}
    x = [0, *(change.iteration for change in changes)]
    x.append(history.rows[-1].iteration if history.rows else x[-1])
    columns = {"added": "num_added", "removed": "pruned", "relocated": "relocated"}
    for name, column in columns.items():
        y = np.cumsum([0, *(getattr(change, column) for change in changes), 0])
        if y[-1] > 0:
            curves[name] = np.array(x, np.float64), y
    return curves


def write_curves(path: Path, history: History) -> None:
    """Write an image of all curves."""
    figure = new_figure(11, 6, paper=PAPER)
    _fix_margins(figure)
    for axis, panel in zip(figure.subplots(2, 3).flat, panels_of(history), strict=True):
        _draw(axis, panel)
    write_figure(path, figure)


def draw_curve(panel: Panel) -> str:
    """Return an SVG of one panel, for the page."""
    figure, text = new_figure(3.7, 2.8, paper=PAPER), io.StringIO()
    _fix_margins(figure)
    _draw(figure.subplots(), panel)
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": panel.title}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def _fix_margins(figure: Figure) -> None:
    """Leave 0.6 inches for labels: matplotlib's layouts take as long as all else."""
    width, height = figure.get_size_inches()
    figure.set_layout_engine(None)
    figure.subplots_adjust(
        left=0.6 / width,
        right=1 - 0.2 / width,
        bottom=0.45 / height,
        top=1 - 0.35 / height,
        wspace=0.25,
        hspace=0.4,
    )


def _draw(axis: Axes, panel: Panel) -> None:
    y = panel.y
    axis.set_title(panel.title, fontsize=10, color=INK, loc="left")
    axis.set_yscale(panel.scale)
    if panel.noisy:
        axis.plot(panel.x, y, color=RAW, linewidth=0.7)
        y = _running_mean(y)
    for (name, line), color in zip(panel.others.items(), OTHERS, strict=False):
        axis.step(*line, where="post", color=color, linewidth=1.1, label=f"{name} so far")
    if panel.others:
        axis.legend(fontsize=8, frameon=False, labelcolor=INK)
    marker = {"marker": "o", "markersize": 3.5} if panel.marked else {}
    axis.plot(panel.x, y, color=LINE, linewidth=1.7, **marker)
    if panel.bottom is not None:
        axis.set_ylim(bottom=panel.bottom)
    if panel.thousands:
        axis.yaxis.set_major_formatter("{x:,.0f}")
    axis.set_xlabel(panel.x_label, fontsize=8.5, color=INK)
    axis.set_facecolor(PAPER)
    axis.grid(color=FAINT, linewidth=0.7)
    axis.tick_params(colors=INK, labelsize=8, length=0, which="both")
    axis.spines[:].set_visible(False)


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Return a centred mean over a 50th of all rows, narrower at the ends."""
    reach = len(values) // (2 * SMOOTHING_PARTS)
    total = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    first, end = np.maximum(index - reach, 0), np.minimum(index + reach + 1, len(values))
    return (total[end] - total[first]) / (end - first)
