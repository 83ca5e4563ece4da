"""``python -m drgs.capture SCENE --out DIR``: turn a Mitsuba scene into a training set.

SCENE is an XML file, or a Python file with a function ``scene()`` that returns a scene dictionary
without sensors. Its pictures are path traced from cameras on the upper hemisphere around it and
written in the NeRF-synthetic layout:

- ``transforms_{train,val,test}.json``: ``camera_angle_x`` and camera to world, OpenGL axes
- ``{train,val,test}/r_0.png``, ...: RGBA, 8 bits, straight alpha, colour in sRGB
- ``points3d.ply``: what the training cameras see first, a start for ``init.point_cloud``
- ``capture.json``: what was asked for; a second run of the same command continues an interrupted
  one from it

The scene's own sensors and integrator are not used. Lights are not seen, only what they light:
alpha is the part of a pixel that surfaces cover (an opacity mask counts, glass is opaque).

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
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from plyfile import PlyData, PlyElement

from drgs.cli.errors import exit_on_user_error
from drgs.cli.interrupts import INTERRUPTED_STATUS
from drgs.cli.progress import LOG_SECONDS
from drgs.core.errors import UserError
from drgs.core.files import atomic_path, why_refused
from drgs.data.path_tracing import (
    SPLITS,
    Camera,
    CaptureSettings,
    CaptureView,
    _option,
    load_scene,
    orbit,
    picture_path,
    plan,
    visible_points,
)
from drgs.io.pictures import write_png

MANIFEST = "capture.json"
POINTS = "points3d.ply"


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the command."""
    args = vars(_parse(arguments))
    path, out, variant = Path(args.pop("scene")), Path(args.pop("out")), args.pop("variant")
    with exit_on_user_error():
        try:
            settings = CaptureSettings(**args)
            if not path.is_file():
                raise UserError(f"{path}: there is no such scene file")
            mi.set_variant(variant)
            scene = load_scene(path)
            target, distance = orbit(scene, settings)
            claim_folder(out, manifest(path, settings))
            run(scene, settings, plan(settings, target, distance), out)
        except OSError as error:
            raise UserError(f"{error.filename or out}: {why_refused(error)}") from None
        except KeyboardInterrupt:
            print("\ninterrupted; the same command continues", file=sys.stderr)
            sys.exit(INTERRUPTED_STATUS)


def run(scene: mi.Scene, settings: CaptureSettings, shots: list[CaptureView], out: Path) -> None:
    """Take the pictures that are not in ``out`` yet, then write points and transforms files."""
    camera = Camera(scene, settings)
    missing = [shot for shot in shots if not picture_path(out, shot).exists()]
    for shot in progress(missing, len(shots)):
        picture = camera.picture(shot)
        write_png(picture_path(out, shot), picture)
    if settings.points:
        positions, colors = visible_points(scene, settings, shots, out)
        write_points(out / POINTS, positions, colors)
        print(f"{len(positions):,} points; start from them: --set init.point_cloud={out / POINTS}")
    # The layout is recognised by the training split's file, so that one comes last.
    for split in reversed(SPLITS):
        if settings.count(split):
            write_transforms(out / f"transforms_{split}.json", settings, shots, split)
    counted = ", ".join(f"{settings.count(s)} {s}" for s in SPLITS if settings.count(s))
    print(f"written: {out}: {counted} views, {settings.size}x{settings.size}, {settings.spp} spp")


# Folder ------------------------------------------------------------------------------------------


def manifest(path: Path, settings: CaptureSettings) -> dict[str, Any]:
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


