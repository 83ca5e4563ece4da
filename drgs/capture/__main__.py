"""``python -m drgs.capture SCENE --out DIR``: turn a Mitsuba scene into a training set.

SCENE is an XML file, or a Python file with a function ``scene()`` that returns a scene dictionary.
Its pictures are path traced and written in the NeRF-synthetic layout:

- ``transforms_{train,val,test}.json``: ``camera_angle_x`` and camera to world, OpenGL axes
- ``{train,val,test}/r_0.png``, ...: RGBA, 8 bits, straight alpha, colour in sRGB
- ``points3d.ply``: what the training cameras see first, a start for ``init.point_cloud``
- ``capture.json``: what was asked for; a second run of the same command continues an interrupted
  one from it

Where the cameras stand follows from the scene by default (``drgs.capture.camera_placement``):
around it, inside it if it is a room, or where its own sensors are if it has many.

The scene's own integrator is not used; one with splats is refused, as they would be missing. From
around a scene, lights are not seen, only what they light: alpha is the part of a pixel that
surfaces cover (an opacity mask counts, glass is opaque).

Display space: a pixel that is half covered is stored as the mean colour c of its covered part and
alpha a = 1/2. The colour is encoded first and composited then, a srgb(c) + (1 - a) background,
as Blender wrote the original and as splats are composited. In the premultiplied linear picture
(a c, a) of the film both channels come from the same samples, so c is exactly their quotient.

Filter: each pixel is the plain mean of the samples inside it (a box). That is what a camera
without blur does, and the only filter that Mitsuba accumulates in a reproducible order: the same
command gives the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import math
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path

import mitsuba as mi
import numpy as np
from plyfile import PlyData, PlyElement

from drgs.capture.camera_placement import ENOUGH_SENSORS, KINDS, MOST, settings_for, views_of
from drgs.capture.path_tracing import (
    LIMITS,
    SPLITS,
    CaptureCamera,
    CaptureSettings,
    CaptureView,
    lit_part,
    load_scene,
    picture_path,
    require_sight,
    visible_points,
)
from drgs.cli.commands import (
    CommandParser,
    at_least,
    degrees,
    file_or_folder,
    finite_number,
    run_command,
)
from drgs.cli.execution import add_variant_argument, select_variant
from drgs.cli.progress import RunProgress
from drgs.core.errors import UserError, one_line
from drgs.core.files import atomic_path, read_text, remove_stale_temporaries, why_refused
from drgs.core.folders import sole_writer
from drgs.core.memory import why_too_large
from drgs.integrator.state import is_splats
from drgs.io.pictures import write_png

MANIFEST = "capture.json"
MAX_MANIFEST_BYTES = 1 << 20
REMEDY = "choose another --out, or remove it"

BEFORE = {"cameras": "around", "azimuth": None, "elevation": None}
"""Of settings that earlier versions did not have, what they did."""

FIRST = 10
"""Pictures after which a warning says that most are empty or black."""

LEAST_COVERED = 0.01
"""Of a picture that is not empty."""

UP_AXES = ("x", "y", "z", "-x", "-y", "-z")
POINTS = "points3d.ply"

WHOLE_NUMBERS = {
    "views": "pictures to train on",
    "val_views": "pictures of the split val",
    "test_views": "pictures of the split test",
    "spp": "paths per pixel",
    "max_depth": "longest path",
    "points": f"number of points in {POINTS}",
    "seed": "of cameras, paths and points",
}
"""By name of the setting, what its option says."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m drgs.capture``."""
    run_command(add_arguments, "python -m drgs.capture", arguments)


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Turn a Mitsuba scene into a training set in the NeRF-synthetic layout."
    parser.show_examples("%(prog)s scenes/brick_crane.py --views 100 --size 400 400 --out DIR")
    parser.add_argument(
        "scene",
        type=file_or_folder,
        metavar="SCENE",
        help="XML file, or Python file with scene()",
    )
    parser.add_argument(
        "--out", type=file_or_folder, metavar="DIR", required=True, help="folder to write"
    )
    for name, text in WHOLE_NUMBERS.items():
        parser.add_argument(
            f"--{name.replace('_', '-')}",
            type=at_least(*LIMITS[name]),
            metavar="N",
            help=f"{text} (default: {getattr(CaptureSettings, name)})",
        )
    parser.add_argument(
        "--size",
        type=at_least(1),
        nargs=2,
        metavar=("W", "H"),
        help="px (default: 400 400); their background is transparent",
    )
    _add_cameras(parser)
    add_variant_argument(parser)
    parser.set_defaults(run=run)


