"""Frames for viewer clients: their contents, lenses and rendering.

Any thread may make a :class:`FrameRequest`. Only the Dr.Jit thread may call :class:`LiveScene`,
which renders it with the integrator ``splats``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib import colormaps

from drgs.cameras.lens import LENSES
from drgs.cameras.viewpoints import OPENCV_TO_MITSUBA, Viewpoint, pinhole
from drgs.config.approximations import DECLARED, Approximations
from drgs.config.schema import ModelConfig
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import NEAR_CLIP, film_description, make_scene, make_sensors
from drgs.io.images import to_uint8
from drgs.results.metrics import psnr

MAX_SCENES = 2  # scenes kept, each with a copy of the Gaussians: ``error`` needs two
BACKDROP_GRAY = 0.12  # grey behind depths, normals and opacities
MIN_DEPTH_ALPHA = 0.5  # opacity from which a pixel's depth counts for the range of colours
DEPTH_RANGE = (2, 98)  # percentiles of these depths at the ends of the colour map
ERROR_GAIN = 5.0

MOST_ACCURATE = {
    **{"order": "pixel", "order_window": 16, "sh_direction": "pixel"},
    **{"alpha_cut": 0.0, "transmittance_stop": 0.0},
}
"""Approximations of the image that ``error`` compares with, besides the lens's most accurate
projection; the filter is the model's."""


@dataclass(frozen=True, eq=False)
class ViewerCamera:
    """The camera of a viewer client. All lenses show the middle of the image equally large."""

    camera_to_world: np.ndarray  # (4, 4) float64, rigid, OpenCV axes: x right, y down, z forward
    fov: float  # degrees, vertical
    distance: float  # scene units, along the axis, to the orbit centre

    def viewpoint(self, width: int, height: int) -> Viewpoint:
        """Return the pinhole camera of this field of view, with an image of this size (px)."""
        half = math.tan(math.radians(self.fov) / 2) * width / height
        fov = 2 * math.degrees(math.atan(half))
        return pinhole("eye", self.camera_to_world, width, height, fov)


@dataclass(frozen=True, eq=False)
class FrameRequest:
    """A frame to render."""

    camera: ViewerCamera
    width: int  # px
    height: int  # px
    lens: str = "pinhole"  # name in VIEWER_LENSES
    lens_parameters: Mapping[str, float] = field(default_factory=dict)
    content: str = "color"  # name in SHOWN
    approximations: Approximations | None = None  # None: those of the fit

    def smaller(self, divisor: int) -> FrameRequest:
        """Return the request with width and height divided by ``divisor``."""
        width, height = (max(1, round(side / divisor)) for side in (self.width, self.height))
        return replace(self, width=width, height=height)

    @property
    def viewpoint(self) -> Viewpoint:
        """The pinhole camera of this view."""
        return self.camera.viewpoint(self.width, self.height)

    def sensor(self) -> mi.Sensor:
        """Return Mitsuba's sensor, whose film is RGB with a box filter."""
        return VIEWER_LENSES[self.lens].make_sensor(self, **self.lens_parameters)


@dataclass(frozen=True, eq=False)
class ViewerFrame:
    """A rendered frame."""

    pixels: np.ndarray  # (H, W, 3) uint8, display space
    seconds: float  # of rendering and the transfer to the host
    note: str = ""  # meaning of false colours


