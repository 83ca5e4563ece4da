"""``python -m drgs.capture SCENE --out DIR``: turn a Mitsuba scene into a training set.

Layer 5. SCENE is an XML file, or a Python file with a function ``scene()`` that returns a scene
dictionary without sensors. Its pictures are path traced from cameras on the upper hemisphere
around it and written in the NeRF-synthetic layout:

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
import importlib.util
import json
import math
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import Any

import drjit as dr
import imageio.v3 as iio
import mitsuba as mi
import numpy as np
from plyfile import PlyData, PlyElement

from drgs.checks import UserError, exit_on_user_error, one_line
from drgs.data.images import read_image
from drgs.files import atomic_path, why_refused
from drgs.interrupts import INTERRUPTED_STATUS
from drgs.progress import LOG_SECONDS
from drgs.viewpoints import look_at

NERF_SYNTHETIC_FOV = 0.6911112070083618
"""Radians: the original's ``camera_angle_x``."""

SPLITS = ("train", "val", "test")
MANIFEST = "capture.json"
POINTS = "points3d.ply"

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Of camera axes: y and z change sign."""

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))

PATHS_PER_PASS = 2**24
"""Paths traced at once, at most: their state takes a few hundred MiB."""

SAMPLES_PER_PASS = 64
"""Per pixel, a square: they are stratified together (8x8 multi-jittered), which leaves about half
the noise variance of as many independent ones."""

NEAR_CLIP, FAR_CLIP = 1e-5, 1e5
"""Of the bounding box's diagonal."""

MAX_LAMPS_IN_A_ROW = 16
"""Surfaces that shine are passed through on the way to the first hit, this many at most."""


