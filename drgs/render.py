"""``python -m drgs.render WHAT --out DIR``: pictures of Gaussians, of a fit, of a Mitsuba scene.

``WHAT`` is one of

- ``MODEL``: a file of Gaussians: PLY, or another of ``drgs.io.formats``
- ``OUT_DIR``: the output folder of a fit; its ``point_cloud.ply`` under its own ``config.yml``
- ``SCENE.xml``: any Mitsuba scene; Mitsuba's own binary cannot load the plugins, which are Python

Gaussians are seen from the photographs' cameras (``--split``; the pictures are then measured
against the photographs), from an orbit (``--orbit``), from the cameras of a file (``--camera``) or
from one placed by hand (``--origin``). A Mitsuba scene brings its own sensors.

The output folder then holds one PNG per picture, and ``metrics.json`` (``--split``), an animation
``orbit.webp`` and ``orbit.gif`` (``--orbit``), or one EXR per picture (scenes).
"""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol, runtime_checkable

import mitsuba as mi
import numpy as np

from drgs.cli.commands import (
    CommandParser,
    at_least,
    degrees,
    file_or_folder,
    finite_number,
    run_command,
)
from drgs.cli.execution import add_execution_arguments, executing, select_variant
from drgs.config.approximations import said_by
from drgs.config.changes import is_open
from drgs.config.load import load_config
from drgs.config.schema import NAMED_COLORS, FitConfig, ModelConfig
from drgs.core.constants import SHUTTER_SAMPLES
from drgs.core.environment import VARIANTS
from drgs.core.errors import PluginError, UserError, one_line, reason_of_mitsuba
from drgs.core.files import atomic_path, open_regular, shortened
from drgs.core.processes import process_number, start_mpi
from drgs.core.registry import HOW_TO_INSTALL
from drgs.datasets import Dataset, load_dataset
from drgs.datasets.orbits import near_plane_of, orbit_of_gaussians, orbit_of_views, orbit_size
from drgs.datasets.types import Viewpoint
from drgs.datasets.viewpoints import (
    FIELD_OF_VIEW,
    field_of_view,
    look_at,
    pinhole,
    read_viewpoints,
)
from drgs.effects.compose import IGNORABLE
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.defaults import resolve_defaults
from drgs.integrator.scene import check_lenses, check_sizes, make_scene, render_views
from drgs.integrator.state import is_splats
from drgs.integrator.summary import described, summary_of_views
from drgs.io.formats import format_for, readable_formats
from drgs.io.pictures import (
    MITSUBA_FORMATS,
    check_animation,
    read_header,
    read_pixels,
    write_animation,
    write_exr,
    write_png,
)
from drgs.io.scenes import load_scene_file
from drgs.results.files import CAMERAS, CONFIG, GAUSSIANS, METRICS, ORBIT, ORBIT_GIF
from drgs.results.folder import found_again
from drgs.results.metrics import Quality, mean_of, psnr, ssim
from drgs.results.pictures import claiming, refuse_photographs, sealing
from drgs.results.refined_cameras import refined_dataset, training_cameras

DEFAULT_SIZE = (400, 400)
"""px, where nothing else says how large a picture should be."""

BACKGROUND = "black"
"""Behind Gaussians without a configuration: that of the integrator ``splats``."""

UP = (0.0, 0.0, 1.0)
"""World: the convention of both dataset layouts."""


Render = Callable[..., Iterator[np.ndarray]]
"""Of a scene and views, pictures (H, W, 3): ``render_views``, or with the help of others."""