def _add_cameras(parser: CommandParser) -> None:
    group = parser.add_argument_group(
        "cameras", "What is not given follows from the scene's own sensors, if it has any."
    )
    add = group.add_argument
    add(
        "--cameras",
        choices=KINDS,
        help="where they stand (default: inside a room; where the scene's sensors are, if there "
        f"are {ENOUGH_SENSORS} or more; else around it)",
    )
    add(
        "--fov",
        type=_wide_degrees,
        metavar="DEGREES",
        help="horizontal field of view (default: the original's 39.6; in a room 70)",
    )
    add(
        "--distance",
        type=finite_number,
        help="of the cameras from the target (default: the whole scene is in the picture)",
    )
    add(
        "--target",
        type=finite_number,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="what the cameras look at (default: the middle of the bounding box)",
    )
    add(
        "--up",
        choices=UP_AXES,
        metavar="AXIS",
        help="x, y, z or, as in --up=-z, an opposite (default: z)",
    )
    ranges = {"type": finite_number, "nargs": 2, "metavar": ("MIN", "MAX")}
    add(
        "--azimuth",
        **ranges,
        help="degrees about the up axis, from the axis that follows it in x, y, z, x (default: "
        "all around)",
    )
    add("--elevation", **ranges, help="degrees above the horizon (default: 0 90; in a room -60 60)")


def run(args: argparse.Namespace) -> None:
    """Capture what the command line names; say at a Ctrl-C that the same command continues."""
    try:
        given = _given(args)
        settings = CaptureSettings(**given)
        if reason := why_too_large(*settings.size):
            raise UserError(f"--size: {reason}")
        if not args.scene.is_file():
            raise UserError(f"{args.scene}: there is no such scene file")
        select_variant(args.variant)
        scene = load_scene(args.scene)
        refuse_splats(args.scene, scene)
        settings = settings_for(scene, settings, given.keys())
        views = views_of(scene, settings)
        require_sight(scene, settings, views)
        wanted = manifest(args.scene, settings)
        with sole_writer(args.out) as keep:
            check_folder(args.out, wanted)
            print(described(settings, len(views)))

            def claim() -> None:
                keep()
                claim_folder(args.out, wanted)

            take_pictures(scene, settings, views, args.out, claim)
            write_dataset(scene, settings, views, args.out)
    except BrokenPipeError:  # of the output, whose reader has gone
        raise
    except OSError as error:
        raise UserError(f"{error.filename or args.out}: {why_refused(error)}") from None
    except KeyboardInterrupt:
        print("\nthe same command continues", file=sys.stderr)
        raise


def _given(args: argparse.Namespace) -> dict[str, object]:
    """The settings that the command line names."""
    options = {field.name: getattr(args, field.name) for field in fields(CaptureSettings)}
    given = {name: value for name, value in options.items() if value is not None}
    given = {name: tuple(v) if isinstance(v, list) else v for name, v in given.items()}
    return given | ({"fov": math.radians(given["fov"])} if "fov" in given else {})


def _wide_degrees(text: str) -> float:
    """A field of view; one of at most pi would be radians, in which it once was given."""
    angle = degrees(text)
    if angle <= math.pi:
        raise argparse.ArgumentTypeError(
            f"must be in degrees, more than {math.pi:.4g}, got {text}; if these are radians, give "
            f"--fov {math.degrees(angle):.4g}"
        )
    return angle


def refuse_splats(path: Path, scene: mi.Scene) -> None:
    """Raise :class:`UserError` for a scene whose pictures by path tracing would lack its splats."""
    integrator = scene.integrator()
    nested = [] if integrator is None else mi.traverse(integrator).hierarchy  # itself included
    if any(map(is_splats, nested)):
        found = "its integrator is splats"
    elif any("Ellipsoids" in node.class_name() for node in mi.traverse(scene).hierarchy):
        found = "it has shapes of type ellipsoids"
    else:
        return
    raise UserError(
        f"{path}: the scene holds splats ({found}), which path tracing leaves out; take pictures "
        f"of it with python -m drgs.render {path} --out DIR, or remove the splats from the file"
    )


