"""``python -m drgs.poses FOLDER``: find out where photographs were taken.

Runs COLMAP's structure from motion on the photographs in FOLDER/images, or in FOLDER itself, and
writes its model to FOLDER/sparse/0. ``drgs fit FOLDER`` takes it from there.

Photographs are of something that does not move, from many places around it or along it, each
showing most of what its neighbours show. Where FOLDER/masks holds pictures ``a.jpg.png``, or
``a.png``, of the photographs ``a.jpg``, what is black in them is left out of the search.

Files in FOLDER/sparse/0 that this command has not written stay; where they are in its way, it does
not begin. Of two runs in one folder, the second is refused.

Needs pycolmap, which the extra ``colmap`` installs.
"""

from __future__ import annotations

import argparse
import shlex
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from drgs.cli.commands import CommandParser, file_or_folder, run_command
from drgs.cli.progress import RunProgress
from drgs.config.schema import DataConfig
from drgs.core.errors import listed
from drgs.datasets.folders import find_reader
from drgs.poses.structure_from_motion import (
    ALL_PAIRS,
    CAMERA_MODELS,
    NEIGHBOURS,
    Placed,
    Search,
    place,
)

MOST_NAMED = 5
"""Photographs without a camera that are named."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m drgs.poses``."""
    run_command(add_arguments, "python -m drgs.poses", arguments)


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    usual = Search()
    parser.description = "Find out where photographs were taken, by COLMAP's structure from motion."
    parser.show_examples("%(prog)s photographs", "%(prog)s photographs --camera-model RADIAL")
    parser.add_argument(
        "folder", type=file_or_folder, metavar="FOLDER", help="with photographs, or with images/"
    )
    parser.add_argument(
        "--camera-model",
        choices=CAMERA_MODELS,
        default=usual.camera_model,
        metavar="MODEL",
        help=f"COLMAP's name of the lens: {', '.join(CAMERA_MODELS)} (default: %(default)s)",
    )
    parser.add_argument(
        "--share",
        choices=("alike", "one", "each"),
        default=usual.share,
        help="photographs that share a camera: those of the same size and EXIF, all, or none "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--compare",
        choices=("auto", "all", "neighbours"),
        default=usual.compare,
        help=f"pairs to compare: all; by name the next {NEIGHBOURS} and some further ones, as for "
        f"frames of a video; auto: all of up to {ALL_PAIRS} photographs (default: %(default)s)",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the model that an earlier run wrote"
    )
    parser.set_defaults(run=run, prog=parser.prog)


def run(args: argparse.Namespace) -> None:
    """Find cameras, write them, and say how many there are."""
    started = time.perf_counter()
    search = Search(args.camera_model, args.compare, args.share)
    with _Steps() as steps:
        placed = place(args.folder, search, args.overwrite, steps.update)
    print(description_of(placed, search))
    print(f"written: {args.folder / 'sparse' / '0'} in {time.perf_counter() - started:.0f} s")
    print(f"continue with: {fit_command(args.folder)}")


def fit_command(folder: Path) -> str:
    """What to type next; other cameras that lie there would be taken first."""
    words = ["drgs", "fit", str(folder)]
    if find_reader(DataConfig(path=folder))[0] != "colmap":
        words += ["--set", "data.type=colmap"]
    return shlex.join(words)


def description_of(placed: Placed, search: Search) -> str:
    """What was found, and how to find more, as text."""
    count, total = len(placed.names), len(placed.names) + len(placed.missing)
    lines = [
        f"{count} of {total} photographs placed, mean reprojection error {placed.error:.2f} px, "
        f"{placed.num_points:,} points",
        *(f"camera: {camera}" for camera in placed.cameras[:MOST_NAMED]),
    ]
    if placed.missing:
        lines.append(f"without a camera: {listed(placed.missing, MOST_NAMED)}")
        others = placed.num_models - 1
        if others:
            lines.append(f"smaller models that do not hang together with this one: {others}")
        lines.append(
            "photographs that show what lies between would place them; so may "
            f"{search.others(total)}"
        )
    return "\n".join(lines)


class _Steps:
    """A progress bar for each of several steps, one after the other."""

    def __init__(self) -> None:
        self._stack, self._what, self._most = ExitStack(), "", 0

    def __enter__(self) -> _Steps:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def update(self, what: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` are done of what is counted."""
        if what != self._what:
            self._stack.close()
            self._what, self._most = what, -1
            self._shown = self._stack.enter_context(RunProgress(what, total))
        if done > self._most:  # several models are begun, each with its first camera
            self._most = done
            self._shown.update(done, total)


if __name__ == "__main__":
    main()