@dataclass(frozen=True, eq=False)
class Model:
    """Gaussians, and how they are to be rendered."""

    gaussians: Gaussians
    settings: ModelConfig
    background: tuple[float, float, float] | Path  # display space; or a file with a picture
    config: FitConfig | None  # names the dataset
    ignored: str = ""  # effects that are not to be simulated: see the plugin
    folder: Path | None = None  # where they are, perhaps with refined cameras beside them
    said: Collection[str] = ()  # names of the settings that their file has decided
    render: Render = render_views
    keep: Callable[[], object] = lambda: None  # the output folder: see ``sealing``

    def scene(self) -> mi.Scene:
        """A Mitsuba scene that renders in display space."""
        settings = {"ignore": self.ignored} if self.ignored else {}
        return make_scene(self.gaussians, self.settings, self.background, **settings)

    def pictures(
        self, views: Sequence[Viewpoint], out: Path, others: Sequence[str], remedy: str
    ) -> Iterator[np.ndarray]:
        """Pictures (H, W, 3) of the views, after a summary of what is simulated in them.

        They are for the folder ``out``, where a PNG file for each, and ``others``, may be written.
        remedy: what to do about pictures that are too large.
        """
        check_sizes(views, remedy)
        if "distortion" not in self.ignored:
            check_lenses(self.settings, views, where="", remedy="give --ignore distortion")
        scene = self.scene()
        print(described(summary_of_views(scene.integrator().state, views, self.said)), flush=True)
        names = [*(f"{view.name}.png" for view in views), *others]
        return claiming(out, names, self.render(scene, views), self.keep)

    def dataset(self, option: str) -> Dataset:
        """The photographs, without which ``option`` is impossible."""
        if self.config is None:
            raise UserError(
                f"{option}: needs photographs: give the configuration of a fit (--scene CONFIG.yml)"
            )
        dataset = load_dataset(self.config.data_for_rendering, sections=self.config.extensions)
        dataset = dataset.relative_to(self.gaussians.origin)
        if self.folder is None or not (path := self.folder / CAMERAS).is_file():
            return dataset
        if not self.config.cameras.optimise:
            print(
                f"cameras: as the dataset has them; those of {path} are used with "
                "--set cameras.optimise=true"
            )
            return dataset
        print(f"cameras: as refined, from {path}")
        return refined_dataset(dataset, self.folder)


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
        "%(prog)s scene.xml -D model=model.ply --out DIR",
    )
    parser.add_argument(
        "what", type=file_or_folder, metavar="MODEL|SCENE.xml|OUT_DIR", help="what to render"
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
        help="a parameter of the scene file, as in model=point_cloud.ply; repeatable",
    )
    add_execution_arguments(parser, variants=None)
    parser.set_defaults(run=run, is_shared=True)


def _add_cameras(parser: CommandParser) -> None:
    group = parser.add_argument_group("cameras, of Gaussians")
    vector = {"type": finite_number, "nargs": 3, "metavar": ("X", "Y", "Z")}
    one_of = group.add_mutually_exclusive_group().add_argument
    one_of(
        "--split", choices=("test", "train"), help="the photographs' cameras, with PSNR and SSIM"
    )
    one_of(
        "--orbit",
        type=at_least(1, MAX_FRAMES),
        metavar="N",
        help="N frames around the scene, and an animation",
    )
    one_of(
        "--camera",
        type=file_or_folder,
        metavar="FILE.json",
        help="cameras in the layout of transforms.json",
    )
    one_of("--origin", **vector, help="one camera, here")
    add = group.add_argument
    add("--target", **vector, help="what it looks at (default: the model's origin, 0 0 0)")
    add("--up", **vector, help="up in the picture, of --origin or --orbit (default: 0 0 1)")
    add(
        "--fov",
        type=degrees,
        metavar="DEGREES",
        help="horizontal field of view (default: 40; of --orbit, the photographs')",
    )
    add(
        "--size",
        type=at_least(1),
        nargs=2,
        metavar=("W", "H"),
        help="px (default: 400 400; of --orbit, the photographs', within that)",
    )


def _add_settings(parser: CommandParser) -> None:
    group = parser.add_argument_group("how Gaussians are rendered")
    group.add_argument(
        "--background",
        nargs="+",
        metavar="COLOR",
        help="white, black, R G B in 0..1, or a picture's file (default: the configuration's; "
        "without one, black, as the integrator splats has it)",
    )
    group.add_argument(
        "--ignore",
        nargs="+",
        choices=IGNORABLE,
        metavar="EFFECT",
        help=f"what is not to be simulated: {', '.join(IGNORABLE)}",
    )
    group.add_argument(
        "--scene",
        type=file_or_folder,
        metavar="CONFIG.yml",
        help="configuration that names the photographs",
    )
    group.add_argument("--data", metavar="DIR", help="dataset folder (data.path)")
    group.add_argument(
        "--set",
        action="append",
        metavar="KEY=VALUE",
        help="override a value of the configuration, as in data.image_size=200; repeatable",
    )


