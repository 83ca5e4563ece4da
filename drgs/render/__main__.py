"""``python -m drgs.render WHAT --out DIR``: images of Gaussians, of a fit, of a Mitsuba scene.

``WHAT`` is a file of Gaussians (``drgs.io.formats``), the output folder of a fit
(its Gaussians and ``config.yml``) or a Mitsuba scene (``.xml``; Mitsuba's own binary cannot
load Python plugins). Cameras of Gaussians are the photographs' (``--split``, with metrics), an
orbit (``--orbit``), a file's (``--camera``) or one (``--origin``).

Writes PNGs, with ``metrics.json`` (``--split``) or ``orbit.webp`` (``--orbit``); of scenes, EXRs.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

import mitsuba as mi

from drgs.cli.commands import (
    SIZE,
    VECTOR,
    CommandParser,
    bounded_int,
    degrees,
    file_or_folder,
    run_command,
)
from drgs.cli.execution import add_execution_arguments, execution_settings, select_variant
from drgs.core.environment import VARIANTS
from drgs.core.errors import UserError
from drgs.core.files import open_regular
from drgs.core.processes import process_number, start_mpi
from drgs.core.registry import HOW_TO_INSTALL
from drgs.effects.compose import IGNORABLE
from drgs.integrator.scene import render_views
from drgs.io.formats import format_to_read, readable_formats
from drgs.render.images import render_model
from drgs.render.mitsuba_scene import render_mitsuba_scene
from drgs.results.folder import CONFIG, METRICS
from drgs.results.model import Render, load_model, open_image_folder
from drgs.results.model_arguments import add_background, add_error, parse_background

MAX_FRAMES = 10_000  # of an orbit: all cameras are created first

CAMERA_OPTIONS = {
    "split": set(),
    "orbit": {"up", "fov", "size", "panorama"},
    "camera": {"size", "panorama"},
    "origin": {"target", "up", "fov", "size", "panorama"},
}
"""Options that each way of placing cameras uses."""

MODEL_OPTIONS = {"scene", "data", "set", "background", "ignore", "error_image"}

ALL_OPTIONS = {"define", *CAMERA_OPTIONS, *CAMERA_OPTIONS["origin"], *MODEL_OPTIONS}

LOADER_ARGUMENTS = ("path", "parallel", "optimize")
"""Arguments of ``mi.load_file``, which takes a file's parameters by name as well."""


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Render Gaussians, a fit, or a Mitsuba scene with the splats integrator."
    parser.show_examples(
        "%(prog)s out/lego --out DIR                # the test views, with PSNR and SSIM",
        "%(prog)s out/lego --orbit 60 --out DIR     # an animation",
        "%(prog)s model.ply --origin 0 -3 2 --target 0 0 0 --out DIR",
        "%(prog)s out/fox --orbit 60 --panorama --out DIR",
        "%(prog)s scene.xml -D model=model.ply --out DIR",
    )
    add, kind = parser.add_argument, file_or_folder
    what = "file of Gaussians, Mitsuba scene, or output folder of a fit"
    add("what", type=kind, metavar="MODEL|SCENE.xml|OUT_DIR", help=what)
    add("--out", type=kind, required=True, metavar="DIR", help="output folder")
    _add_cameras(parser)
    _add_settings(parser)
    parser.add_argument_group("Mitsuba scenes").add_argument(
        "--define",
        "-D",
        type=_definition,
        action="append",
        metavar="NAME=VALUE",
        help="parameter of the scene file, as in model=point_cloud_drgs.ply; repeatable",
    )
    add_execution_arguments(parser, variants=None)
    parser.set_defaults(run=run, is_shared=True)


def _add_cameras(parser: CommandParser) -> None:
    group = parser.add_argument_group("cameras")
    one_of = group.add_mutually_exclusive_group().add_argument
    split = "cameras of the photographs, with PSNR and SSIM"
    one_of("--split", choices=("test", "train"), help=split)
    orbit = "N frames of an orbit, and an animation"
    one_of("--orbit", type=bounded_int(1, MAX_FRAMES), metavar="N", help=orbit)
    camera = "cameras of a file in the layout of transforms.json"
    one_of("--camera", type=file_or_folder, metavar="FILE.json", help=camera)
    one_of("--origin", **VECTOR, help="position of one camera")
    add = group.add_argument
    target = "point that it looks at (default: 0 0 0, relative to the model's origin)"
    add("--target", **VECTOR, help=target)
    add("--up", **VECTOR, help="up direction of --origin or --orbit (default: 0 0 1)")
    fov = "horizontal field of view (default: 40; for --orbit, that of the photographs)"
    add("--fov", type=degrees, metavar="DEGREES", help=fov)
    size = "px (default: 400 400; for --orbit, at most that, in the photographs' proportions; "
    size += "800 400 for --panorama)"
    add("--size", **SIZE, help=size)
    panorama = "images in all directions (equirectangular) from these positions"
    add("--panorama", action="store_const", const=True, help=panorama)