def described(settings: CaptureSettings, count: int) -> str:
    """One line: where the cameras stand."""
    fov = f"field of view {math.degrees(settings.fov):.4g} degrees"
    if settings.cameras == "sensors":
        return f"cameras: the scene's own sensors, {count}"
    if settings.cameras == "inside":
        spot = ", ".join(f"{value:.4g}" for value in settings.target)
        return f"cameras: {count} inside the scene, around ({spot}), {fov}"
    return f"cameras: {count} around the scene, {fov}"


def take_pictures(
    scene: mi.Scene,
    settings: CaptureSettings,
    views: list[CaptureView],
    out: Path,
    claim: Callable[[], None],
) -> None:
    """Take the pictures that are not in ``out`` yet; say so where most show nothing.

    claim: makes the folder this capture's. It is called when the first picture is taken: until then
    the scene may turn out to be one that cannot be captured.
    """
    camera = CaptureCamera(scene, settings)
    missing = spread_first([view for view in views if not picture_path(out, view).exists()])
    there = len(views) - len(missing)
    if there:
        print(f"{there} of {len(views)} pictures are there already")
    shown = []
    if not missing:
        claim()
    with RunProgress("picture", len(views), there) as progress:
        for done, view in enumerate(missing, there + 1):
            picture = camera.picture(view)
            if not shown:
                claim()
            write_png(picture_path(out, view), picture)
            shown.append(shows_something(picture))
            if len(shown) == min(FIRST, len(missing)) and sum(shown) < len(shown) / 2:
                print(_empty(shown, settings.cameras), file=sys.stderr, flush=True)
            progress.update(done, len(views))


