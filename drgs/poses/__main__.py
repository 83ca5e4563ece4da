"""``python -m drgs.poses FOLDER``: find out where photographs were taken.

Runs COLMAP's structure from motion on the photographs in FOLDER/images, or in FOLDER itself, and
writes its model to FOLDER/sparse/0, which ``drgs fit FOLDER`` reads. Images in FOLDER/masks leave
parts of photographs out. Needs pycolmap, which the extra ``colmap`` installs.
"""

from __future__ import annotations

import argparse
import shlex
import time
from functools import partial
from pathlib import Path

from drgs.cli.commands import CommandParser, file_or_folder, run_command
from drgs.cli.progress import StepProgress
from drgs.config.schema import DataConfig
from drgs.core.errors import format_names
from drgs.datasets.folders import find_reader
from drgs.datasets.transforms import LENS_OF_MODEL
from drgs.poses.structure_from_motion import (
    ALL_PAIRS,
    NEIGHBOURS,
    SfmResult,
    SfmSettings,
    reconstruct,
)

MAX_NAMES = 5  # photographs without a camera, and cameras, that are named


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    usual = SfmSettings()
    parser.description = "Find out where photographs were taken, by COLMAP's structure from motion."
    parser.show_examples("%(prog)s photographs", "%(prog)s photographs --camera-model RADIAL")
    folder = "with photographs, or with images/"
    parser.add_argument("folder", type=file_or_folder, metavar="FOLDER", help=folder)
    parser.add_argument(
        "--camera-model",
        choices=LENS_OF_MODEL,
        default=usual.camera_model,
        metavar="MODEL",
        help=f"COLMAP's name of the lens: {', '.join(LENS_OF_MODEL)} (default: %(default)s)",
    )
    share = "photographs that share a camera: those of the same size and EXIF, all, or none "
    share += "(default: %(default)s)"
    choices = "alike", "one", "each"
    parser.add_argument("--share", choices=choices, default=usual.share, help=share)
    parser.add_argument(
        "--compare",
        choices=("auto", "all", "neighbours"),
        default=usual.compare,
        help=f"pairs to compare: all; by name the next {NEIGHBOURS} and some further ones, as for "
        f"frames of a video; auto: all of up to {ALL_PAIRS} photographs (default: %(default)s)",
    )
    mapper = "place one photograph after another, or all at once (default: %(default)s)"
    choices = "incremental", "global"
    parser.add_argument("--mapper", choices=choices, default=usual.mapper, help=mapper)
    overwrite = "replace the model that an earlier run wrote"
    parser.add_argument("--overwrite", action="store_true", help=overwrite)
    parser.set_defaults(run=run, prog=parser.prog)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    started = time.perf_counter()
    settings = SfmSettings(args.camera_model, args.compare, args.share, args.mapper)
    with StepProgress() as steps:
        # Several models are begun, each with its first camera: their numbers go back.
        result = reconstruct(args.folder, settings, args.overwrite, steps.update)
    print(description_of(result, settings))
    print(f"written: {args.folder / 'sparse' / '0'} in {time.perf_counter() - started:.0f} s")
    print(f"continue with: {fit_command(args.folder)}")


def fit_command(folder: Path) -> str:
    """Return the command that fits the folder with its new model."""
    words = ["drgs", "fit", str(folder)]
    if find_reader(DataConfig.model_validate({"path": folder}))[0] != "colmap":
        words += ["--set", "data.type=colmap"]
    return shlex.join(words)


def description_of(result: SfmResult, settings: SfmSettings) -> str:
    """Describe the result, and how to place more photographs."""
    count, total = len(result.names), len(result.names) + len(result.missing)
    lines = [
        f"{count} of {total} photographs placed, mean reprojection error {result.error:.2f} px, "
        f"{result.num_points:,} points",
        *(f"camera: {camera}" for camera in result.cameras[:MAX_NAMES]),
    ]
    if result.missing:
        lines.append(f"without a camera: {format_names(result.missing, MAX_NAMES)}")
        if others := result.num_models - 1:
            lines.append(f"smaller models that do not hang together with this one: {others}")
        lines.append(
            "photographs that show what lies between would place them; so may "
            f"{settings.alternative_options(total)}"
        )
    return "\n".join(lines)


main = partial(run_command, add_arguments, "python -m drgs.poses")

if __name__ == "__main__":
    main()
