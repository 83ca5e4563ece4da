"""The image of tile, micro-tile, lane and slot: ``python docs/draw_tiles.py [--out FILE.png]``.

The documents show it as ``scenes/images/tiles.png``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drgs.io.figures import new_figure, write_figure
from drgs.splatting.grid import GRID, MICRO, MICROS, TILE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK, FAINT, TINT = "#1d2330", "#c3cad6", "#f4d9a6"
COLORS = ("#1f5fd0", "#c2452d", "#2d8a57", "#8a4fbf", "#b07a10")
"""Of the splats, front to back."""

COLUMNS, ROWS = 4, 3
"""Tiles of the film that is drawn."""

SHOWN_TILE = (1, 1)
"""Column and row of the one that is enlarged."""

SHOWN_MICRO = 10
"""Of its micro-tiles, the one that is enlarged."""

# Centre (px), half axes (px) and angle (degrees) of where each splat ends.
SPLATS = np.array(
    [
        [27, 24.5, 12, 2.7, 38],
        [19.6, 27, 2.2, 1.8, 0],
        [31.5, 20, 5.0, 1.6, -50],
        [21.5, 21, 5.8, 2.2, 70],
        [28.6, 27.4, 2.2, 3.1, 20],
    ]
)


def main() -> None:
    """Entry point of the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/tiles.png"),
        metavar="FILE.png",
        help="(default: %(default)s)",
    )
    args = parser.parse_args()
    figure = new_figure(10.6, 6.6)
    grid = figure.add_gridspec(2, 3, width_ratios=(4.1, 3, 3))
    draw_film(figure.add_subplot(grid[0, 0]))
    draw_tile(figure.add_subplot(grid[0, 1]))
    draw_micro_tile(figure.add_subplot(grid[0, 2]))
    draw_slots(figure.add_subplot(grid[1, :]))
    write_figure(args.out, figure)
    print(f"written: {args.out}")


def outline(splat: np.ndarray) -> np.ndarray:
    """(2, points) px: where a splat ends."""
    x, y, major, minor, angle = splat
    turn, t = np.radians(angle), np.linspace(0, 2 * np.pi, 200)
    along, across = major * np.cos(t), minor * np.sin(t)
    return np.array(
        [
            x + along * np.cos(turn) - across * np.sin(turn),
            y + along * np.sin(turn) + across * np.cos(turn),
        ]
    )