def run(args: argparse.Namespace) -> None:
    """Render what the command line names."""
    if process_number() is None:
        run_with(args, render_views)
        return
    start_mpi()
    from drgs.training.parallel.pictures import run_together

    run_together(args, partial(run_with, args))


def run_with(args: argparse.Namespace, render: Render) -> None:
    """The command; render: renders views, here or elsewhere."""
    with executing(args.threads, args.debug), sealing(args.out) as keep:
        _check(args)
        select_variant(args.variant)
        if args.what.suffix.lower() == ".xml":
            render_mitsuba_scene(args.what, args.out, dict(args.define or ()), keep)
        else:
            model = replace(load_model(args), render=render, keep=keep)
            if model.config is not None:
                refuse_photographs(args.out, model.config.data.path)
            if args.orbit is not None:
                render_orbit(model, args)
            elif args.camera is not None or args.origin is not None:
                for _ in render_cameras(model, viewpoints_of(args, model), args.out):
                    pass
            else:
                render_split(model, args.split or "test", args.out)
        print(f"written: {args.out}")


# ----------------------------------------------------------------------------------------------
# What is rendered
# ----------------------------------------------------------------------------------------------


def load_model(args: argparse.Namespace) -> Model:
    """The Gaussians that the command line names, with the settings of their configuration."""
    what, config_path = args.what, args.scene
    folder = what if what.is_dir() else what.parent
    if what.is_dir():
        for name in (CONFIG, GAUSSIANS):
            if not (what / name).is_file():
                raise UserError(
                    f"{what}: must be the output folder of a fit that has ended, but there is no "
                    f"{name} in it"
                )
        config_path = config_path or what / CONFIG
        what = what / GAUSSIANS
    config = _load_config(config_path, args) if config_path is not None else None
    if args.what.is_dir() and args.scene is None:
        config = found_again(args.what, config, ("data.path",))
    gaussians = Gaussians.load(what)
    if config is not None:
        model, background = config.model, config.data.background_rgb
    else:
        model = ModelConfig(near=near_plane_of(gaussians)).of_file()
        background = NAMED_COLORS[BACKGROUND]
    # --set is the user's word; a configuration may be there for the photographs that it names.
    asked = {override.partition("=")[0].strip() for override in args.set or ()}
    values = (gaussians.rendered_with or {}).items()
    said = said_by(str(what), {k: v for k, v in values if not asked & {"model", f"model.{k}"}})
    model = model.model_copy(update=said)
    if args.background is not None:
        background = _background(args)
    ignored = ", ".join(args.ignore or ())
    return Model(gaussians, model, background, config, ignored, folder, tuple(said))


def _load_config(path: Path, args: argparse.Namespace) -> FitConfig:
    overrides = list(args.set or ())
    if args.data is not None:
        overrides.append(f"data.path={args.data}")
    if args.background is not None and not isinstance(color := _background(args), Path):
        # Photographs with alpha are composited over it as well.
        overrides.append(f"data.background={list(color)}")
    config = load_config(path, overrides)
    config = config.model_copy(update={"model": config.model.of_file()})
    if is_open(config):  # not a fit's own, which says what was used
        config = resolve_defaults(
            config, load_dataset(config.data_for_rendering, sections=config.extensions)
        )
    return config


