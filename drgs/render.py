"""``python -m drgs.render WHAT --out DIR``: images of Gaussians, of a fit, of a Mitsuba scene.

``WHAT`` is a file of Gaussians (``drgs.io.formats``), the output folder of a fit
(``point_cloud.ply`` and ``config.yml``) or a Mitsuba scene (``.xml``; Mitsuba's own binary cannot
load Python plugins). Cameras of Gaussians are the photographs' (``--split``, with metrics), an
orbit (``--orbit``), a file's (``--camera``) or one (``--origin``).

Writes a PNG per image, and ``metrics.json`` (``--split``) or ``orbit.webp`` (``--orbit``), or an
EXR per image (scenes).
"""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from drgs.cli.commands import (
    CommandParser,
    bounded_int,
    degrees,
    file_or_folder,
    finite_number,
    run_command,
)
from drgs.cli.execution import add_execution_arguments, execution_settings, select_variant
from drgs.config.approximations import parse_error
from drgs.config.schema import NAMED_COLORS, FitConfig
from drgs.core.constants import SHUTTER_SAMPLES
from drgs.core.environment import VARIANTS
from drgs.core.errors import PluginError, UserError, one_line, reason_of_mitsuba
from drgs.core.files import atomic_path, open_regular, shorten_stem
from drgs.core.processes import process_number, start_mpi
from drgs.core.registry import HOW_TO_INSTALL
from drgs.datasets.orbits import orbit_of_gaussians, orbit_of_views, orbit_size
from drgs.datasets.types import Viewpoint
from drgs.datasets.viewpoints import (
    FIELD_OF_VIEW,
    field_of_view,
    look_at,
    panorama,
    pinhole,
    read_viewpoints,
)
from drgs.effects.compose import IGNORABLE
from drgs.integrator.scene import render_views
from drgs.integrator.types import is_splats
from drgs.io.formats import format_to_read, readable_formats
from drgs.io.images import (
    MITSUBA_FORMATS,
    check_animation,
    read_header,
    read_pixels,
    write_animation,
    write_exr,
)
from drgs.io.scenes import load_scene_file
from drgs.results.files import CAMERAS, CONFIG, ERROR_BUDGET, METRICS, ORBIT
from drgs.results.metrics import Quality, mean_of, psnr, ssim
from drgs.results.model import (
    BUDGET_KEY,
    Background,
    ImageFolder,
    Model,
    Render,
    load_model,
    open_image_folder,
)
from drgs.results.refined_cameras import training_cameras

DEFAULT_SIZE, PANORAMA_SIZE = (400, 400), (800, 400)
"""Width and height, px, where nothing else decides how large an image is."""

UP = (0.0, 0.0, 1.0)  # world: the convention of both dataset layouts

MAX_FRAMES = 10_000  # of an orbit: all cameras are created first

CAMERA_OPTIONS = {
    "split": set(),
    "orbit": {"up", "fov", "size", "panorama"},
    "camera": {"size", "panorama"},
    "origin": {"target", "up", "fov", "size", "panorama"},
}
"""Options that each way of placing cameras uses."""

MODEL_OPTIONS = {"scene", "data", "set", "background", "ignore"}

ALL_OPTIONS = {"define", *CAMERA_OPTIONS, *CAMERA_OPTIONS["origin"], *MODEL_OPTIONS}

LOADER_ARGUMENTS = ("path", "parallel", "optimize")
"""Arguments of ``mi.load_file``, which takes a file's parameters by name as well."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m drgs.render``."""
    run_command(add_arguments, "python -m drgs.render", arguments)


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
    parser.add_argument(
        "what",
        type=file_or_folder,
        metavar="MODEL|SCENE.xml|OUT_DIR",
        help="file of Gaussians, Mitsuba scene, or output folder of a fit",
    )
    parser.add_argument(
        "--out", type=file_or_folder, required=True, metavar="DIR", help="output folder"
    )
    _add_cameras(parser)
    _add_settings(parser)
    parser.add_argument_group("Mitsuba scenes").add_argument(
        "--define",
        "-D",
        type=_definition,
        action="append",
        metavar="NAME=VALUE",
        help="parameter of the scene file, as in model=point_cloud.ply; repeatable",
    )
    add_execution_arguments(parser, variants=None)
    parser.set_defaults(run=run, is_shared=True)