def spread_first(views: list[CaptureView]) -> list[CaptureView]:
    """The views in another order: those come first that tell what all will be like.

    Neighbours in the list are at similar heights. What a picture shows does not depend on when it
    is taken.
    """
    chosen = range(0, len(views), max(1, len(views) // FIRST))[:FIRST]
    rest = sorted(set(range(len(views))) - set(chosen))
    return [views[index] for index in (*chosen, *rest)]


def shows_something(picture: np.ndarray) -> bool:
    """Whether a picture, (H, W, 4) uint8, is not empty, and light reaches most of what it shows."""
    covered = float((picture[:, :, 3] > 0).mean())
    return covered >= LEAST_COVERED and lit_part(picture) >= MOST


def _empty(shown: list[bool], cameras: str) -> str:
    """A warning that most pictures are empty, and what to do about it."""
    remedy = {
        "around": "give --cameras inside for a room, or --azimuth, --elevation, --target and "
        "--distance",
        "inside": "give --target, or --cameras around",
        "sensors": "give --cameras around or inside",
    }[cameras]
    return (
        f"warning: {len(shown) - sum(shown)} of the first {len(shown)} pictures are empty or "
        f"black: {remedy}, and another --out; or give the scene light"
    )


def write_dataset(
    scene: mi.Scene, settings: CaptureSettings, views: list[CaptureView], out: Path
) -> None:
    """Write what belongs to the pictures: points and transforms files.

    Those that are there stay, as pictures do: they are whole, and may have been edited since.
    """
    if settings.points and not (out / POINTS).exists():
        positions, colors = visible_points(scene, settings, views, out)
        if len(positions):
            write_points(out / POINTS, positions, colors)
            print(f"{len(positions):,} points: {out / POINTS}")
        else:
            print("no points: the pictures to train on show no surface")
    # The layout is recognised by the training split's file, so that one comes last.
    for split in reversed(SPLITS):
        path = out / f"transforms_{split}.json"
        if settings.count(split) and not path.exists():
            write_transforms(path, settings, views, split)
    counted = ", ".join(f"{settings.count(s)} {s}" for s in SPLITS if settings.count(s))
    width, height = settings.size
    print(f"written: {out}: {counted} views, {width}x{height}, {settings.spp} spp")
    print(f"fit it with: {fitting(out, settings)}")


def fitting(out: Path, settings: CaptureSettings) -> str:
    """The command that fits the capture in ``out``, as a shell reads it."""
    words = ["python", "-m", "drgs.fit", "scenes/photos.yml", "--data", str(out)]
    if (out / POINTS).exists():
        words += ["--set", f"init.point_cloud={out / POINTS}"]
    if not settings.test_views and not settings.val_views:
        words += ["--set", "data.test_split=train"]
    return shlex.join(words)


def manifest(path: Path, settings: CaptureSettings) -> dict[str, object]:
    """What decides the bytes of a capture; after :func:`load_scene`."""
    return {
        "scene": path.name,
        "scene_sha256": fingerprint(path),
        "mitsuba": mi.__version__,
        **asdict(settings),
    }


def fingerprint(path: Path) -> str:
    """SHA-256 of a scene file and of the modules that it imported from its own folder."""
    folder = path.parent.resolve()
    modules = [Path(getattr(module, "__file__", None) or "/") for module in sys.modules.values()]
    sources = sorted({path.resolve(), *(m.resolve() for m in modules if m.parent == folder)})
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()


def check_folder(out: Path, wanted: dict[str, object]) -> None:
    """Raise :class:`UserError` where ``out`` is neither a new or empty folder nor this capture's.

    Hidden files do not count: a desktop's, or temporary ones of a capture that was killed before
    its first file was in place. wanted: see :func:`manifest`.
    """
    if out.exists() and not out.is_dir():
        raise UserError(f"{out}: --out must be a folder, got a file")
    if _is_empty(out):
        return
    if not (out / MANIFEST).is_file():
        raise UserError(f"{out}: the folder is not empty and holds no {MANIFEST}; {REMEDY}")
    _check_manifest(out / MANIFEST, json.loads(json.dumps(wanted)))


def claim_folder(out: Path, wanted: dict[str, object]) -> None:
    """Make ``out`` the folder of this capture, or raise as :func:`check_folder`."""
    check_folder(out, wanted)
    if _is_empty(out):
        with atomic_path(out / MANIFEST) as temporary:
            temporary.write_text(json.dumps(wanted, indent=2) + "\n")
    remove_stale_temporaries(out)


def _is_empty(out: Path) -> bool:
    return not out.exists() or all(child.name.startswith(".") for child in out.iterdir())


def _check_manifest(path: Path, wanted: dict[str, object]) -> None:
    """Raise :class:`UserError` where ``path`` is of another capture than the one wanted."""
    try:
        found = json.loads(read_text(path, "settings of the capture", MAX_MANIFEST_BYTES))
    except (ValueError, RecursionError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path}: not valid JSON: {one_line(error)}; {REMEDY}") from None
    # Earlier versions stood around a scene only.
    found = BEFORE | (found if isinstance(found, dict) else {})
    if isinstance(found.get("size"), int):  # earlier versions': pictures were squares
        found["size"] = [found["size"]] * 2
    for key, value in wanted.items():
        if found.get(key) != value:
            theirs, ours = (_shown(key, values.get(key)) for values in (found, wanted))
            raise UserError(
                f"{path}: the folder holds another capture: {key} is {theirs}, asked for is "
                f"{ours}; {REMEDY}"
            )


def _shown(key: str, value: object) -> str:
    """A value of the manifest in the unit of its option."""
    if key == "fov" and isinstance(value, float):
        value = round(math.degrees(value), 4)
    return one_line(json.dumps(value), 120)


def write_transforms(
    path: Path, settings: CaptureSettings, views: list[CaptureView], split: str
) -> None:
    """Write one ``transforms_*.json``; numbers have all digits of their float64."""
    frames = [
        {"file_path": view.file_path, "transform_matrix": view.pose.tolist()}
        | ({} if view.fov == settings.fov else {"camera_angle_x": view.fov})
        for view in views
        if view.split == split
    ]
    with atomic_path(path) as temporary:
        content = {"camera_angle_x": settings.fov, "frames": frames}
        temporary.write_text(json.dumps(content, indent=1) + "\n")


def write_points(path: Path, positions: np.ndarray, colors: np.ndarray) -> None:
    """A PLY of points: positions (N, 3) world, colours (N, 3) uint8 display space."""
    columns = [(name, "<f4") for name in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    rows = np.empty(len(positions), columns)
    for axis, name in enumerate("xyz"):
        rows[name] = positions[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, channel]
    # Not to the file itself: numpy's errors of a full disk say neither which file nor why.
    stream = io.BytesIO()
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(stream)
    with atomic_path(path) as temporary:
        temporary.write_bytes(stream.getbuffer())


if __name__ == "__main__":
    main()