def render_split(model: Model, split: str, out: Path) -> Quality:
    """Render the views of a dataset's split, measure them, and print and write the result."""
    dataset = model.dataset(f"--split {split}")
    print(dataset.description)
    views = dataset.train if split == "train" else dataset.test
    column = max(len("view"), *(len(view.name) for view in views))
    pictures = model.pictures(views, out, [METRICS], "give --set data.image_size=...")
    print(f"{'view':{column}}  PSNR [dB]    SSIM")
    scores = []
    for view, image in zip(views, pictures, strict=True):
        write_png(out / f"{view.name}.png", image)
        pair = image, view.image, view.mask
        scores.append({"psnr": psnr(*pair), "ssim": ssim(*pair)})
        print(f"{view.name:{column}}  {_line(**scores[-1])}", flush=True)
    quality = mean_of([(score["psnr"], score["ssim"]) for score in scores])
    print(f"{'mean':{column}}  {_line(quality.psnr, quality.ssim)}")
    report = {
        "split": dataset.test_split if split == "test" else "train",
        "num_views": quality.num_views,
        "num_gaussians": model.gaussians.num_gaussians,
        "mean": {"psnr": quality.psnr, "ssim": quality.ssim},
        "views": {view.name: score for view, score in zip(views, scores, strict=True)},
    }
    with atomic_path(out / METRICS) as temporary:
        temporary.write_text(json.dumps(_without_infinities(report), indent=2) + "\n")
    return quality


def render_orbit(model: Model, args: argparse.Namespace) -> None:
    """Render frames around the scene, and animations of them."""
    if model.config is None:
        fov, size = args.fov or FIELD_OF_VIEW, args.size or DEFAULT_SIZE
        orbit = orbit_of_gaussians(model.gaussians, np.array(args.up or UP), fov)
    else:
        views = _orbited(model, args)
        fov, size = args.fov or field_of_view(views), args.size or orbit_size(views)
        orbit = orbit_of_views(views, model.gaussians)
    check_animation(args.orbit, *size)
    viewpoints = orbit.viewpoints(args.orbit, *size, fov)
    pictures = render_cameras(model, viewpoints, args.out, [ORBIT, ORBIT_GIF])
    write_animation(args.out / ORBIT, pictures)


def _orbited(model: Model, args: argparse.Namespace) -> Sequence[Viewpoint]:
    """The training cameras: those that a fit's folder keeps, unless photographs are named."""
    if args.what.is_dir() and (args.scene, args.data, args.set) == (None, None, None):
        refined = args.what / CAMERAS
        if model.config.cameras.optimise and refined.is_file():
            print(f"cameras: as refined, from {refined}")
        if (views := training_cameras(args.what, model.gaussians.origin)) is not None:
            return views
    return model.dataset("--orbit").train


def render_cameras(
    model: Model, viewpoints: Sequence[Viewpoint], out: Path, others: Sequence[str] = ()
) -> Iterator[np.ndarray]:
    """Write and yield pictures that no photographs belong to; others: files written besides."""
    pictures = model.pictures(viewpoints, out, others, "give a smaller --size")
    for camera, image in zip(viewpoints, pictures, strict=True):
        write_png(out / f"{camera.name}.png", image)
        print(f"{camera.name}: {camera.width}x{camera.height}", flush=True)
        yield image


def viewpoints_of(args: argparse.Namespace, model: Model) -> list[Viewpoint]:
    """The cameras of ``--camera``, or the one of ``--origin``, relative to the model's origin."""
    size, origin = tuple(args.size) if args.size else None, model.gaussians.origin
    if args.camera is not None:
        samples = model.config.data.shutter_samples if model.config else SHUTTER_SAMPLES
        views = read_viewpoints(args.camera, size, samples)
    else:
        pose = look_at(args.origin, args.target or origin, args.up or UP)
        views = [pinhole("camera", pose, *(size or DEFAULT_SIZE), args.fov or FIELD_OF_VIEW)]
    return [view.moved(-np.array(origin)) for view in views]