def _add_cameras(parser: CommandParser) -> None:
    group = parser.add_argument_group("cameras")
    vector = {"type": finite_number, "nargs": 3, "metavar": ("X", "Y", "Z")}
    one_of = group.add_mutually_exclusive_group().add_argument
    one_of(
        "--split", choices=("test", "train"), help="cameras of the photographs, with PSNR and SSIM"
    )
    one_of(
        "--orbit",
        type=bounded_int(1, MAX_FRAMES),
        metavar="N",
        help="N frames of an orbit, and an animation",
    )
    one_of(
        "--camera",
        type=file_or_folder,
        metavar="FILE.json",
        help="cameras of a file in the layout of transforms.json",
    )
    one_of("--origin", **vector, help="position of one camera")
    add = group.add_argument
    add(
        "--target",
        **vector,
        help="point that it looks at (default: 0 0 0, relative to the model's origin)",
    )
    add("--up", **vector, help="up direction of --origin or --orbit (default: 0 0 1)")
    add(
        "--fov",
        type=degrees,
        metavar="DEGREES",
        help="horizontal field of view (default: 40; for --orbit, that of the photographs)",
    )
    add(
        "--size",
        type=bounded_int(1),
        nargs=2,
        metavar=("W", "H"),
        help="px (default: 400 400; for --orbit, at most that, in the photographs' proportions; "
        "800 400 for --panorama)",
    )
    add(
        "--panorama",
        action="store_const",
        const=True,
        help="images in all directions (equirectangular) from these positions",
    )


def _add_settings(parser: CommandParser) -> None:
    group = parser.add_argument_group("rendering")
    add_background(group)
    add_error(group)
    group.add_argument(
        "--ignore",
        nargs="+",
        choices=IGNORABLE,
        metavar="EFFECT",
        help=f"effects to leave out: {', '.join(IGNORABLE)}",
    )
    group.add_argument(
        "--scene",
        type=file_or_folder,
        metavar="CONFIG.yml",
        help="configuration with the photographs and settings of the fit",
    )
    group.add_argument("--data", metavar="DIR", help="dataset folder (data.path)")
    group.add_argument(
        "--set",
        action="append",
        metavar="KEY=VALUE",
        help="override a value of the configuration, as in data.image_size=200; repeatable",
    )


def add_background(parser: argparse._ActionsContainer) -> None:
    """Add the argument for :func:`parse_background`."""
    parser.add_argument(
        "--background",
        nargs="+",
        metavar="COLOR",
        help="white, black, R G B in 0..1, or an image file (default: that of the configuration, "
        "or black without one)",
    )


def add_error(parser: argparse._ActionsContainer) -> None:
    """Add the argument of an error budget."""
    parser.add_argument(
        "--error",
        type=error_budget,
        metavar="ERROR",
        help="largest error of the approximations, which are then chosen by measurement: root mean "
        'square in 0..1, "54dB" or "0.5steps" (of 8 bits)',
    )


def run(args: argparse.Namespace) -> None:
    """Render the images of the command line."""
    if process_number() is None:
        run_with_arguments(args, render_views)
        return
    start_mpi()
    from drgs.training.parallel.images import run_together

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
            effects = args.ignore or ()
            model = load_model(args.what, args.scene, overrides, background, effects, render)
            render_model(args, replace(model, error=args.error), folder)
        print(f"written: {args.out}")


def render_model(args: argparse.Namespace, model: Model, folder: ImageFolder) -> None:
    """Render Gaussians from the cameras that the command line names."""
    if model.config is not None:
        folder.check_no_photographs(model.config.data.path)
    if args.orbit is not None:
        render_orbit(model, args, folder)
    elif args.camera is not None or args.origin is not None:
        for _ in render_cameras(model, viewpoints_of(args, model), folder):
            pass
    else:
        render_split(model, args.split or "test", folder)
    folder.write_budget()


