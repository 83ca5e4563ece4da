"""Path traced images of a Mitsuba scene.

Lights themselves are hidden. Alpha is the part of a pixel that surfaces cover
(an opacity mask counts, glass is opaque); the colour is the mean colour c of that part, as both
channels of the film's premultiplied linear image (a c, a) come from the same samples. The colour is
encoded first and composited then, a srgb(c) + (1 - a) background, as in Blender's images of
NeRF-synthetic and as splats are composited.

Each pixel is the plain mean of the samples inside it (a box filter), which alone Mitsuba
accumulates in a reproducible order: the same settings give the same bytes.
"""

from __future__ import annotations

import importlib.util
import math
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.cameras.viewpoints import OPENGL_TO_MITSUBA
from drgs.core.errors import UserError, one_line, reason_of_mitsuba
from drgs.core.types import Bool
from drgs.integrator.scene import film_description
from drgs.integrator.state import is_splats
from drgs.io.images import to_uint8
from drgs.io.scenes import load_scene_dictionary, load_scene_file

NERF_SYNTHETIC_FOV = 0.6911112070083618  # radians: its ``camera_angle_x``

SPLITS = ("train", "val", "test")

PATHS_PER_PASS = 2**24  # paths traced at once, at most: their state takes a few hundred MiB

SAMPLES_PER_PASS = 64
"""Per pixel, a square: together stratified (8x8 multi-jittered) samples have about half the noise
variance of independent ones."""

NEAR_CLIP, FAR_CLIP = 1e-5, 1e5  # of the bounding box's diagonal
MAX_BLACK = 2  # largest channel of a black pixel, of 255
MIN_LIT_PART = 0.5  # of the covered pixels: fewer are lit where a camera stands wrong

MAX_LAMPS_IN_A_ROW = 16  # surfaces that shine, before the first hit of a ray that passes them

SIGHT_RAYS = 64
"""Rays through an image along both sides: a fit cannot use anything smaller than their spacing."""


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of the images."""

    views: int = 100  # to train on
    val_views: int = 0
    test_views: int = 25
    size: tuple[int, int] = (400, 400)  # px, width and height
    spp: int = 256  # paths per pixel
    max_depth: int = 8  # segments of a path
    fov: float = NERF_SYNTHETIC_FOV  # radians, horizontal
    distance: float | None = None  # of the cameras from the target; None: all is in the image
    target: tuple[float, float, float] | None = None  # None: centre of the bounding box
    up: str = "z"
    points: int = 100_000
    seed: int = 0
    cameras: str = "around"  # one of drgs.capture.camera_placement.KINDS
    azimuth: tuple[float, float] | None = None  # degrees about up; None: all around
    elevation: tuple[float, float] | None = None  # degrees; None: 0 to 90

    def __post_init__(self) -> None:
        width, height = self.size
        if width * height > PATHS_PER_PASS:
            raise UserError(
                f"size must be at most {PATHS_PER_PASS:,} px in all, got {width} x {height}"
            )
        if self.distance is not None and not 0 < self.distance < math.inf:
            raise UserError(f"distance must be > 0, got {self.distance:g}")
        for name, turn in (("azimuth", 360), ("elevation", 90)):
            low, high = getattr(self, name) or (0, 0)
            if not -turn <= low <= high <= turn:
                raise UserError(
                    f"{name} must be two angles in rising order between -{turn} and {turn} "
                    f"degrees, got {low:g} and {high:g}"
                )

    @property
    def narrower_fov(self) -> float:
        """The smaller one of the horizontal and the vertical field of view, radians."""
        width, height = self.size
        return scale_fov(self.fov, min(1.0, height / width))

    def count(self, split: str) -> int:
        """Return the number of views of a split."""
        return {"train": self.views, "val": self.val_views, "test": self.test_views}[split]


def scale_fov(fov: float, ratio: float) -> float:
    """Return the field of view, radians, along a side that is ``ratio`` times as long."""
    return fov if ratio == 1 else 2 * math.atan(ratio * math.tan(fov / 2))


@dataclass(frozen=True, eq=False)
class CaptureView:
    """Image to take."""

    split: str
    index: int
    pose: np.ndarray  # (4, 4) float64 camera to world, OpenGL axes: x right, y up, z backward
    fov: float  # radians, horizontal

    @property
    def file_path(self) -> str:
        """The image's name in the transforms file, without the suffix."""
        return f"./{self.split}/r_{self.index}"