def render_mitsuba_scene(
    path: Path, out: Path, definitions: dict[str, str], keep: Callable[[], object]
) -> None:
    """Render every sensor of a Mitsuba scene with the scene's own integrator.

    definitions: values for the parameters ($name) of the scene file; keep: see
    :func:`drgs.results.pictures.claiming`.

    The EXR holds all channels as the film has them, the PNG the colours alone, sRGB-encoded. What
    a ``splats`` integrator with ``srgb_primitives`` false returns is display space already, also
    inside ``aov``.
    """
    try:
        scene = load_scene_file(path, **definitions)
    except RuntimeError as error:
        raise UserError(f"{path}: {reason_of_mitsuba(error)}") from None
    if scene.integrator() is None or not scene.sensors():
        raise UserError(f"{path}: the scene must hold an integrator and at least one sensor")
    linear = _is_linear(scene.integrator())
    if is_splats(scene.integrator()):
        _print_summary(path, scene)
    count = len(scene.sensors())
    stem = shortened(path.stem)
    names = [stem if count == 1 else f"{stem}_{index}" for index in range(count)]
    files = [f"{name}.{suffix}" for name in names for suffix in ("exr", "png")]
    bitmaps = claiming(out, files, _bitmaps(path, scene), keep)
    for name, bitmap in zip(names, bitmaps, strict=True):
        width, height = bitmap.size()
        write_exr(out / f"{name}.exr", bitmap)
        # As floats: Mitsuba's own conversion to 8 bits rounds down.
        colors = bitmap.split()[0][1].convert(
            mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=linear
        )
        # A scene's light may be no number: black in the PNG, and kept in the EXR.
        write_png(out / f"{name}.png", np.nan_to_num(np.array(colors)))
        print(f"{name}: {width}x{height}")


@runtime_checkable
class _ChoosesSpace(Protocol):
    """An integrator of primitives with display colours: ``splats``, ``volprim_rf_basic``."""

    srgb_primitives: bool  # whether it returns linear radiance, not display space


def _is_linear(integrator: mi.Integrator) -> bool:
    """Whether what it returns is radiance, and that of those that are nested in it."""
    nested = mi.traverse(integrator).hierarchy
    return all(one.srgb_primitives for one in nested if isinstance(one, _ChoosesSpace))


def _print_summary(path: Path, scene: mi.Scene) -> None:
    """What the scene's ``splats`` integrator simulates for its sensors."""
    try:
        print(scene.integrator().summary(scene, *scene.sensors()), flush=True)
    except PluginError as error:
        raise UserError(f"{path}: {error}") from None


def _bitmaps(path: Path, scene: mi.Scene) -> Iterator[mi.Bitmap]:
    """The picture of each sensor, with all channels."""
    for index, sensor in enumerate(scene.sensors()):
        try:
            scene.integrator().render(scene, sensor=index)
        except PluginError as error:  # the scene's fault; anything else is not
            raise UserError(f"{path}: {reason_of_mitsuba(error)}") from None
        yield sensor.film().bitmap()


# ----------------------------------------------------------------------------------------------
# Arguments, messages, files
# ----------------------------------------------------------------------------------------------


def _check(args: argparse.Namespace) -> None:
    """Refuse what does not go together, before anything is read or written."""
    if not args.what.exists():
        raise UserError(f"{args.what}: there is no such file or folder")
    if not args.what.is_dir():
        open_regular(args.what).close()  # Mitsuba would wait for a pipe
    if (args.out / CONFIG).exists():
        raise UserError(f"--out {args.out}: holds a fit, whose {METRICS} would be overwritten")
    if args.what.suffix.lower() == ".xml":
        reason = "is not used with a Mitsuba scene, which brings its own cameras and settings"
        _check_unused(args, reason, (*PLACING, *OF_CAMERAS, *OF_GAUSSIANS))
        _check_variant(args, mi.variants())
    elif format_for(args.what) is not None or args.what.is_dir():
        _check_unused(args, "is for the parameters of a Mitsuba scene (.xml)", ("define",))
        _check_variant(args, VARIANTS)
        _check_cameras(args)
    else:
        suffixes = ", ".join(each.value.suffix for each in readable_formats())
        raise UserError(
            f"{args.what}: must be a file of Gaussians ({suffixes}), a Mitsuba scene (.xml) or the "
            f"output folder of a fit; {HOW_TO_INSTALL}"
        )