def render_split(model: Model, split: str, folder: ImageFolder) -> Quality:
    """Render the views of a dataset's split, measure them, and print and write the result."""
    dataset = model.dataset(f"--split {split}")
    print(dataset.description)
    views = dataset.train if split == "train" else dataset.test
    column = max(len("view"), *(len(view.name) for view in views))
    images = model.images(views, folder, [METRICS], "give --set data.image_size=...")
    print(f"{'view':{column}}  PSNR [dB]    SSIM")
    scores = []
    for view, image in zip(views, images, strict=True):
        folder.write_png(f"{view.name}.png", image)
        pair = image, view.image, view.mask
        scores.append({"psnr": psnr(*pair), "ssim": ssim(*pair)})
        print(f"{view.name:{column}}  {_line(**scores[-1])}", flush=True)
    quality = mean_of([(score["psnr"], score["ssim"]) for score in scores])
    mean = {"psnr": quality.psnr, "ssim": quality.ssim}
    print(f"{'mean':{column}}  {_line(**mean)}")
    report = {
        "split": dataset.test_split if split == "test" else "train",
        "num_views": quality.num_views,
        "num_gaussians": model.gaussians.num_gaussians,
        "mean": mean,
        "views": {view.name: score for view, score in zip(views, scores, strict=True)},
    }
    with atomic_path(folder.path / METRICS) as temporary:
        temporary.write_text(json.dumps(_replace_infinities(report), indent=2) + "\n")
    return quality


def render_orbit(model: Model, args: argparse.Namespace, folder: ImageFolder) -> None:
    """Render frames around the scene, and animations of them."""
    if model.config is None:
        fov, (width, height) = args.fov or FIELD_OF_VIEW, args.size or _default_size(args)
        orbit = orbit_of_gaussians(model.gaussians, np.array(args.up or UP), fov)
    else:
        views = _orbited_views(model, model.config, args)
        size = PANORAMA_SIZE if args.panorama else orbit_size(views)
        fov, (width, height) = args.fov or field_of_view(views), args.size or size
        orbit = orbit_of_views(views, model.gaussians)
    check_animation(args.orbit, width, height)
    viewpoints = orbit.viewpoints(args.orbit, width, height, fov)
    if args.panorama:
        viewpoints = [panorama(view, orbit.up) for view in viewpoints]
    images = render_cameras(model, viewpoints, folder, [ORBIT])
    write_animation(folder.path / ORBIT, images)


def _orbited_views(
    model: Model, config: FitConfig, args: argparse.Namespace
) -> Sequence[Viewpoint]:
    """Return the training cameras: those in a fit's folder, unless photographs are named."""
    if args.what.is_dir() and (args.scene, args.data, args.set) == (None, None, None):
        refined = args.what / CAMERAS
        if config.cameras.optimise and refined.is_file():
            print(f"cameras: as refined, from {refined}")
        if (views := training_cameras(args.what, model.gaussians.origin)) is not None:
            return views
    return model.dataset("--orbit").train


def render_cameras(
    model: Model, viewpoints: Sequence[Viewpoint], folder: ImageFolder, others: Sequence[str] = ()
) -> Iterator[np.ndarray]:
    """Write and yield images without photographs; others: further files to be written."""
    images = model.images(viewpoints, folder, others, "give a smaller --size")
    for camera, image in zip(viewpoints, images, strict=True):
        folder.write_png(f"{camera.name}.png", image)
        print(f"{camera.name}: {camera.width}x{camera.height}", flush=True)
        yield image


def _default_size(args: argparse.Namespace) -> tuple[int, int]:
    return PANORAMA_SIZE if args.panorama else DEFAULT_SIZE


def viewpoints_of(args: argparse.Namespace, model: Model) -> list[Viewpoint]:
    """Return the cameras of ``--camera`` or of ``--origin``, relative to the model's origin."""
    size: tuple[int, int] | None = tuple(args.size) if args.size else None
    origin = model.gaussians.origin
    if args.camera is not None:
        samples = model.config.data.shutter_samples if model.config else SHUTTER_SAMPLES
        of_file = PANORAMA_SIZE if args.panorama else None
        views = read_viewpoints(args.camera, size or of_file, samples)
    else:
        pose = look_at(args.origin, args.target or origin, args.up or UP)
        views = [pinhole("camera", pose, *(size or _default_size(args)), args.fov or FIELD_OF_VIEW)]
    if args.panorama:
        up = None if args.camera is not None else np.array(args.up or UP)
        views = [panorama(view, up) for view in views]
    return [view.with_offset(-np.array(origin)) for view in views]


