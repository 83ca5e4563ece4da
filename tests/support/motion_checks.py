"""Cameras that move: cases for the kernels and for the float64 reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import drjit as dr
import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from drgs.cameras.camera import Camera, cameras_in_time
from drgs.cameras.motion import (
    Motion,
    MotionBlur,
    RollingShutter,
)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import effects
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from support.helpers import (
    device_gaussians,
    single,
)
from support.lens_scenes import LensCase, lens_camera
from support.reference_scenes import rotation_about


@dataclass(frozen=True)
class MovingCase(LensCase):
    """A scene before a camera that moves while it is open."""

    turn: float = 0.06  # radians
    travel: float = 0.1  # scene units
    samples: int = 3  # of motion blur; 0: rolling shutter

    @property
    def scene(self) -> tuple[reference.Gaussians, reference.Camera]:
        """Rotations are rotations to more than single precision: turns are products of them."""
        gaussians, camera = super().scene
        rotation = Rotation.from_matrix(camera.rotation).as_matrix()
        return gaussians, replace(camera, rotation=rotation)

    @property
    def close_camera(self) -> reference.Camera:
        """At time 1; float32 values."""
        rng = np.random.default_rng(7)
        turned = rotation_about(rng.normal(size=3), self.turn) @ self.camera.rotation
        travel = rng.normal(size=3)
        travel *= self.travel / np.linalg.norm(travel)
        return replace(self.camera, rotation=turned, center=single(self.camera.center + travel))

    def camera_at(self, time) -> reference.Camera:
        return effects.camera_at(self.camera, self.close_camera, time)

    @property
    def rendered(self) -> reference.RenderedImage:
        return _image(self)

    def reference_image(self, gaussians=None, threshold_width=0.0) -> reference.RenderedImage:
        gaussians = gaussians or self.gaussians
        if self.samples:
            return effects.render_motion_blur(
                gaussians, self.camera, self.close_camera, self.samples, self.background,
                self.lens, threshold_width,
            )  # fmt: skip
        return rolling_image(self, gaussians, threshold_width)

    def device_camera(self, precision) -> Camera:
        camera = super().device_camera(precision)
        close = lens_camera(self.close_camera, self.lens, precision)
        motion = Motion.relative_motion(camera, close.rotation, close.center)
        if self.samples:
            camera = replace(camera, shutter=MotionBlur(*motion, self.samples))
        else:
            camera = replace(camera, shutter=RollingShutter(*motion))
        dr.make_opaque(camera)
        return camera

    def frames(self, precision, pipeline=None, gaussians=None) -> tuple[object, list]:
        """The Gaussians on the device, and a frame for each time."""
        device = device_gaussians(gaussians or self.gaussians, precision)
        cameras = cameras_in_time(self.device_camera(precision))
        return device, [rendering.render(device, c, pipeline or self.pipeline) for c in cameras]


@cache
def _image(case):
    return case.reference_image(threshold_width=case.threshold_width)


def time_of(case, mean) -> float:
    """When the row that shows a mean is read: the root of its row less the time."""
    return _time_of(case, tuple(mean))


@cache
def _time_of(case, mean) -> float:
    def behind(time) -> float:
        camera = case.camera_at(time)
        point = (mean - camera.center) @ camera.rotation.T
        return case.lens.film_points(camera, point[None])[0, 1] / case.height - time

    if behind(0) <= 0:
        return 0.0
    return 1.0 if behind(1) >= 0 else brentq(behind, 0, 1, xtol=1e-15, rtol=1e-14)


def rolling_image(case, gaussians, threshold_width) -> reference.RenderedImage:
    """Each splat as a whole at the time of its mean."""
    single_rows = [
        reference.Gaussians(**{n: getattr(gaussians, n)[k : k + 1] for n in PARAMETER_NAMES})
        for k in range(len(gaussians.means))
    ]
    cameras = [case.camera_at(time_of(case, mean)) for mean in gaussians.means]
    splats = [effects.project(*pair, case.lens) for pair in zip(single_rows, cameras, strict=True)]
    colors = [
        effects.sh_colors(*pair, case.lens, case.rendered_degree)
        for pair in zip(single_rows, cameras, strict=True)
    ]
    fields = ("means2d", "conics", "opacities", "depths", "visible")
    columns = {name: np.concatenate([getattr(s, name) for s in splats]) for name in fields}
    return reference.composite(
        columns["means2d"], columns["conics"], columns["opacities"], np.concatenate(colors),
        columns["depths"], columns["visible"], case.background, case.width, case.height,
        threshold_width,
    )  # fmt: skip
