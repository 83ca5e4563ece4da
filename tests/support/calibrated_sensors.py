"""``calibrated`` sensors, and Mitsuba's own, before a few splats."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import mitsuba as mi
import numpy as np

from drgs.cameras.camera import Camera
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.reference import splatting as reference
from support import lenses, reference_effects
from support.helpers import NEAR_THRESHOLD
from support.lens_scenes import LENSES, rolling_image
from support.lenses import Equirectangular, Fisheye, OpenCV, Pinhole, ThinPrismFisheye
from support.views import VIEWS, Scene, View, pose, splats_before

WINDOW = (13, 7, 29, 18)
SHUTTER_SAMPLES = 3
CLOSE = pose([0.1, -1.0, 0.3], 43, (0.5, -0.65, 1.05))
KINDS = {
    Pinhole: "pinhole",
    OpenCV: "opencv",
    Fisheye: "fisheye",
    ThinPrismFisheye: "thin_prism_fisheye",
    Equirectangular: "equirectangular",
}


@dataclass(frozen=True)
class Calibrated:
    """A sensor: its dictionary, and what the reference makes of it."""

    name: str
    lens: lenses.Lens = Pinhole()  # noqa: RUF009
    view: View = View("", 53, 41, crop=WINDOW)  # noqa: RUF009
    f: tuple[float, float] = (40.0, 44.0)  # fx, fy, px
    c: tuple[float, float] = (24.0, 22.5)  # cx, cy, px
    close: tuple | None = None  # to_world_close
    shutter: str = "global"

    @property
    def coefficients(self) -> dict[str, float]:
        given = {} if isinstance(self.lens, Pinhole) else asdict(self.lens)
        return {name: value for name, value in given.items() if value != 0}

    @property
    def intrinsics(self) -> dict[str, float]:
        numbers = dict(zip(("fx", "fy", "cx", "cy"), (*self.f, *self.c), strict=True))
        return {} if isinstance(self.lens, Equirectangular) else numbers

    def dictionary(self, **others) -> dict:
        given = {"lens": KINDS[type(self.lens)], **self.intrinsics, **self.coefficients}
        given |= {"shutter": self.shutter, "shutter_samples": SHUTTER_SAMPLES}
        if self.close is not None:
            given["to_world_close"] = transform(self.close)
        return self.view.with_sensor("calibrated", **given | others).sensor()

    def load(self, **others) -> mi.Sensor:
        return mi.load_dict(self.dictionary(**others))

    @property
    def camera(self) -> reference.Camera:
        """The camera of the whole film, at time 0."""
        (fx, fy), (cx, cy) = self.f, self.c
        return replace(self.view.camera, fx=fx, fy=fy, cx=cx, cy=cy)

    @property
    def close_camera(self) -> reference.Camera:
        """At time 1."""
        at_close = replace(self.view, to_world=self.close or self.view.to_world).camera
        return replace(self.camera, rotation=at_close.rotation, center=at_close.center)

    def camera_at(self, time: float) -> reference.Camera:
        return reference_effects.camera_at(self.camera, self.close_camera, time)

    def rendered(self, gaussians) -> reference.RenderedImage:
        """The whole film by the reference, on black; motion with SHUTTER_SAMPLES."""
        if self.close is None:
            return lenses.render(gaussians, self.camera, self.lens, threshold_width=NEAR_THRESHOLD)
        if self.shutter == "rolling":
            return rolling_image(gaussians, self.camera_at, self.lens, 1, NEAR_THRESHOLD)
        return reference_effects.render_motion_blur(
            gaussians, self.camera, self.close_camera, SHUTTER_SAMPLES, np.zeros(3), self.lens,
            NEAR_THRESHOLD,
        )  # fmt: skip

    @property
    def corner(self) -> np.ndarray:
        """The corner of the crop window in the film, px."""
        return np.array((self.view.crop or (0, 0))[:2])

    @property
    def size(self) -> np.ndarray:
        """The size of the crop window, px."""
        rows, columns = self.view.window
        return np.array([columns.stop - columns.start, rows.stop - rows.start])


def transform(matrix) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f(np.array(matrix))


PINHOLE = Calibrated("pinhole")
OPENCV = Calibrated("opencv", LENSES["rational"])
FISHEYE = Calibrated("fisheye", LENSES["fisheye"], f=(13.0, 14.5))
THIN_PRISM = Calibrated("thin prism", LENSES["thin prism"], f=(13.0, 14.5))
FILM = View("", 37, 29)  # without a crop window

# A fold within the film.
BARREL = Calibrated("barrel", LENSES["barrel"], FILM, f=(26.0, 26.0), c=(19.0, 14.0))
PANORAMA = Calibrated("panorama", LENSES["panorama"])
STATIC_SENSORS = [PINHOLE, OPENCV, FISHEYE, THIN_PRISM, PANORAMA]

by_name = {"ids": lambda sensor: sensor.name}


def sampled_rays(sensor, time=0.0, count=200, seed=3):
    """Rays through ``count`` random points of the film, their weights, and the samples (N, 2)."""
    sample = np.random.default_rng(seed).uniform(size=(2, count)).astype(np.float32)
    ray, weight = sensor.sample_ray(time, 0.5, mi.Point2f(sample), mi.Point2f(0.5))
    return ray, np.array(weight)[0], sample.T.astype(np.float64)


def splats_scene(sensor, gaussians, **settings) -> mi.Scene:
    """On black, before a sensor or its dictionary."""
    scene = Scene(background=(0.0, 0.0, 0.0))
    sensor = sensor.dictionary() if isinstance(sensor, Calibrated) else sensor
    return scene.load_with(sensor, gaussians=gaussians, **settings)


def clear_gaussians(sensor):
    """Gaussians before the view, and their image, which no threshold is near to."""
    for seed in range(100):
        gaussians = splats_before(sensor.view, 1, 40, seed)
        rendered = sensor.rendered(gaussians)
        if not rendered.near_threshold[sensor.view.window].any():
            return gaussians, rendered
    raise AssertionError(f"{sensor.name}: no clear seed among 100")


def scaled(matrix, *factors) -> tuple:
    """A ``to_world`` that scales first."""
    return tuple(map(tuple, np.array(matrix) @ np.diag([*factors, 1.0])))


POSES = {"rotated": VIEWS[1].to_world, "mirrored": VIEWS[3].to_world}
SCALED = {
    "scaled": scaled(VIEWS[1].to_world, 3.0, 3.0, 3.0),
    "scaled unevenly": scaled(VIEWS[1].to_world, 2.0, 0.5, 1.0),
}
"""Mitsuba refuses them for a thin lens."""


def own_sensor(kind, view) -> dict:
    aperture = {"fov": view.fov, "aperture_radius": 0.125, "focus_distance": 3.0}
    return view.with_sensor(kind, **(aperture if kind == "thinlens" else {})).sensor()


def own_camera(view) -> reference.Camera:
    """Return the camera of an orthographic sensor, by the manual: its film is 2 units of its own
    wide."""
    matrix = np.array(view.to_world)[:3, :3]
    scales = np.linalg.norm(matrix, axis=0)
    rotation = np.diag([-1.0, -1.0, 1.0]) @ (matrix / scales).T
    fx, fy = view.width / 2 / scales[:2]
    return replace(
        view.camera, rotation=rotation, fx=fx, fy=fy, cx=view.width / 2, cy=view.height / 2,
        near=0.01,
    )  # fmt: skip


# px. A float32 direction is good to 1e-7, which over a focal length of 50 px is 5e-6 px; the ray's
# origin adds as much at a distance of 1. Measured 8e-6.
PIXELS = 5e-5


def camera_of(sensor, near=0.01) -> Camera:
    return camera_from_sensor(read_sensor(sensor, near))


def numbers(camera) -> dict[str, np.ndarray]:
    """Return the numbers of a Dr.Jit camera in float64."""
    names = ("rotation", "center", "focal", "principal", "near")
    return {n: np.array(getattr(camera, n)).astype(np.float64)[..., 0] for n in names}