def render_mitsuba_scene(
    path: Path, folder: ImageFolder, definitions: dict[str, str], budget: float | None = None
) -> None:
    """Render every sensor of a Mitsuba scene to EXR (all channels) and PNG (colours in sRGB).

    definitions: values for the parameters ($name) of the scene file; budget: of the error, instead
    of the scene's own.
    """
    try:
        scene = load_scene_file(path, **definitions)
    except RuntimeError as error:
        raise UserError(f"{path}: {reason_of_mitsuba(error)}") from None
    if not isinstance(scene, mi.Scene) or scene.integrator() is None or not scene.sensors():
        raise UserError(f"{path}: the scene must hold an integrator and at least one sensor")
    integrator = scene.integrator()
    splats = integrator.state if is_splats(integrator) else None
    if budget is not None:
        if splats is None:
            raise UserError("--error: the scene's own integrator must be splats")
        splats.error, splats.budget_report = budget, None
    stem, count = shorten_stem(path.stem), len(scene.sensors())
    names = [stem] if count == 1 else [f"{stem}_{index}" for index in range(count)]
    files = [f"{name}.{suffix}" for name in names for suffix in ("exr", "png")]
    files += [ERROR_BUDGET] if splats is not None and splats.error is not None else []
    bitmaps = folder.claim(files, _render_sensors(path, scene))
    for name, bitmap in zip(names, bitmaps, strict=True):
        width, height = bitmap.size()
        if splats is not None and splats.budget_report is not None:
            folder.budget = splats.budget_report
            bitmap.metadata()[BUDGET_KEY] = json.dumps(splats.budget_report.record())
        write_exr(folder.path / f"{name}.exr", bitmap)
        # As floats: Mitsuba's own conversion to 8 bits rounds down.
        colors = bitmap.split()[0][1].convert(
            mi.Bitmap.PixelFormat.RGB,
            mi.Struct.Type.Float32,
            srgb_gamma=_is_linear(scene.integrator()),
        )
        # NaN in a scene's light is black in the PNG, and kept in the EXR.
        folder.write_png(f"{name}.png", np.nan_to_num(np.array(colors)))
        print(f"{name}: {width}x{height}")
    folder.write_budget()


def _is_linear(integrator: mi.Integrator) -> bool:
    """Return whether no nested integrator (``splats``, ``volprim_rf_basic``) encodes colours."""
    nested = mi.traverse(integrator).hierarchy
    return all(getattr(each, "srgb_primitives", True) for each in nested)


def _render_sensors(path: Path, scene: mi.Scene) -> Iterator[mi.Bitmap]:
    """Yield the image of each sensor, with all channels."""
    integrator, sensors = scene.integrator(), scene.sensors()
    try:
        if is_splats(integrator):
            print(integrator.summary(scene, *sensors), flush=True)
            if integrator.state.budget_report is not None:
                print(integrator.state.budget_report.line(), flush=True)
        for index, sensor in enumerate(sensors):
            integrator.render(scene, sensor=index)
            yield sensor.film().bitmap()
    except PluginError as error:  # the scene's fault; anything else is not
        raise UserError(f"{path}: {reason_of_mitsuba(error)}") from None


def _check(args: argparse.Namespace) -> None:
    """Refuse arguments that conflict, before anything is read or written."""
    what = args.what
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
    used, place = {way, *CAMERA_OPTIONS[way], *MODEL_OPTIONS}, f"Gaussians and --{way}"
    if not has_photographs:
        used, place = used - {"data", "set"}, f"{place} but without --scene CONFIG.yml"
    elif way == "orbit":
        used, place = used - {"up"}, f"{place}, where it follows from the photographs' cameras"
    _check_options(args, used, place)
    if way == "split" and isinstance(parse_background(args.background), Path):
        raise UserError(
            "--background: an image is not what the photographs were composited over; use it with "
            "--orbit, --camera or --origin"
        )


def _check_options(args: argparse.Namespace, used: set[str], place: str) -> None:
    for name in sorted(ALL_OPTIONS - used):
        if getattr(args, name) is not None:
            raise UserError(f"--{name}: is not used with {place}")


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


def _line(psnr: float, ssim: float) -> str:
    return f"{psnr:9.2f}  {ssim:.4f}"


def _replace_infinities(value: object) -> object:
    """Replace infinities, such as the PSNR of equal images, by JSON's null."""
    if isinstance(value, dict):
        return {key: _replace_infinities(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    main()
