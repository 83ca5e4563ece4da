"""One picture for somebody who looks on: what is asked for, and what renders it.

A :class:`FrameRequest` is plain data, which any thread may make. :class:`LiveScene` renders it, by
the integrator ``splats`` like every other picture; only the thread that Dr.Jit runs in may ask it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib import colormaps

from drgs.config.approximations import DECLARED, Approximations
from drgs.config.schema import ModelConfig
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene
from drgs.results.metrics import psnr
from drgs.viewer.optics import Eye, Optics, Pinhole

MOST_SCENES = 2
"""That are kept, each with a copy of the Gaussians: the picture called ``error`` needs two."""

BACKDROP = 0.12
"""Grey behind depths, normals and opacities, where nothing is."""

SEEN = 0.5
"""Opacity from which a pixel's depth counts for the range of colours."""

DEPTH_RANGE = (2, 98)
"""Percentiles of the seen pixels' depths that get the ends of the colour map."""

ERROR_GAIN = 5.0
"""Of the differences that are shown, around grey."""

UNCUT = {"alpha_cut": 0.0, "transmittance_stop": 0.0}
MOST_ACCURATE = {"order": "pixel", "order_window": 16, **UNCUT}
"""What the picture called ``error`` compares with, beside the most accurate projection that
knows the lens. Filter and harmonics are the model's own."""


@dataclass(frozen=True, eq=False)
class FrameRequest:
    """A picture that somebody wants to see."""

    eye: Eye
    width: int  # px
    height: int  # px
    optics: Optics = field(default_factory=Pinhole)
    shows: str = "color"  # one of SHOWN
    approximations: Approximations | None = None  # None: those that the Gaussians were fitted with

    def smaller(self, divisor: int) -> FrameRequest:
        """The same with a ``divisor``-th of the pixels along either side."""
        width, height = (max(1, round(side / divisor)) for side in (self.width, self.height))
        return replace(self, width=width, height=height)


@dataclass(frozen=True, eq=False)
class Frame:
    """A picture that was asked for."""

    pixels: np.ndarray  # (H, W, 3) uint8, display space
    seconds: float  # that rendering took, the transfer to the host included
    note: str = ""  # what the colours mean, where they are not those of the scene


class LiveScene:
    """Gaussians that are shown with one setting and then with another."""

    def __init__(
        self,
        gaussians: Gaussians,
        model: ModelConfig,
        background: tuple[float, float, float] | Path,
        **settings: object,
    ) -> None:
        """As :func:`drgs.integrator.scene.make_scene` has them."""
        self._gaussians, self._model, self._background = gaussians, model, background
        self._settings = settings
        self._scenes: dict[tuple[str, Approximations], mi.Scene] = {}

    @property
    def approximations(self) -> Approximations:
        """Those that the Gaussians were fitted with."""
        return self._model.approximations

    def frame(self, request: FrameRequest) -> Frame:
        """Render what is asked for.

        Raises :class:`drgs.core.errors.UserError` for settings that do not go together, such as an
        exact projection through a lens that bends rays.
        """
        return SHOWN[request.shows](self, request)

    def picture(self, request: FrameRequest, aovs: str = "") -> tuple[np.ndarray, float]:
        """Float32 (H, W, 3 + channels of ``aovs``), display space, and the seconds that it took."""
        scene = self._scene(aovs, request.approximations or self.approximations)
        start = time.perf_counter()
        sensor = request.optics.sensor(request.eye, request.width, request.height)
        with dr.suspend_grad():
            # Not by mi.render, which says of an error only that there was one.
            picture = np.array(scene.integrator().render(scene, sensor, spp=1))
        return picture, time.perf_counter() - start

    def _scene(self, aovs: str, approximations: Approximations) -> mi.Scene:
        key = aovs, approximations
        scene = self._scenes.pop(key, None)
        if scene is None:
            values = {name: getattr(approximations, name) for name in DECLARED}
            model, settings = self._model.model_copy(update=values), dict(self._settings)
            if aovs:
                settings["aovs"] = aovs
            scene = make_scene(self._gaussians, model, self._background, **settings)
        self._scenes[key] = scene  # the last one is the one used last
        while len(self._scenes) > MOST_SCENES:
            del self._scenes[next(iter(self._scenes))]
        return scene


# ----------------------------------------------------------------------------------------------
# What can be shown
# ----------------------------------------------------------------------------------------------


def _color(scene: LiveScene, request: FrameRequest) -> Frame:
    picture, seconds = scene.picture(request)
    return Frame(to_bytes(picture), seconds)


def _opacity(scene: LiveScene, request: FrameRequest) -> Frame:
    picture, seconds = scene.picture(request, "alpha:alpha")
    return Frame(to_bytes(np.repeat(picture[:, :, 3:4], 3, axis=2)), seconds)


def _depth(scene: LiveScene, request: FrameRequest) -> Frame:
    """Near is red, far is blue."""
    picture, seconds = scene.picture(request, "depth:depth, alpha:alpha")
    depth, alpha = picture[:, :, 3], picture[:, :, 4]
    depth = depth / np.maximum(alpha, 1e-6)
    seen = depth[alpha >= SEEN]
    if not len(seen):
        return Frame(to_bytes(np.full((*depth.shape, 3), BACKDROP)), seconds, "nothing is seen")
    near, far = (float(end) for end in np.percentile(seen, DEPTH_RANGE))
    place = np.clip((far - depth) / max(far - near, 1e-9), 0, 1)
    colors = colormaps["turbo"](place)[:, :, :3]
    return Frame(over_backdrop(colors, alpha), seconds, f"red {near:.3g} to blue {far:.3g}")


def _normals(scene: LiveScene, request: FrameRequest) -> Frame:
    picture, seconds = scene.picture(request, "normal:normal, alpha:alpha")
    normal, alpha = picture[:, :, 3:6], picture[:, :, 6]
    length = np.linalg.norm(normal, axis=2, keepdims=True)
    colors = 0.5 + 0.5 * normal / np.maximum(length, 1e-9)
    return Frame(over_backdrop(colors, alpha), seconds, "x, y, z of the world as red, green, blue")


def _error(scene: LiveScene, request: FrameRequest) -> Frame:
    """The seconds are those of the picture whose error is shown."""
    picture, seconds = scene.picture(request)
    given = request.approximations or scene.approximations
    best = replace(given, projection=request.optics.most_accurate, **MOST_ACCURATE)
    accurate, slowly = scene.picture(replace(request, approximations=best))
    apart = psnr(picture, accurate)
    far = "the same as" if math.isinf(apart) else f"PSNR {apart:.1f} dB to"
    note = f"{far} the most accurate picture, which took {1e3 * slowly:.0f} ms"
    return Frame(to_bytes(0.5 + ERROR_GAIN * (picture - accurate)), seconds, note)


SHOWN: dict[str, Callable[[LiveScene, FrameRequest], Frame]] = {
    "color": _color,
    "depth": _depth,
    "normals": _normals,
    "opacity": _opacity,
    "error": _error,
}
"""By name: what a picture can show. ``error`` is 0.5 + 5 times the difference from the most
accurate picture, in display space."""


def to_bytes(picture: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of the first three channels, clamped to [0, 1]; no number is black."""
    picture = np.nan_to_num(np.clip(picture[:, :, :3], 0, 1), nan=0.0)
    return np.round(picture * 255).astype(np.uint8)


def over_backdrop(colors: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: colours (H, W, 3) as opaque as ``alpha`` (H, W) over :data:`BACKDROP`."""
    alpha = alpha[:, :, None]
    return to_bytes(alpha * colors + (1 - alpha) * BACKDROP)
