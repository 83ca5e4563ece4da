"""``python -m drgs.capture SCENE --out DIR``: turn a Mitsuba scene into a training set.

SCENE is an XML file, or a Python file with a function ``scene()`` that returns a scene dictionary.
Its images are path traced, not by its own integrator, from cameras around it, or at its own sensors
if it has many. They are written in the NeRF-synthetic layout: see
``drgs.capture.dataset``. A second run of the same command continues an interrupted one.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import fields, replace
from functools import partial

from drgs.capture.camera_placement import ENOUGH_SENSORS, KINDS, settings_for, views_of
from drgs.capture.dataset import POINTS, CaptureFolder
from drgs.capture.path_tracing import CaptureSettings, load_scene, refuse_splats, require_sight
from drgs.cli.commands import (
    SIZE,
    VECTOR,
    CommandParser,
    bounded_int,
    degrees,
    file_or_folder,
    finite_number,
    run_command,
)
from drgs.cli.execution import add_variant_argument, select_variant
from drgs.core.errors import UserError
from drgs.core.folders import sole_writer
from drgs.core.memory import too_large_reason

WHOLE_NUMBERS = {
    "views": (1, 100_000, "images to train on"),
    "val_views": (0, 100_000, "images of the split val"),
    "test_views": (0, 100_000, "images of the split test"),
    "spp": (1, 2**20, "paths per pixel"),
    "max_depth": (1, 2**16, "longest path"),
    "points": (0, 5_000_000, f"number of points in {POINTS}"),
    "seed": (0, 2**64 - 1, "of cameras, paths and points"),
}
"""Smallest value, largest value and help by name of the setting."""


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Turn a Mitsuba scene into a training set in the NeRF-synthetic layout."
    parser.show_examples("%(prog)s scenes/brick_crane.py --views 100 --size 400 400 --out DIR")
    add = parser.add_argument
    add("scene", type=file_or_folder, metavar="SCENE", help="XML file, or Python file with scene()")
    add("--out", type=file_or_folder, metavar="DIR", required=True, help="folder to write")
    for name, (least, most, text) in WHOLE_NUMBERS.items():
        add(
            f"--{name.replace('_', '-')}",
            type=bounded_int(least, most),
            metavar="N",
            help=f"{text} (default: {getattr(CaptureSettings, name)})",
        )
    add("--size", **SIZE, help="px (default: 400 400); their background is transparent")
    _add_cameras(parser)
    add_variant_argument(parser)
    parser.set_defaults(run=run)


def _add_cameras(parser: CommandParser) -> None:
    text = "What is not given follows from the scene's own sensors, if it has any."
    add = parser.add_argument_group("cameras", text).add_argument
    where = "where they stand (default: where the scene's sensors are, if there are "
    where += f"{ENOUGH_SENSORS} or more; else around it)"
    add("--cameras", choices=KINDS, help=where)
    fov = "horizontal field of view (default: the original's 39.6)"
    add("--fov", type=degrees, metavar="DEGREES", help=fov)
    distance = "of the cameras from the target (default: the whole scene is in the image)"
    add("--distance", type=finite_number, help=distance)
    what = "what the cameras look at (default: the middle of the bounding box)"
    add("--target", **VECTOR, help=what)
    axes, up = ("x", "y", "z", "-x", "-y", "-z"), "x, y, z or, as in --up=-z, an opposite"
    add("--up", choices=axes, metavar="AXIS", help=f"{up} (default: z)")
    ranges = {"type": finite_number, "nargs": 2, "metavar": ("MIN", "MAX")}
    azimuth = "degrees about the up axis, from the axis that follows it in x, y, z, x"
    add("--azimuth", **ranges, help=f"{azimuth} (default: all around)")
    add("--elevation", **ranges, help="degrees above the horizon (default: 0 90)")


def run(args: argparse.Namespace) -> None:
    """Capture the scene that the command line names."""
    options = {field.name: getattr(args, field.name) for field in fields(CaptureSettings)}
    given = {k: tuple(v) if isinstance(v, list) else v for k, v in options.items() if v is not None}
    if args.fov is not None:
        given["fov"] = math.radians(args.fov)
    settings = replace(CaptureSettings(), **given)
    if reason := too_large_reason(*settings.size):
        raise UserError(f"--size: {reason}")
    if not args.scene.is_file():
        raise UserError(f"{args.scene}: there is no such scene file")
    select_variant(args.variant)
    scene = load_scene(args.scene)
    refuse_splats(args.scene, scene)
    settings = settings_for(scene, settings, given.keys())
    views = views_of(scene, settings)
    require_sight(scene, settings, views)
    with sole_writer(args.out) as keep:
        folder = CaptureFolder(args.out, args.scene, settings, keep)
        folder.check()
        fov = f"field of view {math.degrees(settings.fov):.4g} degrees"
        kind = f"{len(views)} around the scene, {fov}"
        kind = f"the scene's own sensors, {len(views)}" if settings.cameras == "sensors" else kind
        print(f"cameras: {kind}")
        try:
            folder.take_images(scene, views)
            folder.write_dataset(scene, views)
        except KeyboardInterrupt:
            print("\nthe same command continues", file=sys.stderr)
            raise


main = partial(run_command, add_arguments, "python -m drgs.capture")

if __name__ == "__main__":
    main()