class LiveScene:
    """Gaussians rendered with changing approximations."""

    def __init__(
        self,
        gaussians: Gaussians,
        model: ModelConfig,
        background: tuple[float, float, float] | Path,
        **settings: object,
    ) -> None:
        """See :func:`drgs.integrator.scene.make_scene`."""
        self._gaussians, self._model, self._background = gaussians, model, background
        self._settings = settings
        self._scenes: dict[tuple[str, Approximations], mi.Scene] = {}

    @property
    def approximations(self) -> Approximations:
        """The approximations of the render."""
        return self._model.approximations

    def frame(self, request: FrameRequest) -> ViewerFrame:
        """Render a frame, or raise ``UserError`` for settings that do not fit together."""
        return FRAME_CONTENTS[request.content](self, request)

    def image(self, request: FrameRequest, aovs: str = "") -> tuple[np.ndarray, float]:
        """Return (H, W, 3 + channels of ``aovs``) float32, display space, and the seconds taken."""
        scene = self._scene(aovs, request.approximations or self.approximations)
        start = time.perf_counter()
        with dr.suspend_grad():
            # mi.render hides the cause of an error.
            image = np.array(scene.integrator().render(scene, request.sensor(), spp=1))
        return image, time.perf_counter() - start

    def _scene(self, aovs: str, approximations: Approximations) -> mi.Scene:
        key = aovs, approximations
        scene = self._scenes.pop(key, None)
        if scene is None:
            values = {name: getattr(approximations, name) for name in DECLARED}
            settings = self._settings | ({"aovs": aovs} if aovs else {})
            model = self._model.model_copy(update=values)
            scene = make_scene(self._gaussians, model, self._background, **settings)
        self._scenes[key] = scene  # in the order of their last use
        while len(self._scenes) > MAX_SCENES:
            del self._scenes[next(iter(self._scenes))]
        return scene


# Frame contents


def _color(scene: LiveScene, request: FrameRequest) -> ViewerFrame:
    image, seconds = scene.image(request)
    return ViewerFrame(to_bytes(image), seconds)


def _opacity(scene: LiveScene, request: FrameRequest) -> ViewerFrame:
    image, seconds = scene.image(request, "alpha:alpha")
    return ViewerFrame(to_bytes(np.repeat(image[:, :, 3:4], 3, axis=2)), seconds)


def _depth(scene: LiveScene, request: FrameRequest) -> ViewerFrame:
    image, seconds = scene.image(request, "depth:depth, alpha:alpha")
    depth, alpha = image[:, :, 3], image[:, :, 4]
    depth = depth / np.maximum(alpha, 1e-6)
    depths = depth[alpha >= MIN_DEPTH_ALPHA]
    if not len(depths):
        backdrop = np.full((*depth.shape, 3), BACKDROP_GRAY)
        return ViewerFrame(to_bytes(backdrop), seconds, "nothing is seen")
    near, far = (float(end) for end in np.percentile(depths, DEPTH_RANGE))
    colors = colormaps["turbo"](np.clip((far - depth) / max(far - near, 1e-9), 0, 1))[:, :, :3]
    return ViewerFrame(over_backdrop(colors, alpha), seconds, f"red {near:.3g} to blue {far:.3g}")


def _normals(scene: LiveScene, request: FrameRequest) -> ViewerFrame:
    image, seconds = scene.image(request, "normal:normal, alpha:alpha")
    normal, alpha = image[:, :, 3:6], image[:, :, 6]
    colors = 0.5 + 0.5 * normal / np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-9)
    note = "x, y, z of the world as red, green, blue"
    return ViewerFrame(over_backdrop(colors, alpha), seconds, note)


def _error(scene: LiveScene, request: FrameRequest) -> ViewerFrame:
    image, seconds = scene.image(request)
    given = request.approximations or scene.approximations
    best = replace(given, projection=VIEWER_LENSES[request.lens].most_accurate, **MOST_ACCURATE)
    accurate, accurate_seconds = scene.image(replace(request, approximations=best))
    quality = psnr(image, accurate)
    comparison = "the same as" if math.isinf(quality) else f"PSNR {quality:.1f} dB to"
    note = f"{comparison} the most accurate image, which took {1e3 * accurate_seconds:.0f} ms"
    return ViewerFrame(to_bytes(0.5 + ERROR_GAIN * (image - accurate)), seconds, note)