@dataclass(frozen=True)
class CaptureSettings:
    """What the pictures depend on, beside the scene."""

    views: int = 100  # to train on
    val_views: int = 0
    test_views: int = 25
    size: int = 400  # px, width and height
    spp: int = 256  # paths per pixel
    max_depth: int = 8  # segments of a path
    fov: float = NERF_SYNTHETIC_FOV  # radians
    distance: float | None = None  # of the cameras from the target; None: all is in the picture
    target: tuple[float, float, float] | None = None  # None: centre of the bounding box
    up: str = "z"
    points: int = 100_000
    seed: int = 0

    def __post_init__(self) -> None:
        least = {"views": 1, "val_views": 0, "test_views": 0, "size": 1, "spp": 1, "max_depth": 1}
        for name, minimum in {**least, "points": 0, "seed": 0}.items():
            value = getattr(self, name)
            if value < minimum:
                raise UserError(f"{_option(name)} must be >= {minimum}, got {value}")
        if not 0 < self.fov < math.pi:
            raise UserError(f"--fov must be between 0 and pi (radians), got {self.fov:g}")
        if self.distance is not None and not 0 < self.distance < math.inf:
            raise UserError(f"--distance must be > 0, got {self.distance:g}")
        if self.target is not None and not np.isfinite(self.target).all():
            raise UserError(f"--target must be finite, got {self.target}")

    def count(self, split: str) -> int:
        """Number of views of a split."""
        return {"train": self.views, "val": self.val_views, "test": self.test_views}[split]


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture to take."""

    split: str
    index: int
    pose: np.ndarray  # (4, 4) float64 camera to world, OpenGL axes: x right, y up, z backward

    @property
    def file_path(self) -> str:
        """As the transforms file names it, without the suffix."""
        return f"./{self.split}/r_{self.index}"


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


def run(scene: mi.Scene, settings: CaptureSettings, shots: list[Shot], out: Path) -> None:
    """Take the pictures that are not in ``out`` yet, then write points and transforms files."""
    camera = Camera(scene, settings)
    missing = [shot for shot in shots if not picture_path(out, shot).exists()]
    for shot in progress(missing, len(shots)):
        picture = camera.picture(shot)
        with atomic_path(picture_path(out, shot)) as temporary:
            iio.imwrite(temporary, picture)
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


def picture_path(out: Path, shot: Shot) -> Path:
    """Where a picture is written."""
    return out / f"{shot.file_path}.png"


def write_transforms(path: Path, settings: CaptureSettings, shots: list[Shot], split: str) -> None:
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


def load_scene(path: Path) -> mi.Scene:
    """The scene that an XML or a Python file describes.

    Raises :class:`UserError` where it describes none.
    """
    if path.suffix == ".py":
        description = _scene_dictionary(path)
        mi.file_resolver().append(str(path.parent.resolve()))
    try:
        scene = mi.load_dict(description) if path.suffix == ".py" else mi.load_file(str(path))
    except (RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: Mitsuba cannot load the scene: {one_line(error)}") from None
    if not isinstance(scene, mi.Scene):
        raise UserError(f"{path}: must describe a scene, got a {type(scene).__name__}")
    return scene


def _scene_dictionary(path: Path) -> dict[str, Any]:
    """What ``scene()`` of a Python file returns."""
    try:
        function = getattr(_import(path), "scene", None)
        if not callable(function):
            raise UserError(f"{path}: must define a function scene() that returns a dictionary")
        description = function()
    except UserError:
        raise
    except Exception as error:
        lines = [
            f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(path)
        ]
        if isinstance(error, SyntaxError):
            lines = [error.lineno]
        line = f":{lines[-1]}" if lines else ""
        raise UserError(f"{path}{line}: {type(error).__name__}: {one_line(error)}") from None
    if not isinstance(description, dict) or description.get("type") != "scene":
        raise UserError(f'{path}: scene() must return a dictionary with "type": "scene"')
    return description


def _import(path: Path) -> ModuleType:
    name = f"drgs_capture_scene_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    # As for a script: its neighbours can be imported.
    sys.path.insert(0, str(path.parent.resolve()))
    spec.loader.exec_module(module)
    return module


def bounding_box(scene: mi.Scene) -> tuple[np.ndarray, np.ndarray]:
    """(3,) lowest and highest coordinates of the surfaces that do not shine."""
    boxes = [shape.bbox() for shape in scene.shapes() if not shape.is_emitter()]
    corners = np.array([[box.min, box.max] for box in boxes if box.valid()]).reshape(-1, 2, 3)
    if not len(corners):
        raise UserError("the scene has no surfaces that cameras could see (lights are hidden)")
    return corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)


# Cameras -----------------------------------------------------------------------------------------


def orbit(scene: mi.Scene, settings: CaptureSettings) -> tuple[np.ndarray, float]:
    """What the cameras look at, (3,) world, and their distance from it.

    Without ``distance``, the bounding box's sphere just fits between the edges of the picture:
    radius / sin(fov / 2). The original's 4.03 is 10% less: its box has empty corners.
    """
    low, high = bounding_box(scene)
    target = (low + high) / 2 if settings.target is None else np.array(settings.target)
    if settings.distance is not None:
        return target, settings.distance
    return target, float(np.linalg.norm(high - low)) / 2 / math.sin(settings.fov / 2)


def plan(settings: CaptureSettings, target: np.ndarray, distance: float) -> list[Shot]:
    """All pictures with their cameras, split after split."""
    shots = []
    for number, split in enumerate(SPLITS):
        rng = np.random.default_rng([settings.seed, number])
        # Test views lie evenly; training views at random, but without gaps.
        jitter = 0.0 if split == "test" else 1.0
        directions = hemisphere(settings.count(split), jitter, rng)
        directions = np.roll(directions, "zxy".index(settings.up), axis=1)
        up = np.eye(3)["xyz".index(settings.up)]
        shots += [
            Shot(
                split, index, look_at(target + distance * direction, target, up) @ OPENCV_TO_OPENGL
            )
            for index, direction in enumerate(directions)
        ]
    return shots


def hemisphere(count: int, jitter: float, rng: np.random.Generator) -> np.ndarray:
    """(count, 3): unit vectors with z > 0, of equal density per solid angle.

    A golden-angle spiral from the rim to the pole: equal steps of height are equal areas (the
    sphere's hat-box theorem). ``jitter`` 1 moves each within its own step, 0 not at all; ``rng``
    turns the whole spiral.
    """
    step = np.arange(count)
    offset = rng.uniform(0, 2 * math.pi)
    moved = jitter * rng.uniform(-0.5, 0.5, (2, count))
    height = (step + 0.5 + moved[0]) / max(count, 1)
    azimuth = offset + GOLDEN_ANGLE * (step + moved[1])
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)


# Pictures ----------------------------------------------------------------------------------------


class Camera:
    """Takes pictures of a scene with one Mitsuba sensor that is moved around."""

    def __init__(self, scene: mi.Scene, settings: CaptureSettings) -> None:
        self._scene, self._settings = scene, settings
        low, high = bounding_box(scene)
        diagonal = float(np.linalg.norm(high - low))
        self._integrator = mi.load_dict(
            {"type": "path", "max_depth": settings.max_depth, "hide_emitters": True}
        )
        self._sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov_axis": "x",
                "fov": math.degrees(settings.fov),
                # Rays start at the near plane: nothing in front of a camera is left out.
                "near_clip": NEAR_CLIP * diagonal,
                "far_clip": FAR_CLIP * diagonal,
                "film": {
                    "type": "hdrfilm",
                    "width": settings.size,
                    "height": settings.size,
                    "pixel_format": "rgba",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "multijitter"},
            }
        )
        self._parameters = mi.traverse(self._sensor)

    def picture(self, shot: Shot) -> np.ndarray:
        """(size, size, 4) uint8: straight alpha, colour in display space."""
        linear = self.linear(shot)
        if not np.isfinite(linear).all():
            y, x = np.argwhere(~np.isfinite(linear).all(axis=2))[0]
            raise UserError(f"{shot.file_path}: the light at pixel x {x}, y {y} is not finite")
        return encode(linear)

    def linear(self, shot: Shot) -> np.ndarray:
        """(size, size, 4) float64: radiance times alpha, and alpha."""
        # Mitsuba's cameras have x to the left and look along z.
        to_world = shot.pose @ np.diag([-1.0, 1.0, -1.0, 1.0])
        self._parameters["to_world"] = mi.Transform4f(to_world)
        self._parameters.update()
        size, spp = self._settings.size, self._settings.spp
        at_once = min(SAMPLES_PER_PASS, max(1, math.isqrt(PATHS_PER_PASS // size**2) ** 2))
        counts = [min(at_once, spp - start) for start in range(0, spp, at_once)]
        entropy = [self._settings.seed, SPLITS.index(shot.split), shot.index]
        seeds = np.random.SeedSequence(entropy).generate_state(len(counts))
        total = np.zeros((size, size, 4))
        for count, seed in zip(counts, seeds, strict=True):
            image = mi.render(
                self._scene,
                sensor=self._sensor,
                integrator=self._integrator,
                seed=int(seed),
                spp=count,
            )
            total += count * np.array(image, np.float64)
        return total / spp


def encode(linear: np.ndarray) -> np.ndarray:
    """(H, W, 4) uint8 straight sRGB and alpha, from premultiplied linear radiance and alpha.

    Light beyond white is cut off. Where alpha rounds to zero the colour is black, not noise.
    """
    alpha = np.clip(linear[:, :, 3:], 0, 1)
    color = np.clip(linear[:, :, :3] / np.maximum(alpha, 1e-9), 0, 1)
    display = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    rgba = np.round(np.concatenate([display, alpha], axis=2) * 255).astype(np.uint8)
    rgba[rgba[:, :, 3] == 0] = 0
    return rgba


# Points ------------------------------------------------------------------------------------------


def visible_points(
    scene: mi.Scene, settings: CaptureSettings, shots: list[Shot], out: Path
) -> tuple[np.ndarray, np.ndarray]:
    """First hits of random rays: positions (N, 3) float32 world, colours (N, 3) uint8.

    Each training view has the same share of ``settings.points``, spread evenly over what is
    covered of its picture; the colour is that of the pixel in the written picture.
    """
    train = [shot for shot in shots if shot.split == "train"]
    positions, colors = [], []
    for number, shot in enumerate(train):
        share = (number + 1) * settings.points // len(train) - number * settings.points // len(
            train
        )
        rng = np.random.default_rng([settings.seed, len(SPLITS), shot.index])
        picture = read_image(picture_path(out, shot)).reshape(-1, 4)
        weights = picture[:, 3].astype(np.float64)
        if not weights.any():
            continue
        # At the edge of a surface a ray can miss it, so draw more than are kept.
        pixels = rng.choice(len(picture), 2 * share + 64, p=weights / weights.sum())
        rows, columns = np.divmod(pixels, settings.size)
        spots = np.stack([columns, rows], axis=1) + rng.uniform(size=(len(pixels), 2))
        hits, valid = first_hits(scene, shot.pose[:3, 3], view_rays(shot.pose, spots, settings))
        positions.append(hits[valid][:share])
        colors.append(np.round(picture[pixels[valid], :3] * 255).astype(np.uint8)[:share])
    if not sum(map(len, positions)):
        raise UserError("the cameras see nothing of the scene: give --target and --distance")
    return np.concatenate(positions), np.concatenate(colors)


def view_rays(pose: np.ndarray, spots: np.ndarray, settings: CaptureSettings) -> np.ndarray:
    """(N, 3): unit directions, world, through (N, 2) places x, y in px of a picture."""
    focal = 0.5 * settings.size / math.tan(0.5 * settings.fov)
    offset = (spots - settings.size / 2) / focal
    local = np.stack([offset[:, 0], -offset[:, 1], -np.ones(len(spots))], axis=1)
    directions = local @ pose[:3, :3].T
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def first_hits(
    scene: mi.Scene, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) float32 world, where rays meet a surface that does not shine; (N,) bool if any."""
    ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(directions.T))
    for _ in range(MAX_LAMPS_IN_A_ROW):
        hit = scene.ray_intersect(ray)
        lamp = hit.is_valid() & hit.shape.is_emitter()
        if not dr.any(lamp):
            break
        ray = dr.select(lamp, hit.spawn_ray(ray.d), ray)
    return np.array(hit.p).T, np.array(hit.is_valid() & ~lamp)


# Command line ------------------------------------------------------------------------------------


def progress(missing: list[Shot], total: int) -> Iterator[Shot]:
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


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


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