def covers(splat: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether points (px) lie within a splat."""
    turn = np.radians(splat[4])
    dx, dy = x - splat[0], y - splat[1]
    u = (dx * np.cos(turn) + dy * np.sin(turn)) / splat[2]
    v = (dy * np.cos(turn) - dx * np.sin(turn)) / splat[3]
    return u * u + v * v <= 1


def touched(splat: np.ndarray, left: float, top: float, size: float) -> bool:
    """Whether a splat reaches into a square of the film; size: px, of its side."""
    x, y = np.meshgrid(*(np.linspace(start, start + size, 200) for start in (left, top)))
    return bool(covers(splat, x, y).any())


def micro_corner(index: int) -> tuple[float, float]:
    """The upper left corner of a micro-tile of the enlarged tile, px."""
    return (
        SHOWN_TILE[0] * TILE + index % GRID * MICRO,
        SHOWN_TILE[1] * TILE + index // GRID * MICRO,
    )


def bits(splat: np.ndarray) -> list[bool]:
    """Which micro-tiles of the enlarged tile a splat touches."""
    return [touched(splat, *micro_corner(index), MICRO) for index in range(MICROS)]


def draw_film(axes: Axes) -> None:
    """Tiles, and the entries of the first splat."""
    title(axes, "Film: tiles of 16x16 pixels", "entry: a splat and a tile that it touches")
    for row in range(ROWS):
        for column in range(COLUMNS):
            if touched(SPLATS[0], column * TILE, row * TILE, TILE):
                square(axes, column * TILE, row * TILE, TILE, TINT)
    lines(axes, 0, 0, COLUMNS * TILE, ROWS * TILE, TILE, FAINT, 1.2)
    for splat, color in zip(SPLATS[::-1], COLORS[::-1], strict=True):
        axes.plot(*outline(splat), color=color, linewidth=1.6)
    square(axes, SHOWN_TILE[0] * TILE, SHOWN_TILE[1] * TILE, TILE, "none", INK)
    limits(axes, 0, 0, COLUMNS * TILE, ROWS * TILE)


def draw_tile(axes: Axes) -> None:
    """Micro-tiles, and the bits of the first splat's entry."""
    title(axes, "Tile: 16 micro-tiles", "the blue entry's mask has a bit for each")
    left, top = micro_corner(0)
    for index, bit in enumerate(bits(SPLATS[0])):
        x, y = micro_corner(index)
        if bit:
            square(axes, x, y, MICRO, TINT)
        axes.text(x + 0.25, y + 0.7, str(index), fontsize=6.5, color="#5c6577", va="center")
        axes.text(x + 3.6, y + 3.2, str(int(bit)), fontsize=9, color=INK, ha="right", va="center")
    lines(axes, left, top, TILE, TILE, MICRO, FAINT, 1.2)
    for splat, color in zip(SPLATS[::-1], COLORS[::-1], strict=True):
        axes.plot(*outline(splat), color=color, linewidth=1.6)
    square(axes, *micro_corner(SHOWN_MICRO), MICRO, "none", INK)
    limits(axes, left, top, TILE, TILE)


def draw_micro_tile(axes: Axes) -> None:
    """Pixels, and which of them the first splat covers."""
    title(axes, "Micro-tile: a SIMD lane", "4x4 pixels, with alpha at their centres")
    left, top = micro_corner(SHOWN_MICRO)
    lines(axes, left, top, MICRO, MICRO, 1, FAINT, 1.2)
    for splat, color in zip(SPLATS[::-1], COLORS[::-1], strict=True):
        axes.plot(*outline(splat), color=color, linewidth=1.6)
    x, y = np.meshgrid(left + np.arange(MICRO) + 0.5, top + np.arange(MICRO) + 0.5)
    inside = covers(SPLATS[0], x, y)
    axes.plot(x[inside], y[inside], "o", color=COLORS[0], markersize=5)
    axes.plot(x[~inside], y[~inside], "o", color=COLORS[0], markersize=5, fillstyle="none")
    limits(axes, left, top, MICRO, MICRO)


def draw_slots(axes: Axes) -> None:
    """The pairs of entry and micro-tile of the enlarged tile, and their slots."""
    title(
        axes,
        "Slots: one for each entry and micro-tile that it touches",
        "derivatives: each lane fills the slots of its column, each entry adds up those of its row",
    )
    masks = np.array([bits(splat) for splat in SPLATS])
    slot = 0
    for micro in range(MICROS):
        for entry in range(len(SPLATS)):
            if masks[entry, micro]:
                square(axes, micro, entry, 1, TINT)
                axes.text(micro + 0.5, entry + 0.52, str(slot), fontsize=7, ha="center",
                          va="center", color=INK)  # fmt: skip
                slot += 1
    lines(axes, 0, 0, MICROS, len(SPLATS), 1, FAINT, 1.0)
    for entry, color in enumerate(COLORS):
        axes.plot(-0.45, entry + 0.5, "o", color=color, markersize=7, clip_on=False)
    axes.text(-1.2, len(SPLATS) / 2, "entries, front to back", fontsize=8, rotation=90,
              ha="center", va="center", color=INK)  # fmt: skip
    for micro in range(MICROS):
        axes.text(micro + 0.5, -0.35, str(micro), fontsize=7, ha="center", va="center", color=INK)
    axes.text(MICROS / 2, len(SPLATS) + 0.45, "micro-tiles of the tile: a lane each", fontsize=8,
              ha="center", va="center", color=INK)  # fmt: skip
    square(axes, SHOWN_MICRO, 0, 1, "none", INK, height=len(SPLATS))
    limits(axes, -1.5, -0.8, MICROS + 1.6, len(SPLATS) + 1.6)


def title(axes: Axes, text: str, below: str) -> None:
    """Two lines above a drawing."""
    axes.set_title(f"{text}\n", fontsize=11, color=INK, loc="left")
    axes.text(0, 1.02, below, transform=axes.transAxes, fontsize=8.5, color="#5c6577")


def square(
    axes: Axes,
    x: float,
    y: float,
    size: float,
    fill: str,
    edge: str = "none",
    height: float | None = None,
) -> None:
    """A filled square, or its frame; height: if it is no square."""
    from matplotlib.patches import Rectangle

    height = size if height is None else height
    order = 3 if edge != "none" else 0
    axes.add_patch(
        Rectangle((x, y), size, height, facecolor=fill, edgecolor=edge, linewidth=2, zorder=order)
    )


def lines(
    axes: Axes,
    left: float,
    top: float,
    width: float,
    height: float,
    step: float,
    color: str,
    linewidth: float,
) -> None:
    """A grid."""
    style = {"color": color, "linewidth": linewidth, "zorder": 1}
    for x in np.arange(left, left + width + 0.5, step):
        axes.plot([x, x], [top, top + height], **style)
    for y in np.arange(top, top + height + 0.5, step):
        axes.plot([left, left + width], [y, y], **style)


def limits(axes: Axes, left: float, top: float, width: float, height: float) -> None:
    """What is shown, with y downwards as on the film."""
    margin = 0.02 * width
    axes.set(xlim=(left - margin, left + width + margin), aspect="equal")
    axes.set_ylim(top + height + margin, top - margin)
    axes.set_axis_off()


if __name__ == "__main__":
    main()
