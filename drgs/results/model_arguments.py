"""Arguments of commands that render Gaussians: background, error budget, up direction."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from drgs.config.approximations import parse_error
from drgs.config.schema import NAMED_COLORS
from drgs.core.errors import UserError, one_line
from drgs.io.images import MITSUBA_FORMATS, read_header, read_pixels
from drgs.results.model import Background

UP = (0.0, 0.0, 1.0)  # world: the convention of both dataset layouts


def add_background(parser: argparse._ActionsContainer) -> None:
    """Add the argument for :func:`parse_background`."""
    text = "white, black, R G B in 0..1, or an image file (default: that of the configuration, "
    text += "or black without one)"
    parser.add_argument("--background", nargs="+", metavar="COLOR", help=text)


def add_error(parser: argparse._ActionsContainer) -> None:
    """Add the argument of an error budget."""
    text = "largest error of the approximations, which are then chosen by measurement: root mean "
    text += 'square in 0..1, "54dB" or "0.5steps" (of 8 bits)'
    parser.add_argument("--error", type=error_budget, metavar="ERROR", help=text)


def parse_background(words: Sequence[str] | None) -> Background | None:
    """Return a colour (display space) by name or by three numbers, or the file of an image."""
    if words is None:
        return None
    if len(words) == 1 and words[0] in NAMED_COLORS:
        return NAMED_COLORS[words[0]]
    if len(words) == 1 and os.path.lexists(words[0]):
        path = Path(words[0])
        read_pixels(path)
        if (name := read_header(path).format) not in MITSUBA_FORMATS:
            raise UserError(
                f"--background: {path} must be a PNG, JPEG, BMP, PPM or TGA image, got {name}; "
                "convert it"
            )
        return path
    try:
        color = tuple(float(word) for word in words)
    except ValueError:
        color = ()
    if len(color) != 3 or not all(0 <= value <= 1 for value in color):
        raise UserError(
            "--background: must be white, black, three numbers in 0..1 or an image's file, got "
            + one_line(" ".join(words), 60)
        )
    return color


def error_budget(text: str) -> float:
    """Parse an error budget: see :func:`drgs.config.approximations.parse_error`."""
    try:
        return parse_error(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