def _add_settings(parser: CommandParser) -> None:
    group = parser.add_argument_group("rendering")
    add_background(group)
    add_error(group)
    add = group.add_argument
    error = "write the error at each pixel beside each image, as colours (NAME.error.png)"
    add("--error-image", action="store_const", const=True, help=error)
    ignore = f"effects to leave out: {', '.join(IGNORABLE)}"
    add("--ignore", nargs="+", choices=IGNORABLE, metavar="EFFECT", help=ignore)
    scene = "configuration with the photographs and settings of the fit"
    add("--scene", type=file_or_folder, metavar="CONFIG.yml", help=scene)
    add("--data", metavar="DIR", help="dataset folder (data.path)")
    value = "override a value of the configuration, as in data.image_size=200; repeatable"
    add("--set", action="append", metavar="KEY=VALUE", help=value)


def run(args: argparse.Namespace) -> None:
    """Render the images of the command line."""
    if process_number() is None:
        run_with_arguments(args, render_views)
        return
    start_mpi()
    from drgs.render.parallel import run_together

    run_together(args, partial(run_with_arguments, args))


def run_with_arguments(args: argparse.Namespace, render: Render) -> None:
    """Run the command; render: renders views, in this process or in several."""
    with execution_settings(args.threads, args.debug), open_image_folder(args.out) as folder:
        _check(args)
        select_variant(args.variant)
        if args.what.suffix.lower() == ".xml":
            render_mitsuba_scene(args.what, folder, dict(args.define or ()), args.error)
        else:
            data = [] if args.data is None else [f"data.path={args.data}"]
            overrides, background = [*(args.set or ()), *data], parse_background(args.background)
            model = load_model(args.what, args.scene, overrides, background, args.ignore or ())
            error = {"error": args.error, "error_images": bool(args.error_image)}
            render_model(args, replace(model, render=render, **error), folder)
        print(f"written: {args.out}")


def _check(args: argparse.Namespace) -> None:
    """Refuse arguments that conflict, before anything is read or written."""
    what = args.what
    if args.error_image and args.error is None:
        raise UserError("--error-image: needs --error ERROR")
    if not what.exists():
        raise UserError(f"{what}: there is no such file or folder")
    if not what.is_dir():
        open_regular(what).close()  # Mitsuba would wait for a pipe
    if (args.out / CONFIG).exists():
        raise UserError(f"--out {args.out}: holds a fit, whose {METRICS} would be overwritten")
    if what.suffix.lower() == ".xml":
        _check_options(args, {"define"}, "a Mitsuba scene, which has its own cameras and settings")
        variants = mi.variants()
    elif format_to_read(what) is not None or what.is_dir():
        _check_cameras(args)
        variants = VARIANTS
    else:
        suffixes = ", ".join(each.value.suffix for each in readable_formats())
        raise UserError(
            f"{what}: must be a file of Gaussians ({suffixes}), a Mitsuba scene (.xml) or the "
            f"output folder of a fit; {HOW_TO_INSTALL}"
        )
    if args.variant not in variants:
        raise UserError(f"--variant: must be one of {', '.join(variants)}, got {args.variant}")


def _check_cameras(args: argparse.Namespace) -> None:
    """Refuse Gaussians without cameras, and options that the cameras do not use."""
    way = next((way for way in CAMERA_OPTIONS if getattr(args, way) is not None), None)
    has_photographs = args.scene is not None or args.what.is_dir()
    if way is None and not has_photographs:
        raise UserError(
            f"{args.what}: choose the cameras: --orbit N, --camera FILE.json, --origin X Y Z, or "
            "--split with --scene CONFIG.yml"
        )
    if args.panorama and args.fov is not None:
        raise UserError(f"--fov: a panorama shows all directions, got {args.fov:g}; leave it out")
    way = way or "split"
    used, context = {way, *CAMERA_OPTIONS[way], *MODEL_OPTIONS}, f"Gaussians and --{way}"
    if not has_photographs:
        used, context = used - {"data", "set"}, f"{context} but without --scene CONFIG.yml"
    elif way == "orbit":
        used, context = used - {"up"}, f"{context}, where it follows from the photographs' cameras"
    _check_options(args, used, context)
    if way == "split" and isinstance(parse_background(args.background), Path):
        raise UserError(
            "--background: an image is not what the photographs were composited over; use it with "
            "--orbit, --camera or --origin"
        )


def _check_options(args: argparse.Namespace, used: set[str], context: str) -> None:
    for name in sorted(ALL_OPTIONS - used):
        if getattr(args, name) is not None:
            raise UserError(f"--{name.replace('_', '-')}: is not used with {context}")


def _definition(word: str) -> tuple[str, str]:
    """Parse NAME=VALUE for a parameter of a scene file."""
    name, separator, value = word.partition("=")
    name = name.strip()
    if not name or not separator or name in LOADER_ARGUMENTS:
        raise argparse.ArgumentTypeError(
            f"must be NAME=VALUE with a name other than {', '.join(LOADER_ARGUMENTS)}, which are "
            f"taken by Mitsuba's loader, got {word}"
        )
    return name, value


main = partial(run_command, add_arguments, "python -m drgs.render")

if __name__ == "__main__":
    main()
