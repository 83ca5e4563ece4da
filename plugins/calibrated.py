"""The ``calibrated`` sensor: lenses of ``drgs.cameras`` for Mitsuba's rays and parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from typing_extensions import override

from drgs.cameras.camera import Camera
from drgs.cameras.lens import LENSES, Lens
from drgs.core.constants import MAX_SHUTTER_SAMPLES, SHUTTER_SAMPLES
from drgs.core.environment import check_variant
from drgs.core.errors import PluginError, UserError
from drgs.core.types import Bool, Float
from drgs.integrator.properties import (
    integer,
    matrix,
    number,
    one_of,
    positive,
    read,
    refuse_unknown,
)
from drgs.integrator.sensors import (
    SensorState,
    on_crop_window,
    opaque_host,
    pose_from_to_world,
    read_sensor,
)

COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "sx1", "sy1")
"""Coefficients of the shipped lenses; other lenses have others."""

INTRINSICS = ("fx", "fy", "cx", "cy")

PROPERTIES = {
    "near_clip": positive(0.01),
    "far_clip": positive(1e4),
    "shutter": one_of("global", "rolling"),
    "shutter_samples": integer(SHUTTER_SAMPLES, 1, MAX_SHUTTER_SAMPLES),
}
"""Single values besides intrinsics, whose defaults depend on the film, and coefficients."""

KNOWN = (
    *("to_world", "to_world_close", *INTRINSICS, "lens", *COEFFICIENTS, *PROPERTIES),
    *("shutter_open", "shutter_close"),
)
"""Names of the properties, besides those of all Mitsuba sensors."""


class CalibratedSensor(mi.Sensor):
    """Camera with the parameters of calibration tools.

    .. pluginparameters::

     * - to_world
       - |transform|
       - Pose, in the axes of Mitsuba's ``perspective``: x to the left, y up, z forward. (Default:
         the identity)
       - |exposed|, |differentiable|
     * - fx, fy
       - |float|
       - Focal lengths, px of the whole film. (Default: the film's width, ``fx``)
       - |exposed|, |differentiable|
     * - cx, cy
       - |float|
       - Principal point, px from the upper left corner of the whole film; the middle of the first
         pixel is at (0.5, 0.5). (Default: the film's centre)
       - |exposed|, |differentiable|
     * - lens
       - |string|
       - ``pinhole``; ``opencv``: radial and tangential distortion; ``fisheye``: by the angle from
         the axis (Kannala and Brandt 2006); ``thin_prism_fisheye``: COLMAP's THIN_PRISM_FISHEYE;
         ``equirectangular``: the whole film is a panorama, without ``fx``, ``fy``, ``cx`` and
         ``cy``; or a lens that another package registers, whose coefficients are parameters as
         well. (Default: ``pinhole``)
     * - k1, k2, k3, k4, k5, k6, p1, p2, sx1, sy1
       - |float|
       - Coefficients of the lens as OpenCV and COLMAP define them. ``opencv`` has ``k1`` to ``k6``,
         ``p1`` and ``p2``; ``fisheye`` has ``k1`` to ``k4``; ``thin_prism_fisheye`` also has
         ``p1``, ``p2``, ``sx1`` and ``sy1``. Given ones, also 0, are exposed; others are not
         computed. (Default: 0)
       - |exposed|, |differentiable|
     * - near_clip, far_clip
       - |float|
       - Depths (with fisheyes: distances) of the near and far plane. ``splats`` ignores
         ``far_clip``. (Default: 0.01, 10000)
     * - to_world_close
       - |transform|
       - Pose when the shutter closes, of a camera that moves by less than half a turn. (Default:
         none, it does not move)
       - |exposed|
     * - shutter_open, shutter_close
       - |float|
       - Times of the two poses, between which rays have theirs. (Default: 0 and, if the camera
         moves, 1)
     * - shutter
       - |string|
       - Shutter of a moving camera. ``global``: the whole film is exposed all the time, which
         blurs; ``rolling``: rows are read from the first to the last. (Default: ``global``)
     * - shutter_samples
       - |int|
       - Number of times at which ``splats`` renders a ``global`` shutter, at most 1000. It averages
         radiance or, if ``srgb_primitives`` is false, display values. (Default: 8)

    Not differentiated: ``to_world_close``, and where the lens model ends.
    """

    def __init__(self, props: mi.Properties) -> None:
        check_variant("calibrated", mi.variant())
        if "to_world_close" in props and "shutter_close" not in props:
            opens = read(props, {"shutter_open": number(0.0)})["shutter_open"]
            props["shutter_close"] = opens + 1.0  # times of rays are within the two
        super().__init__(props)
        self.m_needs_sample_3 = False  # no aperture
        width, height = self.film().size()
        by_film = {"fx": positive(width), "cx": number(width / 2), "cy": number(height / 2)}
        values = read(props, PROPERTIES | by_film)
        values |= read(props, {"fy": positive(values["fx"])})
        self.fx, self.fy, self.cx, self.cy = (mi.Float(values[k]) for k in ("fx", "fy", "cx", "cy"))
        self.lens = _lens(props)
        self.intrinsics = () if self.lens.whole_turn else INTRINSICS
        if unused := [name for name in INTRINSICS if name in props and not self.intrinsics]:
            raise PluginError(
                f"calibrated: the film of lens '{self.lens.kind}' is a whole turn, whatever "
                f"{' and '.join(unused)}; leave them out"
            )
        self.coefficients = {k: mi.Float(v) for k, v in self.lens.coefficients().items()}
        self.near, self.far = values["near_clip"], values["far_clip"]
        if self.near >= self.far:
            raise PluginError(
                f"calibrated: far_clip must be larger than near_clip, {self.near}, got {self.far}"
            )
        self.to_world_close = None
        if "to_world_close" in props:
            close = matrix(props, "to_world_close").astype(np.float32)
            self.to_world_close = mi.AffineTransform4f(close)
        self.shutter, self.shutter_samples = values["shutter"], values["shutter_samples"]
        refuse_unknown(props, (*KNOWN, *self.lens.coefficient_names()))

    @override
    def traverse(self, cb: mi.TraversalCallback) -> None:
        super().traverse(cb)
        cb.put("to_world", self.m_to_world, mi.ParamFlags.Differentiable)
        intrinsics = {name: getattr(self, name) for name in self.intrinsics}
        for name, value in (intrinsics | self.coefficients).items():
            cb.put(name, value, mi.ParamFlags.Differentiable)
        if self.to_world_close is not None:
            cb.put("to_world_close", self.to_world_close, mi.ParamFlags.NonDifferentiable)

    @override
    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        if not keys or set(keys) & set(self.coefficients):
            values = {name: float(value[0]) for name, value in self.coefficients.items()}
            self.lens = _with_coefficients(type(self.lens), values) if values else self.lens

    def near_clip(self) -> float:
        """Return the near clip distance, scene units."""
        return self.near

    def far_clip(self) -> float:
        """Return the far clip distance, scene units."""
        return self.far

    def to_string(self) -> str:
        """Return lens and film as text."""
        lens = ", ".join([type(self.lens).__name__, *map(str, self.coefficients)])
        return (
            f"CalibratedSensor[\n  fx = {self.fx}, fy = {self.fy},\n  cx = {self.cx}, "
            f"cy = {self.cy},\n  lens = {lens},\n  to_world = {self.m_to_world},\n"
            f"  film = {self.film()}\n]"
        )

    def camera_parameters(self) -> list[str]:
        """Return the names of differentiable parameters."""
        moves = ["to_world_close"] if self.to_world_close is not None else []
        return ["to_world", *moves, *self.intrinsics, *self.coefficients]

    def camera_from_state(self, state: SensorState) -> Camera:
        """Return the camera with the sensor's lens."""
        return self._pinhole(state).with_lens(self.lens.with_coefficients(state.device))

    def num_poses(self) -> int:
        """Return the number of poses whose images are averaged."""
        moves = self.to_world_close is not None and self.shutter == "global"
        return self.shutter_samples if moves else 1

    def _pinhole(self, state: SensorState) -> Camera:
        device = state.device
        host = opaque_host(state)
        fx, fy, cx, cy = (device.get(name, type(host[0])(1)) for name in INTRINSICS)
        camera = on_crop_window(state, host, device["to_world"], (fx, fy), (cx, cy))
        if self.to_world_close is None:
            return camera
        from drgs.cameras.motion import Motion, MotionBlur, RollingShutter

        motion = Motion.relative_motion(camera, *pose_from_to_world(device["to_world_close"]))
        if self.shutter == "rolling":
            return replace(camera, shutter=RollingShutter(*motion))
        return replace(camera, shutter=MotionBlur(*motion, self.shutter_samples))

    @override
    def sample_ray(
        self,
        time: Float,
        sample1: Float,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: Bool | bool = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        del sample3
        place = sample2 * mi.Vector2f(self.film().crop_size())
        state = read_sensor(self, 0.0)
        camera = self._pinhole(state)
        lens = self.lens.with_coefficients(state.device).upload(mi.Float)
        camera = replace(camera, lens=lens)
        _, direction, seen = camera.look_through(place.x, place.y)

        if camera.shutter is not None:
            camera = camera.shutter.pose(camera, self._time_of(camera, time, place.y))
        per_length = 1 / dr.norm(direction)
        near, far = lens.ray_range(direction * per_length, self.near, self.far)
        direction = camera.rotation.T @ (direction * per_length)
        nothing = dr.zeros(mi.SurfaceInteraction3f)
        wavelengths, weight = self.sample_wavelengths(nothing, sample1, active)
        start, towards = mi.Point3f(camera.center) + direction * near, mi.Vector3f(direction)
        ray = mi.Ray3f(o=start, d=towards, maxt=far - near, time=time, wavelengths=wavelengths)
        return ray, weight & seen

    def _time_of(self, camera: Camera, time: Float, y: Float) -> Float:
        """Return the time of a ray in the row ``y`` (px), from 0, the first pose, to 1."""
        if self.shutter == "rolling":
            return (y - camera.film_start.y) / (camera.film_end.y - camera.film_start.y)
        if self.shutter_open_time() == 0:
            return mi.Float(0)
        return (mi.Float(time) - self.shutter_open()) / self.shutter_open_time()

    @override
    def sample_ray_differential(
        self,
        time: Float,
        sample1: Float,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: Bool | bool = True,
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        width, height = self.film().crop_size()
        steps = mi.Vector2f(1 / width, 0), mi.Vector2f(0, 1 / height)
        places = (sample2 + step for step in steps)
        beside = [self.sample_ray(time, sample1, place, sample3, active)[0] for place in places]
        result = mi.RayDifferential3f(ray)
        result.o_x, result.o_y = (other.o for other in beside)
        result.d_x, result.d_y = (other.d for other in beside)
        result.has_differentials = True
        return result, weight

    @override
    def bbox(self) -> mi.ScalarBoundingBox3f:
        return mi.ScalarBoundingBox3f()


def _lens(props: mi.Properties) -> Lens:
    kind = str(props.get("lens", "pinhole"))
    try:
        model = LENSES.get(kind, "calibrated: lens").value
    except UserError as error:
        raise PluginError(str(error)) from error
    names = model.coefficient_names()
    if taken := ({*KNOWN} - {*COEFFICIENTS}).intersection(names):
        raise PluginError(
            f"calibrated: lens '{kind}' has coefficients with the names of other properties, "
            f"{', '.join(sorted(taken))}; rename them"
        )
    known = dict.fromkeys((*COEFFICIENTS, *names))
    given = read(props, {name: number(0.0) for name in known if name in props})
    for name in given:
        if name not in names:
            raise PluginError(
                f"calibrated: lens '{kind}' has "
                f"{'the coefficients ' + ', '.join(names) if names else 'no coefficients'}, "
                f"got {name}"
            )
    return _with_coefficients(model, given)


def _with_coefficients(model: type[Lens], coefficients: dict[str, float]) -> Lens:
    try:
        return model.from_coefficients(**coefficients)
    except UserError as error:
        raise PluginError(f"calibrated: {error}") from error


mi.register_sensor("calibrated", lambda props: CalibratedSensor(props))
