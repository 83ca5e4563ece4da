"""Mitsuba objects from a dataset: sensors of views, a scene with the integrator."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.cameras.lens import PINHOLE
from drgs.cameras.viewpoints import OPENCV_TO_MITSUBA, Viewpoint
from drgs.config.schema import ModelConfig
from drgs.core.errors import UserError
from drgs.core.memory import too_large_reason
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.sensors import camera_from_sensor, read_sensor

NEAR_CLIP = 1e-9  # scene units: the smallest near plane, so that the integrator's applies
SQUARE_PIXEL_TOLERANCE = 0.01  # px: largest shift at the border from treating pixels as square


def make_scene(
    gaussians: Gaussians,
    model: ModelConfig,
    background: tuple[float, float, float] | Path,
    **settings: object,
) -> mi.Scene:
    """Return a scene of the integrator ``splats`` with ``settings``, in display space."""
    tensors = replace(gaussians, features=None).to(mi.TensorXf).arrays
    bitmap = {"type": "bitmap", "filename": str(background), "wrap_mode": "clamp"}
    integrator = {
        "type": "splats",
        "background": list(background) if isinstance(background, tuple) else bitmap,
        "near": model.near_plane,
        **model.approximations.non_default,
        "srgb_primitives": False,
        **settings,
        **tensors,
    }
    return mi.load_dict({"type": "scene", "integrator": integrator})


def check_lenses(model: ModelConfig, views: Iterable[Viewpoint], where: str, remedy: str) -> None:
    """Raise UserError for lenses that ``exact`` cannot render; where, remedy: of the message."""
    bent = next(((view.name, view.lens) for view in views if view.lens is not None), None)
    if model.projection == "exact" and bent is not None:
        name, lens = bent
        raise UserError(
            f"{where}model.projection must be ewa or unscented for lenses that are no pinholes, "
            f"such as that of view {name}, {lens.describe()}, got exact; or {remedy}"
        )


def check_sizes(views: Iterable[Viewpoint], remedy: str) -> None:
    """Raise :class:`UserError` for images too large for memory; remedy: end of the message."""
    for view in views:
        motion = view.motion
        samples = 1 if motion is None or motion.shutter != "global" else motion.samples
        if reason := too_large_reason(view.width, view.height, samples=samples):
            raise UserError(f"view {view.name}: {reason}; {remedy}")


def sensor_from_view(view: Viewpoint) -> mi.Sensor:
    """Return a sensor that renders the image of a dataset's view: see :func:`make_sensors`."""
    return make_sensors([view])[0]


def view_from_sensor(sensor: mi.Sensor, name: str = "sensor") -> Viewpoint:
    """Return the camera of a ``perspective`` sensor, or of a ``calibrated`` pinhole that stands.

    The image is that of the crop window. Raises ``drgs.core.errors.UserError`` (a ValueError) for
    other sensors. Nothing is differentiated.
    """
    camera = camera_from_sensor(read_sensor(sensor, NEAR_CLIP))
    if camera.lens != PINHOLE or camera.aperture is not None or camera.shutter is not None:
        raise UserError(
            "view_from_sensor(): the sensor must be a pinhole that does not move, got "
            f"{sensor.class_name()} '{sensor.id()}' with another lens, an aperture or a shutter"
        )
    pose = np.eye(4)
    pose[:3, :3] = np.array(camera.rotation, np.float64).reshape(3, 3).T
    pose[:3, 3] = np.array(camera.center).ravel()
    fx, fy, cx, cy = (each[0] for each in (*camera.focal, *camera.principal))
    return Viewpoint(name, pose, fx, fy, cx, cy, camera.width, camera.height)


def make_sensors(views: Iterable[Viewpoint], calibrated: bool = False) -> list[mi.Sensor]:
    """Return one sensor per view: box filter, one sample, RGB.

    ``perspective`` where that can represent the camera, else (or with ``calibrated``)
    ``calibrated``. Views of one size share a film.
    """
    views = list(views)
    sizes = dict.fromkeys((view.width, view.height) for view in views)
    films = {size: mi.load_dict(film_description(*size)) for size in sizes}
    described = ({**_sensor(v, calibrated), "film": films[v.width, v.height]} for v in views)
    return [mi.load_dict(sensor) for sensor in described]


def film_description(width: int, height: int) -> dict[str, object]:
    """Describe the film of one image (px) for ``mi.load_dict``: RGB, with a box filter."""
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }


def _sensor(view: Viewpoint, calibrated: bool) -> dict[str, object]:
    pose = {
        "to_world": _to_world(view.camera_to_world),
        "near_clip": NEAR_CLIP,
        "sampler": {"type": "independent", "sample_count": 1},
    }
    focal = math.sqrt(view.fx * view.fy)
    shift = max(
        abs(view.fx / focal - 1) * max(view.cx, view.width - view.cx),
        abs(view.fy / focal - 1) * max(view.cy, view.height - view.cy),
    )
    is_perspective = view.lens is None and view.motion is None and shift <= SQUARE_PIXEL_TOLERANCE
    if is_perspective and not calibrated:
        return pose | {
            "type": "perspective",
            "fov": math.degrees(2 * math.atan(0.5 * view.width / focal)),
            "fov_axis": "x",
            "principal_point_offset_x": 0.5 - view.cx / view.width,
            "principal_point_offset_y": 0.5 - view.cy / view.height,
        }
    intrinsics = {name: getattr(view, name) for name in ("fx", "fy", "cx", "cy")}
    if view.lens is not None:
        intrinsics = {} if view.lens.whole_turn else intrinsics
        intrinsics |= {"lens": view.lens.kind, **view.lens.coefficients()}
    if view.motion is not None:
        pose["to_world_close"] = _to_world(view.motion.close_to_world)
        pose["shutter"] = view.motion.shutter
        pose["shutter_samples"] = view.motion.samples
    return {"type": "calibrated", **pose, **intrinsics}


def _to_world(camera_to_world: np.ndarray) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f(camera_to_world @ OPENCV_TO_MITSUBA)


def render_views(scene: mi.Scene, views: Iterable[Viewpoint]) -> Iterator[np.ndarray]:
    """Yield images (H, W, 3) of ``views``, display space, clamped to [0, 1]."""
    for sensor in make_sensors(views):
        with dr.suspend_grad():  # not around the yield: the caller may not resume
            image = np.array(mi.render(scene, sensor=sensor, spp=1))
        yield np.clip(image[:, :, :3], 0, 1)  # without AOVs