def _check_variant(args: argparse.Namespace, allowed: Sequence[str]) -> None:
    if args.variant not in allowed:
        raise UserError(f"--variant: must be one of {', '.join(allowed)}, got {args.variant}")


def _check_cameras(args: argparse.Namespace) -> None:
    """A way of placing cameras, and no option that it does not use."""
    way = next((way for way in PLACING if getattr(args, way) is not None), "split")
    has_photographs = args.scene is not None or args.what.is_dir()
    if not has_photographs:
        _check_unused(args, "needs --scene CONFIG.yml", ("data", "set"))
        if way == "split" and args.split is None:
            raise UserError(
                f"{args.what}: say what to render: --orbit N, --camera FILE.json, --origin X Y Z, "
                "or --split with --scene CONFIG.yml"
            )
    if way == "split" and args.background and isinstance(_background(args), Path):
        raise UserError(
            "--background: a picture is not what the photographs were composited over; use it with "
            "--orbit, --camera or --origin"
        )
    unused = [name for name in OF_CAMERAS if name not in PLACING[way]]
    _check_unused(args, f"is not used with --{way}", unused)
    if has_photographs and way == "orbit":
        _check_unused(args, "is not used here: it follows from the photographs' cameras", ("up",))


def _check_unused(args: argparse.Namespace, reason: str, names: Sequence[str]) -> None:
    for name in names:
        if getattr(args, name) is not None:
            raise UserError(f"--{name}: {reason}")


OF_GAUSSIANS = ("scene", "data", "set", "background", "ignore")
"""Options that a Mitsuba scene does not use, beside those of cameras."""

OF_CAMERAS = ("target", "up", "fov", "size")

PLACING = {
    "split": (),
    "orbit": ("up", "fov", "size"),
    "camera": ("size",),
    "origin": OF_CAMERAS,
}
"""By the option that places the cameras, the others that it uses."""

MAX_FRAMES = 10_000
"""Of an orbit: one every two arc minutes. The cameras of all are made before the first is seen."""

TAKEN = ("path", "parallel", "optimize")
"""Arguments of ``mi.load_file``, which takes a file's parameters by name as well."""


def _definition(word: str) -> tuple[str, str]:
    """NAME=VALUE for a parameter of a scene file."""
    name, separator, value = word.partition("=")
    name = name.strip()
    if not name or not separator:
        raise argparse.ArgumentTypeError(f"must be NAME=VALUE, got {word}")
    if name in TAKEN:
        raise argparse.ArgumentTypeError(
            f"the name {name} is taken by Mitsuba's loader: rename the parameter in the scene file"
        )
    return name, value


def _background(args: argparse.Namespace) -> tuple[float, float, float] | Path:
    """Display space: a colour by name, or three numbers; or a file with a picture."""
    words = args.background
    if len(words) == 1 and words[0] in NAMED_COLORS:
        return NAMED_COLORS[words[0]]
    if len(words) == 1 and os.path.lexists(words[0]):
        return _background_picture(Path(words[0]))
    try:
        color = tuple(float(word) for word in words)
    except ValueError:
        color = ()
    if len(color) != 3 or not all(0 <= value <= 1 for value in color):
        raise UserError(
            "--background: must be white, black, three numbers in 0..1 or a picture's file, got "
            + one_line(" ".join(words), 60)
        )
    return color


def _background_picture(path: Path) -> Path:
    """``path``, if Mitsuba can read the picture; else say what is wrong with it."""
    read_pixels(path)
    if (name := read_header(path).format) not in MITSUBA_FORMATS:
        raise UserError(
            f"--background: {path} must be a PNG, JPEG, BMP, PPM or TGA picture, got {name}; "
            "convert it"
        )
    return path


def _line(psnr: float, ssim: float) -> str:
    return f"{psnr:9.2f}  {ssim:.4f}"


def _without_infinities(value: object) -> object:
    """The PSNR of equal pictures is infinite, for which JSON has no number: null."""
    if isinstance(value, dict):
        return {key: _without_infinities(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    main()