def load_scene(path: Path) -> mi.Scene:
    """Load XML, or a Python file's ``scene()``; UserError: missing, or of another variant."""
    try:
        if path.suffix == ".py":
            scene = load_scene_dictionary(_scene_dictionary(path), path)
        else:
            scene = load_scene_file(path)
    except UserError:
        raise
    except (RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path}: Mitsuba cannot load the scene: {reason_of_mitsuba(error)}"
        ) from None
    if not isinstance(scene, mi.Scene):
        raise UserError(f"{path}: must describe a scene, got a {type(scene).__name__}")
    return scene


def _scene_dictionary(path: Path) -> dict[str, object]:
    """Return ``scene()`` of a Python file; files in its folder are found by name."""
    variant = mi.variant()
    assert variant is not None, "the command selects one"
    try:
        description = _import(path).scene()
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if frame.filename == str(path)]
        if isinstance(error, SyntaxError):
            lines = [error.lineno]
        line = f":{lines[-1]}" if lines else ""
        raise UserError(
            f"{path}{line}: {type(error).__name__}: {one_line(error)}; it must define a function "
            "scene() that returns a dictionary"
        ) from None
    finally:
        other = mi.variant()
        mi.set_variant(variant)
    if other != variant:
        raise UserError(
            f"{path}: must leave Mitsuba's variant at {variant}, got mi.set_variant({other!r}); "
            "choose a variant with --variant"
        )
    if not isinstance(description, dict) or description.get("type") != "scene":
        raise UserError(f'{path}: scene() must return a dictionary with "type": "scene"')
    resolver = mi.file_resolver()  # pyright: ignore[reportCallIssue]  # not in the stub
    resolver.append(str(path.parent.resolve()))
    return description


def _import(path: Path) -> ModuleType:
    name = f"drgs_capture_scene_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None, "the file's name ends in .py"
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    # As a script, it can import its neighbours.
    sys.path.insert(0, str(path.parent.resolve()))
    spec.loader.exec_module(module)
    return module


def refuse_splats(path: Path, scene: mi.Scene) -> None:
    """Raise :class:`UserError` for a scene with splats, which path tracing would leave out."""
    integrator = scene.integrator()
    nested = [] if integrator is None else mi.traverse(integrator).hierarchy  # itself included
    if any(map(is_splats, nested)):
        evidence = "its integrator is splats"
    elif any("Ellipsoids" in node.class_name() for node in mi.traverse(scene).hierarchy):
        evidence = "it has shapes of type ellipsoids"
    else:
        return
    raise UserError(
        f"{path}: the scene holds splats ({evidence}), which path tracing leaves out; take images "
        f"of it with python -m drgs.render {path} --out DIR, or remove the splats from the file"
    )