FRAME_CONTENTS: dict[str, Callable[[LiveScene, FrameRequest], ViewerFrame]] = {
    "color": _color,
    "depth": _depth,
    "normals": _normals,
    "opacity": _opacity,
    "error": _error,
}
"""Contents by name; ``error``: 0.5 + 5 x the difference from the most accurate image."""


def to_bytes(image: np.ndarray) -> np.ndarray:
    """Return (H, W, 3) uint8 of the first three channels, clamped to [0, 1]; NaN is black."""
    return to_uint8(np.nan_to_num(image[:, :, :3]))


def over_backdrop(colors: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return (H, W, 3) uint8: colours (H, W, 3) with ``alpha`` (H, W) over grey."""
    alpha = alpha[:, :, None]
    return to_bytes(alpha * colors + (1 - alpha) * BACKDROP_GRAY)


# Lenses


@dataclass(frozen=True)
class ViewerLens:
    """A lens that viewer clients can choose."""

    make_sensor: Callable[..., mi.Sensor]  # (FrameRequest, **parameters)
    parameters: tuple[str, ...] = ()  # names of those with a slider
    most_accurate: str = "exact"  # projection; ``exact`` needs undistorted rays through one point


def _pinhole(request: FrameRequest) -> mi.Sensor:
    return make_sensors([request.viewpoint])[0]


def _opencv(request: FrameRequest, **coefficients: float) -> mi.Sensor:
    lens = LENSES.get("opencv").value.from_coefficients(**coefficients)
    return make_sensors([replace(request.viewpoint, lens=lens)])[0]


def _fisheye(request: FrameRequest, **coefficients: float) -> mi.Sensor:
    """Return a sensor whose undistorted film height spans the field of view."""
    lens = LENSES.get("fisheye").value.from_coefficients(**coefficients)
    focal = request.height / math.radians(request.camera.fov)
    return make_sensors([replace(request.viewpoint, fx=focal, fy=focal, lens=lens)])[0]


def _orthographic(request: FrameRequest) -> mi.Sensor:
    camera = request.camera
    half_height = camera.distance * math.tan(math.radians(camera.fov) / 2)
    half_width = half_height * request.width / request.height
    # Mitsuba's film is two sensor units wide.
    scale = np.diag([half_width, half_width, 1.0, 1.0])
    return _mitsuba_sensor(request, scale, type="orthographic")


def _thin_lens(request: FrameRequest, aperture: float, focus: float = 1.0) -> mi.Sensor:
    """Return a thin lens; aperture (radius) and focus are in units of the target's distance."""
    if aperture == 0:  # Mitsuba warns at every frame
        return _pinhole(request)
    distance, view = request.camera.distance, {"fov": request.camera.fov, "fov_axis": "y"}
    lens = {"aperture_radius": aperture * distance, "focus_distance": focus * distance}
    return _mitsuba_sensor(request, np.eye(4), type="thinlens", **view, **lens)


def _mitsuba_sensor(request: FrameRequest, scale: np.ndarray, **settings: object) -> mi.Sensor:
    """scale: (4, 4), of the sensor's axes."""
    pose = request.camera.camera_to_world @ OPENCV_TO_MITSUBA @ scale
    return mi.load_dict(
        {
            "to_world": mi.ScalarTransform4f(pose),
            "near_clip": NEAR_CLIP,
            "sampler": {"type": "independent", "sample_count": 1},
            "film": film_description(request.width, request.height),
            **settings,
        }
    )


VIEWER_LENSES = {
    "pinhole": ViewerLens(_pinhole),
    "opencv": ViewerLens(_opencv, ("k1", "k2"), most_accurate="unscented"),
    "fisheye": ViewerLens(_fisheye, ("k1", "k2"), most_accurate="unscented"),
    "orthographic": ViewerLens(_orthographic, most_accurate="ewa"),
    "thin lens": ViewerLens(_thin_lens, ("aperture", "focus")),
}