def claim_folder(out: Path, wanted: dict[str, Any]) -> None:
    """Make ``out`` the folder of this capture: a new or empty one, or one that it began.

    Raises :class:`UserError` where it holds anything else.
    """
    path = out / MANIFEST
    wanted = json.loads(json.dumps(wanted))
    if out.exists() and not out.is_dir():
        raise UserError(f"{out}: --out must be a folder, got a file")
    if not out.exists() or not any(out.iterdir()):
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(wanted, indent=2) + "\n")
        return
    remedy = "choose another --out, or remove it"
    if not path.is_file():
        raise UserError(f"{out}: the folder is not empty and holds no {MANIFEST}; {remedy}")
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UserError(f"{path}: not valid JSON: {error}; {remedy}") from None
    found = found if isinstance(found, dict) else {}
    for key, value in wanted.items():
        if found.get(key) != value:
            raise UserError(
                f"{path}: the folder holds another capture: {key} is {json.dumps(found.get(key))}, "
                f"asked for is {json.dumps(value)}; {remedy}"
            )


def write_transforms(
    path: Path, settings: CaptureSettings, shots: list[CaptureView], split: str
) -> None:
    """Write one ``transforms_*.json``; numbers have all digits of their float64."""
    frames = [
        {"file_path": shot.file_path, "transform_matrix": shot.pose.tolist()}
        for shot in shots
        if shot.split == split
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
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(temporary))


# Scene -------------------------------------------------------------------------------------------


# Cameras -----------------------------------------------------------------------------------------


# Pictures ----------------------------------------------------------------------------------------


# Points ------------------------------------------------------------------------------------------


# Command line ------------------------------------------------------------------------------------


def progress(missing: list[CaptureView], total: int) -> Iterator[CaptureView]:
    """The shots one by one, with a line that says how far they are."""
    terminal = sys.stdout.isatty()
    started = last = time.monotonic()
    if len(missing) < total:
        print(f"{total - len(missing)} of {total} pictures are there already")
    for done, shot in enumerate(missing, 1):
        yield shot
        now = time.monotonic()
        if terminal or now - last >= LOG_SECONDS or done == len(missing):
            last = now
            left = int((now - started) / done * (len(missing) - done))
            line = (
                f"picture {total - len(missing) + done}/{total}  left {left // 60}:{left % 60:02d}"
            )
            print(f"\r{line}  " if terminal else line, end="" if terminal else "\n", flush=True)
    if terminal and missing:
        print()


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m drgs.capture",
        description="Turn a Mitsuba scene into a training set in the NeRF-synthetic layout.",
    )
    parser.add_argument(
        "scene", metavar="SCENE", help="XML file, or Python file with a function scene()"
    )
    parser.add_argument("--out", metavar="DIR", required=True, help="folder to write")
    default = {field.name: field.default for field in fields(CaptureSettings)}
    for name, text in {
        "views": "pictures to train on",
        "val_views": "pictures of the split val",
        "test_views": "pictures of the split test",
        "size": "width and height in px",
        "spp": "paths per pixel",
        "max_depth": "longest path",
        "points": f"number of points in {POINTS}",
        "seed": "of cameras, paths and points",
    }.items():
        text = f"{text} (default: {default[name]})"
        parser.add_argument(_option(name), type=int, default=default[name], metavar="N", help=text)
    parser.add_argument(
        "--fov",
        type=float,
        default=default["fov"],
        metavar="RADIANS",
        help="field of view (default: the original's %(default).4f)",
    )
    parser.add_argument(
        "--distance",
        type=float,
        help="of the cameras from the target (default: the whole scene is in the picture)",
    )
    parser.add_argument(
        "--target",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="what the cameras look at (default: the middle of the bounding box)",
    )
    parser.add_argument(
        "--up", choices=("x", "y", "z"), default=default["up"], help="axis (default: z)"
    )
    parser.add_argument(
        "--variant",
        choices=("llvm_ad_rgb", "cuda_ad_rgb"),
        default="llvm_ad_rgb",
        help="of Mitsuba (default: llvm_ad_rgb)",
    )
    args = parser.parse_args(arguments)
    args.target = args.target and tuple(args.target)
    return args


if __name__ == "__main__":
    main()