def bounding_box(scene: mi.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest coordinates, (3,), of the surfaces that do not shine."""
    boxes = [shape.bbox() for shape in scene.shapes() if not shape.is_emitter()]
    corners = np.array([[box.min, box.max] for box in boxes if box.valid()]).reshape(-1, 2, 3)
    if not len(corners):
        raise UserError("the scene has no surfaces that cameras could see (lights are hidden)")
    low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    if not 0 < np.linalg.norm(np.float64(high) - low) < math.inf:
        raise UserError(f"the scene's bounding box must have a size, got {low} to {high}")
    return low, high


class CaptureCamera:
    """A Mitsuba sensor that is moved from view to view of a scene."""

    def __init__(self, scene: mi.Scene, settings: CaptureSettings) -> None:
        self._scene, self._settings = scene, settings
        low, high = bounding_box(scene)
        diagonal = float(np.linalg.norm(high - low))
        depth = settings.max_depth
        self._integrator = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": True})
        self._sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov_axis": "x",
                "fov": math.degrees(settings.fov),
                # Rays start at the near plane: nothing in front of a camera is left out.
                "near_clip": NEAR_CLIP * diagonal,
                "far_clip": FAR_CLIP * diagonal,
                "film": film_description(*settings.size) | {"pixel_format": "rgba"},
                "sampler": {"type": "multijitter"},
            }
        )
        self._parameters = mi.traverse(self._sensor)

    def image(self, view: CaptureView) -> np.ndarray:
        """Return (H, W, 4) uint8: straight alpha, colour in display space."""
        linear = self.linear(view)
        if not np.isfinite(linear).all():
            y, x = np.argwhere(~np.isfinite(linear).all(axis=2))[0]
            raise UserError(f"{view.file_path}: the light at pixel x {x}, y {y} is not finite")
        return encode(linear)

    def linear(self, view: CaptureView) -> np.ndarray:
        """Return (H, W, 4) float64: radiance times alpha, and alpha."""
        self._parameters["to_world"] = mi.Transform4f(view.pose @ OPENGL_TO_MITSUBA)
        self._parameters["x_fov"] = mi.Float(math.degrees(view.fov))
        self._parameters.update()
        (width, height), spp = self._settings.size, self._settings.spp
        at_once = min(SAMPLES_PER_PASS, math.isqrt(PATHS_PER_PASS // (width * height)) ** 2)
        counts = [min(at_once, spp - start) for start in range(0, spp, at_once)]
        entropy = [self._settings.seed, SPLITS.index(view.split), view.index]
        seeds = np.random.SeedSequence(entropy).generate_state(len(counts))
        total = np.zeros((height, width, 4))
        settings = {"sensor": self._sensor, "integrator": self._integrator}
        logger: mi.Logger = mi.logger()  # pyright: ignore[reportCallIssue]  # not in the stub
        level = logger.log_level()
        # Mitsuba would warn in each pass that its sampler rounds the number of paths up.
        logger.set_log_level(mi.LogLevel.Error)
        try:
            for count, seed in zip(counts, seeds, strict=True):
                image = mi.render(self._scene, seed=int(seed), spp=count, **settings)  # pyright: ignore[reportArgumentType]  # also an int
                total += count * np.array(image, np.float64)
        finally:
            logger.set_log_level(level)
        return total / spp


def encode(linear: np.ndarray) -> np.ndarray:
    """Return (H, W, 4) uint8 straight sRGB and alpha, from premultiplied radiance and alpha."""
    alpha = np.clip(linear[:, :, 3:], 0, 1)
    color = np.clip(linear[:, :, :3] / np.maximum(alpha, 1e-9), 0, 1)
    display = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    rgba = to_uint8(np.concatenate([display, alpha], axis=2))
    rgba[rgba[:, :, 3] == 0] = 0  # not noise
    return rgba


def lit_part(rgba: np.ndarray) -> float:
    """Return the part of the covered pixels of (..., 4) uint8 that is not black."""
    covered = rgba[..., 3] > 0
    lit = covered & (rgba[..., :3].max(axis=-1) > MAX_BLACK)
    return float(lit.sum() / max(1, covered.sum()))


def require_sight(scene: mi.Scene, settings: CaptureSettings, views: list[CaptureView]) -> None:
    """Raise :class:`UserError` where no training view sees a surface, and points are wanted."""
    if not settings.points:
        return
    steps = (np.arange(SIGHT_RAYS) + 0.5) / SIGHT_RAYS
    spots = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * settings.size
    for view in views:
        rays = view.pose[:3, 3], view_rays(view, spots, settings)
        if view.split == "train" and first_hits(scene, *rays)[1].any():
            return
    raise UserError("the cameras see nothing of the scene: give --target and --distance")


def view_rays(view: CaptureView, spots: np.ndarray, settings: CaptureSettings) -> np.ndarray:
    """Return unit directions (N, 3), world, through places x, y (N, 2) of an image, px."""
    width, height = settings.size
    focal = 0.5 * width / math.tan(0.5 * view.fov)
    offset = (spots - np.array([width / 2, height / 2])) / focal
    local = np.stack([offset[:, 0], -offset[:, 1], -np.ones(len(spots))], axis=1)
    directions = local @ view.pose[:3, :3].T
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def first_hits(
    scene: mi.Scene, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays meet a surface that is no lamp, (N, 3) float32 world, and if, (N,) bool."""
    ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(directions.T))

    def intersect(ray: mi.Ray3f) -> tuple[mi.SurfaceInteraction3f, Bool]:
        hit = scene.ray_intersect(ray)
        return hit, hit.is_valid() & hit.shape.is_emitter()

    hit, lamp = intersect(ray)
    for _ in range(MAX_LAMPS_IN_A_ROW - 1):
        if not dr.any(lamp):
            break
        ray = dr.select(lamp, hit.spawn_ray(ray.d), ray)
        hit, lamp = intersect(ray)
    return np.array(hit.p).T, np.array(hit.is_valid() & ~lamp)
